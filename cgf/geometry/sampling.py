"""Fewer points: one per voxel."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import check_positive
from cgf.types import PointCloud

_LARGEST_KEY = 2.0**52


def voxel_downsample(cloud: PointCloud, voxel_size: float) -> PointCloud:
    """Replace the points in each voxel by their centroid.

    Normals are averaged and made unit length again (where they cancel, the normal of the point nearest to the
    centroid is taken), colours are averaged. Voxel borders lie at multiples of `voxel_size` in the cloud's frame.
    The order of the result is that of the voxels along x, y, z and does not depend on the order of the points.

    Args:
        cloud: Of any number of points.
        voxel_size: Edge of a voxel, in cloud units.

    Raises:
        ValueError: `voxel_size` is not positive, or too small to number the voxels.
    """
    check_positive(voxel_size, "voxel_size")
    points = cloud.points
    if not len(points):
        return cloud
    largest = float(np.abs(points).max())
    if largest / voxel_size > _LARGEST_KEY:
        raise ValueError(
            f"voxel_size must be {largest / _LARGEST_KEY:.3g} or more for coordinates up to {largest:.3g}, "
            f"got {voxel_size:g}"
        )
    voxels = np.floor(points / voxel_size).astype(np.int64)
    # Points of one voxel are ordered as well, so that their sums do not depend on the order of the file.
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], voxels[:, 2], voxels[:, 1], voxels[:, 0]))
    changes = (np.diff(voxels[order], axis=0) != 0).any(axis=1)
    starts = np.concatenate([[0], np.flatnonzero(changes) + 1])
    # Sums of offsets, not of coordinates: a cloud far from its origin keeps its precision.
    origin = points[order[starts]]
    counts = np.diff(starts, append=len(points))
    offsets = points[order] - np.repeat(origin, counts, axis=0)
    centroids = origin + np.add.reduceat(offsets, starts, axis=0) / counts[:, None]
    return replace(
        cloud,
        points=centroids,
        normals=None if cloud.normals is None else _mean_normals(cloud.normals, points, centroids, order, starts),
        colors=None
        if cloud.colors is None
        else np.rint(np.add.reduceat(cloud.colors[order].astype(np.float64), starts, axis=0) / counts[:, None]).astype(
            np.uint8
        ),
    )


def _mean_normals(
    normals: Float64[np.ndarray, "N 3"],
    points: Float64[np.ndarray, "N 3"],
    centroids: Float64[np.ndarray, "V 3"],
    order: Int64[np.ndarray, "N"],
    starts: Int64[np.ndarray, "V"],
) -> Float64[np.ndarray, "V 3"]:
    """Mean of the normals of each voxel, of unit length; `order` sorts points by voxel, voxels begin at `starts`."""
    counts = np.diff(starts, append=len(order))
    means: Float64[np.ndarray, "V 3"] = np.add.reduceat(normals[order], starts, axis=0) / counts[:, None]
    lengths = np.linalg.norm(means, axis=1)
    for voxel in np.flatnonzero(lengths < 1e-6):
        rows = order[starts[voxel] : starts[voxel] + counts[voxel]]
        closest = rows[np.argmin(np.linalg.norm(points[rows] - centroids[voxel], axis=1))]
        means[voxel] = normals[closest]
        lengths[voxel] = np.linalg.norm(normals[closest])
    means /= lengths[:, None]
    return means

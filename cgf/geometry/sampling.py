"""Fewer points: one per voxel."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import check_positive
from cgf.types import PointCloud

_LARGEST_KEY = 2.0**52
_LARGEST_NUMBER = 2.0**62
_BLOCK = 1 << 17
_WIDE = 64


@dataclass(frozen=True, eq=False)
class Voxels:
    """Points sorted by voxel."""

    order: Int64[np.ndarray, "N"]
    """Rows of the cloud, those of a voxel side by side and ascending, voxels along x, y, z."""
    starts: Int64[np.ndarray, "V"]
    """Entry of `order` at which each voxel begins."""
    counts: Int64[np.ndarray, "V"]

    def means(self, values: np.ndarray, *, scale: float, cell: float | None = None) -> Float64[np.ndarray, "V 3"]:
        """Mean of three columns of values to 40 bits of `scale`, which none exceeds.

        Sums of integers do not depend on the order of the points, those of floats do.

        Args:
            values: One row a point.
            scale: Largest magnitude.
            cell: Where given, values count from the multiple of it below them.
        """
        gain = 2.0 ** min(40, 62 - int(self.counts.max()).bit_length()) / scale
        means = np.empty((len(self.starts), 3))
        ends = self.starts + self.counts
        first = 0
        while first < len(ends):
            # Some at a time: memory that is written for the first time is slow.
            last = max(int(np.searchsorted(ends, self.starts[first] + _BLOCK, side="right")), first + 1)
            block = values[self.order[self.starts[first] : ends[last - 1]]].astype(np.float64)
            if cell is not None:
                block -= np.floor(block / cell) * cell
            block *= gain
            integers = np.rint(block, out=block).astype(np.int64)
            means[first:last] = np.add.reduceat(integers, self.starts[first:last] - self.starts[first], axis=0)
            first = last
        means /= gain * self.counts[:, None]
        return means


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
    if not len(cloud):
        return cloud
    points, normals, colors = cloud.points, cloud.normals, cloud.colors
    voxels = sort_into_voxels(points, voxel_size)
    centroids = points[voxels.order[voxels.starts]]
    several = voxels.counts > 1
    corners = np.floor(centroids / voxel_size) * voxel_size
    # Means of offsets, not of coordinates: a cloud far from its origin keeps its precision.
    centroids[several] = (corners + voxels.means(points, scale=voxel_size, cell=voxel_size))[several]
    return replace(
        cloud,
        points=centroids,
        normals=None if normals is None else _mean_normals(normals, points, centroids, voxels),
        colors=None if colors is None else np.rint(voxels.means(colors, scale=256.0)).astype(np.uint8),
    )


def voxel_rows(points: Float64[np.ndarray, "N 3"], voxel_size: float) -> Int64[np.ndarray, "V"]:
    """The first row of each voxel, ascending; voxels as in `voxel_downsample`.

    Raises:
        ValueError: `voxel_size` is not positive, or too small to number the voxels.
    """
    check_positive(voxel_size, "voxel_size")
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    voxels = sort_into_voxels(points, voxel_size)
    return np.sort(voxels.order[voxels.starts])


def bounds(points: Float64[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Least and largest coordinates of one point or more."""
    # Along wide rows, processors compare several numbers at once; along three, they do not.
    whole = len(points) // _WIDE * _WIDE
    parts = [points[:whole].reshape(-1, 3 * _WIDE), points[whole:]]
    lowest, highest = (
        np.concatenate([bound(part, axis=0).reshape(-1, 3) for part in parts if len(part)])
        for bound in (np.min, np.max)
    )
    return lowest.min(axis=0), highest.max(axis=0)


def sort_into_voxels(points: Float64[np.ndarray, "N 3"], voxel_size: float) -> Voxels:
    """Which points lie in which voxel; borders as in `voxel_downsample`.

    Raises:
        ValueError: `voxel_size` is too small to number the voxels.
    """
    lowest, highest = bounds(points)
    largest = max(float(highest.max()), -float(lowest.min()))
    if largest / voxel_size > _LARGEST_KEY:
        raise ValueError(
            f"voxel_size must be {largest / _LARGEST_KEY:.3g} or more for coordinates up to {largest:.3g}, "
            f"got {voxel_size:g}"
        )
    low, high = np.floor(lowest / voxel_size), np.floor(highest / voxel_size)
    counts = (high - low).astype(np.int64) + 1
    keys = np.empty(len(points), dtype=np.int64)
    if float(np.prod(counts.astype(np.float64))) < _LARGEST_NUMBER:
        weights = np.array([counts[1] * counts[2], counts[2], 1])
        for start in range(0, len(points), _BLOCK):
            part = slice(start, start + _BLOCK)
            np.matmul((np.floor(points[part] / voxel_size) - low).astype(np.int64), weights, out=keys[part])
    else:
        # Ranks in place of numbers fit: there are no more of them than points.
        cells = np.floor(points / voxel_size)
        keys[:] = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    order, keys = _sorted(keys)
    starts = np.concatenate([[0], np.flatnonzero(keys[1:] != keys[:-1]) + 1])
    return Voxels(order, starts, np.diff(starts, append=len(points)))


def _sorted(keys: Int64[np.ndarray, "N"]) -> tuple[Int64[np.ndarray, "N"], Int64[np.ndarray, "N"]]:
    """Rows in the order of their keys, none of which is negative, and these; of equal ones, the first comes first."""
    bits = len(keys).bit_length()
    if int(keys.max()) >= 1 << (63 - bits):
        order = np.argsort(keys, kind="stable")
        return order, keys[order]
    # Sorting numbers that hold their row is ten times faster than sorting rows by their numbers.
    packed = keys << bits
    packed |= np.arange(len(keys))
    packed.sort()
    return packed & ((1 << bits) - 1), packed >> bits


def _mean_normals(
    normals: Float64[np.ndarray, "N 3"],
    points: Float64[np.ndarray, "N 3"],
    centroids: Float64[np.ndarray, "V 3"],
    voxels: Voxels,
) -> Float64[np.ndarray, "V 3"]:
    """Mean of the normals of each voxel, of unit length."""
    means = voxels.means(normals, scale=1.0)
    lengths = np.linalg.norm(means, axis=1)
    for voxel in np.flatnonzero(lengths < 1e-6):
        rows = voxels.order[voxels.starts[voxel] : voxels.starts[voxel] + voxels.counts[voxel]]
        rows = rows[np.lexsort(points[rows].T)]
        closest = rows[np.argmin(np.linalg.norm(points[rows] - centroids[voxel], axis=1))]
        means[voxel] = normals[closest]
        lengths[voxel] = np.linalg.norm(normals[closest])
    means /= lengths[:, None]
    return means

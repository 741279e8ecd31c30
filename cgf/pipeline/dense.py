"""Features of every loaded point, from those of the prepared ones: what lies around a point looks like it."""

import numpy as np
from jaxtyping import Float64, Int64

from cgf import descriptors
from cgf.descriptors.network import unit_rows
from cgf.geometry.neighbors import build_tree, nearest
from cgf.pipeline.settings import ResolvedSettings
from cgf.pipeline.stages import at_dim, describe, prepare
from cgf.types import Features, IsCancelled, PointCloud, Progress, raise_if_cancelled

_NEIGHBORS = 3
_BLOCK = 1 << 17


def describe_all(
    cloud: PointCloud,
    settings: ResolvedSettings,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> tuple[Features, PointCloud, Features]:
    """Describe every point of a loaded cloud, however many it has: prepare it, describe that, and interpolate.

    Args:
        cloud: As loaded.
        settings: Say, besides the features, how far the described points lie apart: `voxel_size`.
        progress: Told the share done.
        cancelled: Asked now and then whether to give up.

    Returns:
        Features of `settings.dim` values of the points of `cloud`, as `interpolate` gives them; the prepared cloud,
        and its features.

    Raises:
        InputError: Too few points are left, or none can be described.
        Cancelled: `cancelled` returned True.
    """
    prepared = prepare(cloud, settings)
    features = at_dim(describe(prepared, settings, progress=progress, cancelled=cancelled), settings)
    raise_if_cancelled(cancelled)
    reach = max(2 * settings.voxel_size, settings.lrf_radius)
    return interpolate(cloud.points, prepared, features, reach=reach), prepared, features


def interpolate(
    points: Float64[np.ndarray, "N 3"], prepared: PointCloud, features: Features, *, reach: float
) -> Features:
    """Features of `points` from those of a prepared cloud: the mean of the 3 nearest by inverse distance.

    Args:
        points: In the frame of `prepared`.
        prepared: The cloud that was described.
        features: Of rows of it. Those of unit length are so again after taking the mean.
        reach: Points farther than this from all that are described are left out, in cloud units.

    Returns:
        Features whose `indices` are rows of `points`.
    """
    tree = build_tree(prepared.points[features.indices])
    count = min(_NEIGHBORS, len(features))
    vectors = np.empty((len(points), features.dim), dtype=np.float32)
    quality = None if features.quality is None else np.empty(len(points), dtype=np.float32)
    near = np.zeros(len(points), dtype=np.bool_)
    for start in range(0, len(points), _BLOCK):
        part = slice(start, start + _BLOCK)
        distances, rows = tree.query(points[part], k=[*range(1, count + 1)], workers=-1)
        near[part] = distances[:, 0] <= reach
        # A point that is described itself keeps its features to the last digit.
        weights = np.maximum(distances[:, :1], 1e-12 * reach) / np.maximum(distances, 1e-12 * reach)
        weights[distances[:, 0] == 0, 1:] = 0
        weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
        block = vectors[part]
        np.multiply(features.vectors[rows[:, 0]], weights[:, :1], out=block)
        for neighbor in range(1, count):
            block += features.vectors[rows[:, neighbor]] * weights[:, neighbor : neighbor + 1]
        if quality is not None and features.quality is not None:
            quality[part] = (features.quality[rows] * weights).sum(axis=1)
        if features.descriptor in descriptors.NESTED:
            inside = distances[:, 0] > 0
            block[inside] = unit_rows(block[inside])
    indices = np.flatnonzero(near)
    return Features(
        indices,
        vectors if near.all() else vectors[near],
        features.descriptor,
        None if quality is None else quality[near],
    )


def nearest_described(
    points: Float64[np.ndarray, "N 3"], prepared: PointCloud, features: Features
) -> Int64[np.ndarray, "N"]:
    """For each of `points`, the entry of `features` whose point lies nearest: whose match and error it borrows.

    Raises:
        ValueError: There are no features.
    """
    return nearest(prepared.points[features.indices], points)[0]

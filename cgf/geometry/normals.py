"""Surface normals from neighbours, on the side of the sensor."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import check_count, check_positive
from cgf.geometry.neighbors import build_tree
from cgf.types import PointCloud

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_FEWEST_NEIGHBORS = 3
_FALLBACK_NEIGHBORS = 10
_ENTRIES_PER_CHUNK = 2_000_000


def estimate_normals(
    cloud: PointCloud,
    *,
    radius: float,
    max_neighbors: int | None = None,
    viewpoint: Float64[np.ndarray, "3"] | None = None,
) -> PointCloud:
    """Give every point the normal of the plane through its neighbours, turned to the viewpoint.

    Args:
        cloud: Of 3 points or more.
        radius: Of the neighbourhood, in cloud units; a point with fewer than 3 points in it (itself counts)
            takes its 10 nearest instead.
        max_neighbors: Use only that many nearest points within the radius.
        viewpoint: Side to which normals point; the cloud's own where None, which it replaces otherwise.

    Raises:
        ValueError: `radius` is not positive, or `max_neighbors` or the cloud is below 3.
    """
    check_positive(radius, "radius")
    if max_neighbors is not None:
        check_count(max_neighbors, "max_neighbors", minimum=_FEWEST_NEIGHBORS)
    if len(cloud) < _FEWEST_NEIGHBORS:
        raise ValueError(f"cloud must have {_FEWEST_NEIGHBORS} points or more, got {len(cloud)}")
    # Products of coordinates lose digits far from the origin, hence the centring.
    points = cloud.points - cloud.points.mean(axis=0)
    tree = build_tree(points)
    counts = np.asarray(tree.query_ball_point(points, radius, return_length=True, workers=-1), dtype=np.int64)
    covariances = np.zeros((len(points), 3, 3))
    enough = counts >= _FEWEST_NEIGHBORS
    for rows in _chunks(np.flatnonzero(enough), counts):
        if max_neighbors is None or counts[rows].max() <= max_neighbors:
            covariances[rows] = _covariances_within(tree, points, rows, radius)
        else:
            covariances[rows] = _covariances_nearest(tree, points, rows, max_neighbors, radius)
    few = np.flatnonzero(~enough)
    if len(few):
        covariances[few] = _covariances_nearest(tree, points, few, min(_FALLBACK_NEIGHBORS, len(points)), np.inf)
    normals = np.linalg.eigh(covariances)[1][:, :, 0]
    return orient(replace(cloud, normals=np.ascontiguousarray(normals)), viewpoint)


def orient(cloud: PointCloud, viewpoint: Float64[np.ndarray, "3"] | None = None) -> PointCloud:
    """Turn round the normals that point away from the viewpoint (the cloud's own where None).

    Raises:
        ValueError: The cloud has no normals.
    """
    if cloud.normals is None:
        raise ValueError("cloud must have normals, got none; estimate them first")
    position = cloud.viewpoint if viewpoint is None else viewpoint
    away = np.einsum("ij,ij->i", cloud.normals, position - cloud.points) < 0
    return replace(cloud, normals=np.where(away[:, None], -cloud.normals, cloud.normals), viewpoint=position)


def _chunks(rows: Int64[np.ndarray, "K"], counts: Int64[np.ndarray, "N"]) -> Iterator[Int64[np.ndarray, "C"]]:
    """Split `rows` so that the neighbours of a part fit in memory."""
    if not len(rows):
        return
    parts = np.cumsum(counts[rows]) // _ENTRIES_PER_CHUNK
    yield from np.split(rows, np.flatnonzero(np.diff(parts)) + 1)


def _covariances_within(
    tree: "cKDTree", points: Float64[np.ndarray, "N 3"], rows: Int64[np.ndarray, "K"], radius: float
) -> Float64[np.ndarray, "K 3 3"]:
    """Covariance of all points within `radius` of each of `rows`."""
    from scipy.sparse import csr_array

    pairs = build_tree(points[rows]).sparse_distance_matrix(tree, radius, output_type="ndarray")
    weights = csr_array((np.ones(len(pairs)), (pairs["i"], pairs["j"])), shape=(len(rows), len(points)))
    # Sums of 1, x, y, z, xx, xy, ... over neighbours are one sparse product.
    products = points[:, :, None] * points[:, None, :]
    sums = weights @ np.concatenate([np.ones((len(points), 1)), points, products.reshape(-1, 9)], axis=1)
    means = sums[:, 1:4] / sums[:, :1]
    second = (sums[:, 4:] / sums[:, :1]).reshape(-1, 3, 3)
    return np.asarray(second - means[:, :, None] * means[:, None, :], dtype=np.float64)


def _covariances_nearest(
    tree: "cKDTree", points: Float64[np.ndarray, "N 3"], rows: Int64[np.ndarray, "K"], count: int, radius: float
) -> Float64[np.ndarray, "K 3 3"]:
    """Covariance of the `count` nearest points within `radius` of each of `rows`."""
    distances, neighbors = tree.query(points[rows], k=count, distance_upper_bound=radius, workers=-1)
    found = np.isfinite(distances)
    offsets = points[np.where(found, neighbors, rows[:, None])] - points[rows][:, None]
    weights = found / found.sum(axis=1, keepdims=True)
    means = np.einsum("kn,kni->ki", weights, offsets)
    second = np.einsum("kn,kni,knj->kij", weights, offsets, offsets)
    return np.asarray(second - means[:, :, None] * means[:, None, :], dtype=np.float64)


def unit_normals(normals: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Normals of unit length; zeros where they have none or are not a number."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0))

"""Exact neighbours in space."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64, Int64

from cgf.checks import check_positive

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_SPACING_QUERIES = 5_000
_SPACING_LARGE = 1_000_000
_SPACING_PLACES = 64
_SPACING_CELL = 500
"""Points of a cell on average: few of them lie at its border."""


def build_tree(points: Float64[np.ndarray, "N 3"]) -> "cKDTree":
    """A k-d tree over `points`, for many questions about one cloud."""
    from scipy.spatial import cKDTree  # on first use: it costs half a second to import

    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def nearest(
    points: Float64[np.ndarray, "N 3"], queries: Float64[np.ndarray, "Q 3"]
) -> tuple[Int64[np.ndarray, "Q"], Float64[np.ndarray, "Q"]]:
    """The nearest of `points` to each query.

    Returns:
        Rows of `points`, and distances in cloud units.

    Raises:
        ValueError: There are no points to be near to.
    """
    if not len(points):
        raise ValueError("points must have 1 point or more, got 0")
    distances, rows = build_tree(points).query(queries, workers=-1)
    return np.asarray(rows, dtype=np.int64), np.asarray(distances, dtype=np.float64)


def overlap_mask(
    source_in_target: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "M 3"], tau: float
) -> Bool[np.ndarray, "N"]:
    """Which points of the source, moved into the target's frame, have a target point within `tau`."""
    check_positive(tau, "tau")
    if not len(target):
        return np.zeros(len(source_in_target), dtype=np.bool_)
    # The bound of the search is exclusive, and a point at exactly tau counts.
    bound = float(np.nextafter(tau, np.inf))
    distances, _ = build_tree(target).query(source_in_target, distance_upper_bound=bound, workers=-1)
    return np.asarray(distances <= tau, dtype=np.bool_)


def median_spacing(points: Float64[np.ndarray, "N 3"], *, neighbor: int = 1) -> float:
    """Median distance from a point to its nearest other point, or to a later `neighbor`, in cloud units.

    Clouds of more than 5,000 points are asked at 5,000 evenly spread rows, and of more than a million at 64
    places spread likewise. Repeated points count once where most points are repeated. 0 for fewer than 2
    distinct points.
    """
    if len(points) > _SPACING_LARGE and (points != points[0]).any():
        points = _samples_of_surface(points)
    spacing = _median_distance(points, neighbor)
    return spacing if spacing > 0 else _median_distance(np.unique(points, axis=0), neighbor)


def _samples_of_surface(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "K 3"]:
    """All points of some cells of a coarse grid: complete neighbourhoods but at the borders of the cells."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max()
    places = np.linspace(0, len(points) - 1, _SPACING_PLACES).astype(np.int64)
    for cells in (64, 32, 16, 8, 4, 2):
        keys = np.zeros(len(points), dtype=np.int64)
        for axis in range(3):
            keys *= cells
            keys += np.minimum((points[:, axis] - low[axis]) * (cells / extent), cells - 1).astype(np.int64)
        chosen = np.zeros(cells**3, dtype=np.bool_)
        chosen[keys[places]] = True
        found = chosen[keys]
        if np.count_nonzero(found) >= _SPACING_CELL * np.count_nonzero(chosen):
            return points[found]
    return points


def _median_distance(points: Float64[np.ndarray, "N 3"], neighbor: int) -> float:
    neighbor = min(neighbor, len(points) - 1)
    if neighbor < 1:
        return 0.0
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), _SPACING_QUERIES)).astype(np.int64))
    distances, _ = build_tree(points).query(points[rows], k=[neighbor + 1], workers=-1)
    return float(np.median(distances))

"""Which points are drawn: all that were loaded, each with the prepared point that lends it its colour.

Features and errors are known at the prepared points, one a voxel; what lies around such a point looks like it.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cgf.geometry.neighbors import median_spacing, nearest
from cgf.geometry.sampling import bounds, voxel_rows
from cgf.types import PointCloud

MAX_SHOWN = 1_000_000
"""Points of one cloud at most: what graphics cards draw smoothly, and browsers hold."""

_SAMPLED = 1_000_000
_CELL = 64
_SCATTERING = np.array([73_856_093, 19_349_663, 83_492_791])
_BLOCK = 1 << 17
_STEPS = 12
_AIM, _FEWEST = 0.97, 0.92
"""Shares of the points asked for that are looked for, and that are enough."""


@dataclass(frozen=True, eq=False)
class Shown:
    """The points of one cloud that are drawn."""

    cloud: PointCloud
    prepared_rows: npt.NDArray[np.int64]
    """For each of them, the nearest row of the prepared cloud."""
    spacing: float
    """Median distance to the fourth neighbour, in cloud units: the step of a square grid of as many points."""


def choose_shown(loaded: PointCloud, prepared: PointCloud, *, limit: int = MAX_SHOWN) -> Shown:
    """Show every loaded point, or the first in each voxel where there are more than `limit`.

    Args:
        loaded: As read from its file.
        prepared: Made from it; of one point or more.
        limit: Most points to show, about: voxels grow until no more are left.
    """
    cloud = loaded if len(loaded) <= limit else loaded.take(thinned_rows(loaded.points, limit=limit))
    rows, _ = nearest(prepared.points, cloud.points)
    return Shown(cloud, rows, median_spacing(cloud.points, neighbor=4))


def thinned_rows(points: npt.NDArray[np.float64], *, limit: int) -> npt.NDArray[np.int64]:
    """Rows of at most `limit` points, and not many fewer, spread evenly over the surface; ascending."""
    if len(points) <= limit:
        return np.arange(len(points), dtype=np.int64)
    edge = _edge_of_voxels(points, limit)
    rows = voxel_rows(points, edge)
    while len(rows) > limit:
        edge *= 1.02 * np.sqrt(len(rows) / limit)
        rows = voxel_rows(points, edge)
    return rows


def _edge_of_voxels(points: npt.NDArray[np.float64], count: int) -> float:
    """Edge of voxels of which the points fill about `count`, or somewhat fewer; clouds of many points are sampled."""
    lowest, highest = bounds(points)
    edge = float((highest - lowest).max()) / np.sqrt(count)
    smallest = max(1e-12 * float(np.abs([lowest, highest]).max()), 1e-300)
    if len(points) > _SAMPLED:
        sample = _some_cells(points, _CELL * edge)
        count, points = max(count * len(sample) // len(points), 1), sample
    before = 0
    for _ in range(_STEPS):
        edge = max(edge, smallest)
        filled = len(voxel_rows(points, edge))
        if _FEWEST * count <= filled <= count or filled == before:
            break
        # On a surface, the number of voxels falls with the square of their edge.
        edge, before = edge * np.sqrt(filled / (_AIM * count)), filled
    return max(edge, smallest)


def _some_cells(points: npt.NDArray[np.float64], edge: float) -> npt.NDArray[np.float64]:
    """All points of an eighth of the cells of a coarse grid, wherever the points are dense or not."""
    chosen = np.empty(len(points), dtype=np.bool_)
    for start in range(0, len(points), _BLOCK):
        part = slice(start, start + _BLOCK)
        cells = np.floor(points[part] / edge).astype(np.int64) @ _SCATTERING
        chosen[part] = cells % 8 == 0
    return points[chosen] if chosen.any() else points

"""Which points are drawn: all that were loaded, each with the prepared point that lends it its colour.

Features and errors are known at the prepared points, one a voxel; what lies around such a point looks like it.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cgf.geometry.neighbors import median_spacing, nearest
from cgf.geometry.sampling import voxel_rows
from cgf.types import PointCloud

MAX_SHOWN = 1_000_000
"""Points of one cloud at most: what graphics cards draw smoothly, and browsers hold."""


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
    # On a surface, the number of voxels falls with the square of their edge.
    edge = median_spacing(points) * np.sqrt(len(points) / limit)
    rows = voxel_rows(points, edge)
    while len(rows) > limit:
        edge *= 1.02 * np.sqrt(len(rows) / limit)
        rows = voxel_rows(points, edge)
    return rows

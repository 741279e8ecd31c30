"""A uniform grid over a cloud: points in cell order, so that a ball query reads a few contiguous runs."""

from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numba import njit

from cgf.geometry.lanes import LANES

MAX_CELLS = 1 << 22
"""Cells of a grid at most (16 MiB of offsets); wider clouds get larger cells."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Points sorted by cell, x varying fastest; made by `build_grid`."""

    xyz: Float32[np.ndarray, "3 M"]
    """Coordinates minus `offset`, in cell order; then `LANES` columns that are read with the last, but mean nothing."""
    order: Int64[np.ndarray, "N"]
    """Row of the cloud that each column of `xyz` comes from."""
    starts: Int64[np.ndarray, "C"]
    """First column of each cell; one entry more than there are cells."""
    shape: tuple[int, int, int]
    """Number of cells along x, y, z."""
    cell_size: float
    offset: Float64[np.ndarray, "3"]
    """Lower corner of the first cell."""

    def arguments(self) -> tuple[Any, ...]:
        """What a compiled loop takes: x, y, z, starts, shape, cell size."""
        return (*self.xyz, *self.cells())

    def cells(self) -> tuple[Any, ...]:
        """What a compiled loop takes beside the points: starts, shape, cell size."""
        return (self.starts, self.shape, np.float32(self.cell_size))

    def sorted_columns(self, vectors: Float64[np.ndarray, "N 3"]) -> Float32[np.ndarray, "3 M"]:
        """One vector a point in the order and with the padding of `xyz`."""
        columns = np.zeros_like(self.xyz)
        columns[:, : len(vectors)] = vectors[self.order].T
        return columns

    def local(self, points: Float64[np.ndarray, "K 3"]) -> Float32[np.ndarray, "K 3"]:
        """`points` in the grid's single-precision coordinates."""
        return (points - self.offset).astype(np.float32)


def build_grid(points: Float64[np.ndarray, "N 3"], *, cell_size: float) -> Grid:
    """Sort `points` into cubic cells.

    Args:
        points: Finite, at least one, in cloud units.
        cell_size: Edge of a cell; about the fastest is a quarter of the radius for balls of thousands of points, the
            radius for balls of dozens. Grown where the grid would have more than `MAX_CELLS`.
    """
    columns = np.ascontiguousarray(points.T)
    low = columns.min(axis=1)
    extent = columns.max(axis=1) - low
    while np.prod(extent // cell_size + 1) > MAX_CELLS:
        cell_size *= 1.5
    shape = (extent // cell_size).astype(np.int64) + 1
    local = (points - low).astype(np.float32)
    cells = np.minimum((local / np.float32(cell_size)).astype(np.int64), shape - 1)
    keys = (cells[:, 2] * shape[1] + cells[:, 1]) * shape[0] + cells[:, 0]
    order, starts = _sort(keys, int(np.prod(shape)))
    xyz = np.zeros((3, len(points) + LANES), np.float32)
    xyz[:, : len(points)] = local[order].T
    return Grid(xyz, order, starts, (int(shape[0]), int(shape[1]), int(shape[2])), float(cell_size), low)


@njit(cache=True, nogil=True)
@no_type_check
def _sort(keys, count):
    """Which of the `keys` come in which order, equal ones in their own; and where those of each of `count` begin."""
    starts = np.zeros(count + 1, np.int64)
    for key in keys:
        starts[key] += 1
    for key in range(1, count + 1):
        starts[key] += starts[key - 1]
    order = np.empty(len(keys), np.int64)
    for i in range(len(keys) - 1, -1, -1):
        starts[keys[i]] -= 1
        order[starts[keys[i]]] = i
    return order, starts


@njit(inline="always")
@no_type_check
def cell_range(value, radius, cell_size, count):
    """First and last cell along one axis that a ball around `value` touches, clipped to the grid."""
    # The slack covers points that single precision put into the neighbouring cell.
    slack = np.float32(1e-3) * cell_size
    first = max(int(np.floor((value - radius - slack) / cell_size)), 0)
    last = min(int(np.floor((value + radius + slack) / cell_size)), count - 1)
    return first, last


@njit(inline="always")
@no_type_check
def axis_gap(value, cell, cell_size):
    """Distance along one axis from `value` to the slab of `cell`; zero inside."""
    low = cell * cell_size
    return max(low - value, value - low - cell_size, np.float32(0.0))

"""Features averaged over the described points around each: what noise and sampling do to one, its neighbours mend."""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from cgf.geometry.grid import Grid, build_grid, cell_range
from cgf.geometry.lanes import INT64, LANES, Lanes, Writer, gather_offsets
from cgf.geometry.parallel import for_each_block
from cgf.geometry.sampling import sort_into_voxels

_BLOCK = 512
_CELLS_PER_RADIUS = 4
_COLUMNS = 4 * LANES
"""Of vectors, summed at a time in registers."""
_GATHERED, _RUN = 512, 128
"""Neighbours looked at together, and points gathered in one go."""


def pool_features(
    points: Float64[np.ndarray, "K 3"],
    vectors: Float32[np.ndarray, "K D"],
    *,
    radius: float,
    at: Float64[np.ndarray, "Q 3"] | None = None,
) -> Float32[np.ndarray, "Q D"]:
    """Mean of the vectors of all points within `radius` of each, weighted by 1 - (distance / radius)^2.

    Args:
        points: The described points, in cloud units.
        vectors: One per point.
        radius: In cloud units.
        at: Where to take means, zero where no point is near; the points themselves if None.
    """
    places = points if at is None else at
    pooled = np.empty((len(places), vectors.shape[1]), np.float32)
    if len(places) == 0:
        return pooled
    ball = _Ball.around(points, vectors, radius=radius)

    def fill(part: slice) -> None:
        pooled[part] = ball.means(places[part])

    for_each_block(fill, len(places), block=_BLOCK)
    return pooled


@dataclass(frozen=True, eq=False)
class _Ball:
    """Points with vectors, made ready for means within a radius."""

    grid: Grid
    numbers: Float32[np.ndarray, "M"]
    """Bits of the place of each point in the grid."""
    vectors: Float32[np.ndarray, "N W"]
    """In the order of the grid, padded with zeros to whole registers."""
    width: int
    radius: float

    @classmethod
    def around(
        cls, points: Float64[np.ndarray, "K 3"], vectors: Float32[np.ndarray, "K D"], *, radius: float
    ) -> "_Ball":
        grid = build_grid(points, cell_size=radius)
        numbers = np.arange(grid.xyz.shape[1], dtype=np.int32).view(np.float32)
        width = vectors.shape[1]
        padded = np.pad(vectors, ((0, 0), (0, -width % _COLUMNS))) if width % _COLUMNS else vectors
        return cls(grid, numbers, padded[grid.order], width, radius)

    def means(self, places: Float64[np.ndarray, "Q 3"]) -> Float32[np.ndarray, "Q D"]:
        """Zero where no point is near."""
        means = np.empty((len(places), self.vectors.shape[1]), np.float32)
        columns = (*self.grid.xyz, self.numbers)
        _fill_means(self.grid.local(places), columns, *self.grid.cells(), np.float32(self.radius), self.vectors, means)
        return means[:, : self.width]


def cell_means(
    points: Float64[np.ndarray, "K 3"], vectors: Float32[np.ndarray, "K D"], *, radius: float
) -> tuple[Float64[np.ndarray, "C 3"], Float32[np.ndarray, "C D"]]:
    """Means of points and vectors in cells of a quarter of `radius`: few enough to be averaged within it again.

    Each cell counts the same, however many points it holds. Every point lies within `radius` of its cell's mean.
    """
    if len(points) == 0:
        return points, vectors
    voxels = sort_into_voxels(points, radius / _CELLS_PER_RADIUS)
    means = np.empty((len(voxels.starts), 3 + vectors.shape[1]))
    _fill_cell_means(points, vectors, voxels.order, voxels.starts, voxels.counts, means)
    return np.ascontiguousarray(means[:, :3]), means[:, 3:].astype(np.float32)


def add_context(
    points: Float64[np.ndarray, "K 3"], parts: Float32[np.ndarray, "P K D"], *, radii: tuple[float, ...]
) -> Float32[np.ndarray, "K D"]:
    """Sum of each point's own part and of the means, within each of `radii`, of the parts made for that radius.

    Args:
        points: The described points, in cloud units.
        parts: Of each point, that for itself and those for the radii. The first becomes the sum.
        radii: In cloud units.
    """
    own, *others = parts
    if len(points) == 0:
        return own
    balls: dict[int, _Ball] = {}

    def prepare(one: slice) -> None:
        number = one.start
        radius = radii[number]
        balls[number] = _Ball.around(*cell_means(points, others[number], radius=radius), radius=radius)

    def add(part: slice) -> None:
        for number in range(len(radii)):
            own[part] += balls[number].means(points[part])

    for_each_block(prepare, len(radii), block=1)
    for_each_block(add, len(points), block=_BLOCK)
    return own


@intrinsic
@no_type_check
def _add_weighted(_context, vectors, rows, weights, count, first, means):
    """Add to 64 columns of `means`, from number `first` on, those of `count` rows of `vectors` times their weights."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        width = builder.extract_value(context.make_array(signature.args[0])(context, builder, args[0]).shape, 1)
        vectors, rows, weights, count, first, means = write.unpack(signature, args)
        columns = [builder.add(first, INT64(column)) for column in range(0, _COLUMNS, LANES)]
        sums = []
        for column in columns:
            value = write.load_each(means, column).value
            sums.append(cgutils.alloca_once(builder, value.type))
            builder.store(value, sums[-1])
        with write.steps(INT64(0), count, 1) as (i, _):
            start = builder.mul(builder.zext(builder.load(builder.gep(rows, [i])), INT64), width)
            weight = write.load(weights, i)
            for column, total in zip(columns, sums, strict=True):
                value = weight * write.load_each(vectors, builder.add(start, column))
                builder.store((Lanes(builder, builder.load(total)) + value).value, total)
        for column, total in zip(columns, sums, strict=True):
            write.store_each(Lanes(builder, builder.load(total)), means, column)
        return context.get_dummy_value()

    return types.none(vectors, rows, weights, count, first, means), generate


@njit(cache=True, nogil=True)
@no_type_check
def _fill_means(queries, columns, starts, shape, cell_size, radius, vectors, means):
    sq_radius = radius * radius
    size = _GATHERED + LANES
    near = (
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
    )
    weights = np.empty(size, np.float32)
    for k in range(len(queries)):
        px, py, pz = queries[k, 0], queries[k, 1], queries[k, 2]
        first_x, last_x = cell_range(px, radius, cell_size, shape[0])
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        mean = means[k]
        mean[:] = 0
        total = np.float32(0.0)
        count = 0
        for cz in range(first_z, last_z + 1):
            for cy in range(first_y, last_y + 1):
                row = (cz * shape[1] + cy) * shape[0]
                i, end = starts[row + first_x], starts[row + last_x + 1]
                while i < end:
                    stop = min(end, i + _RUN)
                    count = gather_offsets(columns, i, stop, queries[k], sq_radius, near, count)
                    i = stop
                    if count > _GATHERED - _RUN:
                        total += _add_near(near, count, sq_radius, vectors, weights, mean)
                        count = 0
        total += _add_near(near, count, sq_radius, vectors, weights, mean)
        if total > 0:
            for j in range(len(mean)):
                mean[j] /= total


@njit(nogil=True, fastmath=True)
@no_type_check
def _add_near(near, count, sq_radius, vectors, weights, mean):
    """Add the weighted vectors of what was gathered to `mean`; gives the sum of the weights."""
    total = np.float32(0.0)
    for i in range(count):
        sq_distance = near[0][i] * near[0][i] + near[1][i] * near[1][i] + near[2][i] * near[2][i]
        weights[i] = max(np.float32(1.0) - sq_distance / sq_radius, np.float32(0.0))
        total += weights[i]
    for first in range(0, len(mean), _COLUMNS):
        _add_weighted(vectors, near[3].view(np.int32), weights, count, first, mean)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fill_cell_means(points, vectors, order, starts, counts, means):
    for cell in range(len(starts)):
        mean = means[cell]
        mean[:] = 0
        for i in order[starts[cell] : starts[cell] + counts[cell]]:
            for j in range(3):
                mean[j] += points[i, j]
            for j in range(vectors.shape[1]):
                mean[3 + j] += vectors[i, j]
        for j in range(len(mean)):
            mean[j] /= counts[cell]

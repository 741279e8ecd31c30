"""Features averaged over the described points around each: what noise and sampling do to one, its neighbours mend."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit

from cgf.geometry.grid import build_grid, cell_range
from cgf.geometry.parallel import for_each_block
from cgf.geometry.sampling import sort_into_voxels

_BLOCK = 512
_CELLS_PER_RADIUS = 4


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
    grid = build_grid(points, cell_size=radius)
    sorted_vectors, queries = vectors[grid.order], grid.local(places)

    def fill(part: slice) -> None:
        _fill_means(queries[part], *grid.arguments(), np.float32(radius), sorted_vectors, pooled[part])

    for_each_block(fill, len(places), block=_BLOCK)
    return pooled


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
    cells = {}

    def fill(one: slice) -> None:
        number = one.start
        cells[number] = cell_means(points, others[number], radius=radii[number])

    for_each_block(fill, len(radii), block=1)
    for number, radius in enumerate(radii):
        own += pool_features(*cells[number], radius=radius, at=points)
    return own


@njit(cache=True, nogil=True, fastmath=True)
@no_type_check
def _fill_means(queries, xs, ys, zs, starts, shape, cell_size, radius, vectors, means):
    sq_radius = radius * radius
    for k in range(len(queries)):
        px, py, pz = queries[k, 0], queries[k, 1], queries[k, 2]
        first_x, last_x = cell_range(px, radius, cell_size, shape[0])
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        mean = means[k]
        mean[:] = 0
        total = np.float32(0.0)
        for cz in range(first_z, last_z + 1):
            for cy in range(first_y, last_y + 1):
                row = (cz * shape[1] + cy) * shape[0]
                for i in range(starts[row + first_x], starts[row + last_x + 1]):
                    dx, dy, dz = xs[i] - px, ys[i] - py, zs[i] - pz
                    sq_distance = dx * dx + dy * dy + dz * dz
                    if sq_distance < sq_radius:
                        weight = np.float32(1.0) - sq_distance / sq_radius
                        total += weight
                        for j in range(len(mean)):
                            mean[j] += weight * vectors[i, j]
        if total > 0:
            for j in range(len(mean)):
                mean[j] /= total


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

"""Features averaged over the described points around each: what noise and sampling do to one, its neighbours mend."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit

from cgf.geometry.grid import build_grid, cell_range
from cgf.geometry.parallel import for_each_block

_BLOCK = 512


def pool_features(
    points: Float64[np.ndarray, "K 3"], vectors: Float32[np.ndarray, "K D"], *, radius: float
) -> Float32[np.ndarray, "K D"]:
    """Mean of the vectors of all points within `radius` of each, weighted by 1 - (distance / radius)^2.

    Args:
        points: The described points, in cloud units.
        vectors: One per point.
        radius: In cloud units.
    """
    if len(points) == 0:
        return vectors
    grid = build_grid(points, cell_size=radius)
    sorted_vectors, queries = vectors[grid.order], grid.local(points)
    pooled = np.empty_like(vectors)

    def fill(part: slice) -> None:
        _fill_means(queries[part], *grid.arguments(), np.float32(radius), sorted_vectors, pooled[part])

    for_each_block(fill, len(points), block=_BLOCK)
    return pooled


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
        for j in range(len(mean)):
            mean[j] /= total

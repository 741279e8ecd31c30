"""Local reference frames: the axes in which a neighbourhood is described."""

from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numba import njit

from cgf.geometry.grid import Grid, build_grid, cell_range
from cgf.geometry.parallel import for_each_block

MIN_NEIGHBORS = 5
"""A frame needs this many neighbours besides the point itself (as in PCL's SHOT frame)."""

_BLOCK = 512


def estimate_lrf(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    indices: Int64[np.ndarray, "K"],
    *,
    radius: float,
    kind: Literal["normal", "paper"] = "normal",
) -> tuple[Float64[np.ndarray, "K 3 3"], Bool[np.ndarray, "K"]]:
    """Estimate a local reference frame at each of `indices`.

    Args:
        points: Finite, in cloud units.
        normals: Unit vectors, one per point, on the side of the sensor.
        indices: Rows of `points`.
        radius: Of the neighbourhood, in cloud units; the paper takes 2 % of the diameter.
        kind: `paper` has the axes of SHOT (Salti et al. 2014), all three negated where z opposes the normal, as
            the authors' program does; `normal` has the normal as z, and as x the largest axis of the same
            covariance, projected on the tangent plane.

    Returns:
        Frames, rows x, y, z; and which of them are defined (5 neighbours or more). Undefined rows hold zeros.

    Raises:
        ValueError: `radius` is not positive.
    """
    if not radius > 0:
        raise ValueError(f"radius must be positive, got {radius:g}")
    if len(indices) == 0:
        return np.zeros((0, 3, 3)), np.zeros(0, dtype=np.bool_)
    grid = build_grid(points, cell_size=radius / 2)
    queries, z_axes = grid.local(points[indices]), normals[indices]
    frames = np.empty((len(indices), 3, 3))
    defined = np.empty(len(indices), dtype=np.bool_)

    def fill(part: slice) -> None:
        frames[part], defined[part] = _frames(grid, queries[part], z_axes[part], np.float32(radius), kind)

    for_each_block(fill, len(indices), block=_BLOCK)
    return frames, defined


def _frames(
    grid: Grid,
    queries: Float32[np.ndarray, "K 3"],
    normals: Float64[np.ndarray, "K 3"],
    radius: np.float32,
    kind: Literal["normal", "paper"],
) -> tuple[Float64[np.ndarray, "K 3 3"], Bool[np.ndarray, "K"]]:
    """Frames at `queries`, whose normals are given, and which of them are defined."""
    covariances = np.zeros((len(queries), 3, 3))
    counts = np.zeros(len(queries), np.int64)
    _fill_covariances(queries, *grid.arguments(), radius, covariances, counts)
    defined = counts >= MIN_NEIGHBORS
    vectors = np.linalg.eigh(covariances)[1]  # columns, ascending eigenvalues

    def turned(axes: Float64[np.ndarray, "K 3"]) -> Float64[np.ndarray, "K 3"]:
        """Axes on the side where at least half of the neighbours lie.

        On an exact tie the five neighbours around the median distance vote, as in PCL's SHOT frame.
        """
        signs = np.ones(len(queries))
        _fill_signs(queries, *grid.arguments(), radius, axes, counts, signs)
        return axes * signs[:, None]

    x, z = np.ascontiguousarray(vectors[:, :, 2]), np.ascontiguousarray(vectors[:, :, 0])
    x = turned(x)
    if kind == "paper":
        z = turned(z)
        frames = np.stack([x, np.cross(z, x), z], axis=1)
        # Quirk: negating three axes makes these frames left-handed; pinned by the golden test of the histogram.
        frames[np.einsum("kd,kd->k", z, normals) < 0] *= -1
    else:
        z = normals
        x = x - np.einsum("kd,kd->k", x, z)[:, None] * z
        length = np.linalg.norm(x, axis=1)
        # A normal along the largest axis leaves no x: such a neighbourhood is a spike, not a surface.
        defined = defined & (length > 1e-6)
        x = x / np.where(length > 1e-6, length, 1.0)[:, None]
        frames = np.stack([x, np.cross(z, x), z], axis=1)
    frames[~defined] = 0.0
    return frames, defined


@njit(cache=True, nogil=True)
@no_type_check
def _fill_covariances(queries, xs, ys, zs, starts, shape, cell_size, radius, covariances, counts):
    sq_radius = radius * radius
    for k in range(len(queries)):
        px, py, pz = queries[k, 0], queries[k, 1], queries[k, 2]
        first_x, last_x = cell_range(px, radius, cell_size, shape[0])
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        xx = xy = xz = yy = yz = zz = total = 0.0
        count = 0
        for cz in range(first_z, last_z + 1):
            for cy in range(first_y, last_y + 1):
                row = (cz * shape[1] + cy) * shape[0]
                for i in range(starts[row + first_x], starts[row + last_x + 1]):
                    dx, dy, dz = xs[i] - px, ys[i] - py, zs[i] - pz
                    sq_distance = dx * dx + dy * dy + dz * dz
                    if sq_distance > sq_radius or sq_distance == 0.0:
                        continue
                    weight = np.float64(radius) - np.sqrt(np.float64(sq_distance))
                    ax, ay, az = np.float64(dx), np.float64(dy), np.float64(dz)
                    xx += weight * ax * ax
                    xy += weight * ax * ay
                    xz += weight * ax * az
                    yy += weight * ay * ay
                    yz += weight * ay * az
                    zz += weight * az * az
                    total += weight
                    count += 1
        counts[k] = count
        if total > 0.0:
            covariances[k, 0, 0], covariances[k, 1, 1], covariances[k, 2, 2] = xx / total, yy / total, zz / total
            covariances[k, 0, 1] = covariances[k, 1, 0] = xy / total
            covariances[k, 0, 2] = covariances[k, 2, 0] = xz / total
            covariances[k, 1, 2] = covariances[k, 2, 1] = yz / total


@njit(cache=True, nogil=True)
@no_type_check
def _fill_signs(queries, xs, ys, zs, starts, shape, cell_size, radius, axes, counts, signs):
    sq_radius = radius * radius
    for k in range(len(queries)):
        px, py, pz = queries[k, 0], queries[k, 1], queries[k, 2]
        ax, ay, az = axes[k, 0], axes[k, 1], axes[k, 2]
        first_x, last_x = cell_range(px, radius, cell_size, shape[0])
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        sides = np.empty(counts[k])
        sq_distances = np.empty(counts[k], np.float32)
        count = 0
        positive = 0
        for cz in range(first_z, last_z + 1):
            for cy in range(first_y, last_y + 1):
                row = (cz * shape[1] + cy) * shape[0]
                for i in range(starts[row + first_x], starts[row + last_x + 1]):
                    dx, dy, dz = xs[i] - px, ys[i] - py, zs[i] - pz
                    sq_distance = dx * dx + dy * dy + dz * dz
                    if sq_distance > sq_radius or sq_distance == 0.0:
                        continue
                    side = dx * ax + dy * ay + dz * az
                    sides[count] = side
                    sq_distances[count] = sq_distance
                    count += 1
                    if side >= 0.0:
                        positive += 1
        if 2 * positive < count:
            signs[k] = -1.0
        elif 2 * positive == count and count >= MIN_NEIGHBORS:
            # Insertion sort by distance: ties are rare, neighbourhoods small, and NumPy's sort compiles for seconds.
            for i in range(1, count):
                side, sq_distance, j = sides[i], sq_distances[i], i
                while j > 0 and sq_distances[j - 1] > sq_distance:
                    sides[j], sq_distances[j] = sides[j - 1], sq_distances[j - 1]
                    j -= 1
                sides[j], sq_distances[j] = side, sq_distance
            votes = 0
            for i in range(count // 2 - 2, count // 2 + 3):
                if sides[i] > 0.0:
                    votes += 1
            if votes < 3:
                signs[k] = -1.0

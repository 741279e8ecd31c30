"""Local reference frames: the axes in which a neighbourhood is described."""

from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numba import njit

from cgf.geometry.grid import build_grid, cell_range
from cgf.geometry.lanes import gather_offsets
from cgf.geometry.parallel import for_each_block

MIN_NEIGHBORS = 5
"""A frame needs this many neighbours besides the point itself (as in PCL's SHOT frame)."""

_BLOCK = 512
_ROTATIONS = 30
"""At most; about ten do."""


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
    grid = build_grid(points, cell_size=radius)
    queries, z_axes = grid.local(points[indices]), normals[indices]
    frames = np.zeros((len(indices), 3, 3))
    defined = np.zeros(len(indices), dtype=np.bool_)

    def fill(part: slice) -> None:
        _fill_frames(
            queries[part],
            z_axes[part],
            *grid.arguments(),
            np.float32(radius),
            kind == "paper",
            frames[part],
            defined[part],
        )

    for_each_block(fill, len(indices), block=_BLOCK)
    return frames, defined


@njit(cache=True, nogil=True)
@no_type_check
def _fill_frames(queries, normals, xs, ys, zs, starts, shape, cell_size, radius, is_paper, frames, defined):
    dx, dy, dz = np.empty(len(xs), np.float32), np.empty(len(xs), np.float32), np.empty(len(xs), np.float32)
    sq_distances = np.empty(len(xs), np.float32)
    for k in range(len(queries)):
        gathered = _gather_ball(queries[k], xs, ys, zs, starts, shape, cell_size, radius, dx, dy, dz)
        count = _keep_neighbors(dx, dy, dz, gathered, radius * radius, sq_distances)
        if count < MIN_NEIGHBORS:
            continue
        neighbors = dx[:count], dy[:count], dz[:count]
        z, x = _extreme_axes(_covariance(neighbors, sq_distances, radius))
        x = _scaled(x, _side(neighbors, sq_distances, x))
        normal = normals[k, 0], normals[k, 1], normals[k, 2]
        if is_paper:
            z = _scaled(z, _side(neighbors, sq_distances, z))
            y = _cross(z, x)
            if _dot(z, normal) < 0.0:
                # Quirk: this makes the frame left-handed; pinned by the golden test of the histogram.
                x, y, z = _scaled(x, -1.0), _scaled(y, -1.0), _scaled(z, -1.0)
        else:
            z = normal
            x = _sum(x, _scaled(z, -_dot(x, z)))
            length = np.sqrt(_dot(x, x))
            # A normal along the largest axis leaves no x: such a neighbourhood is a spike, not a surface.
            if length <= 1e-6:
                continue
            x = _scaled(x, 1.0 / length)
            y = _cross(z, x)
        for d in range(3):
            frames[k, 0, d], frames[k, 1, d], frames[k, 2, d] = x[d], y[d], z[d]
        defined[k] = True


@njit(cache=True, nogil=True)
@no_type_check
def _gather_ball(query, xs, ys, zs, starts, shape, cell_size, radius, dx, dy, dz):
    """Write the offsets of all points within the radius, and perhaps of some outside; return how many."""
    sq_radius = radius * radius
    first_x, last_x = cell_range(query[0], radius, cell_size, shape[0])
    first_y, last_y = cell_range(query[1], radius, cell_size, shape[1])
    first_z, last_z = cell_range(query[2], radius, cell_size, shape[2])
    count = 0
    for cz in range(first_z, last_z + 1):
        for cy in range(first_y, last_y + 1):
            row = (cz * shape[1] + cy) * shape[0]
            start, end = starts[row + first_x], starts[row + last_x + 1]
            count = gather_offsets((xs, ys, zs), start, end, query, sq_radius, (dx, dy, dz), count)
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _keep_neighbors(dx, dy, dz, count, sq_radius, sq_distances):
    """Move those within the radius together, without the point itself; return how many there are."""
    kept = 0
    for i in range(count):
        sq_distance = dx[i] * dx[i] + dy[i] * dy[i] + dz[i] * dz[i]
        dx[kept], dy[kept], dz[kept], sq_distances[kept] = dx[i], dy[i], dz[i], sq_distance
        kept += 0.0 < sq_distance <= sq_radius
    return kept


# Terms may be added in any order.
@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
@no_type_check
def _covariance(neighbors, sq_distances, radius):
    """Of the offsets, weighted by how far inside the radius they end; its entries xx, xy, xz, yy, yz, zz."""
    dx, dy, dz = neighbors
    xx = xy = xz = yy = yz = zz = total = 0.0
    for i in range(len(dx)):
        weight = np.float64(radius) - np.sqrt(np.float64(sq_distances[i]))
        x, y, z = np.float64(dx[i]), np.float64(dy[i]), np.float64(dz[i])
        xx += weight * x * x
        xy += weight * x * y
        xz += weight * x * z
        yy += weight * y * y
        yz += weight * y * z
        zz += weight * z * z
        total += weight
    scale = 1.0 / total if total > 0.0 else 0.0
    return xx * scale, xy * scale, xz * scale, yy * scale, yz * scale, zz * scale


@njit(cache=True, nogil=True)
@no_type_check
def _extreme_axes(covariance):
    """Unit axes of the smallest and of the largest variance, by Jacobi's rotations."""
    xx, xy, xz, yy, yz, zz = covariance
    least = 1e-17 * (xx + yy + zz)
    u, v, w = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    for _ in range(_ROTATIONS):
        if max(abs(xy), abs(xz), abs(yz)) <= least:
            break
        if abs(xy) > least:
            # The smaller of the two angles that make xy zero.
            half = 0.5 * (yy - xx)
            tangent = xy / (half + np.copysign(np.sqrt(half * half + xy * xy), half))
            cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine
            xx, yy, xy = xx - tangent * xy, yy + tangent * xy, 0.0
            xz, yz = cosine * xz - sine * yz, sine * xz + cosine * yz
            u, v = (
                _sum(_scaled(u, cosine), _scaled(v, -sine)),
                _sum(_scaled(u, sine), _scaled(v, cosine)),
            )
        # The next pair in turn.
        xx, yy, zz, xy, xz, yz = yy, zz, xx, yz, xy, xz
        u, v, w = v, w, u
    if xx > yy:
        xx, yy, u, v = yy, xx, v, u
    if yy > zz:
        yy, zz, v, w = zz, yy, w, v
    return u if xx <= yy else v, w


@njit(inline="always")
@no_type_check
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(inline="always")
@no_type_check
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(inline="always")
@no_type_check
def _sum(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(inline="always")
@no_type_check
def _scaled(a, factor):
    return factor * a[0], factor * a[1], factor * a[2]


@njit(cache=True, nogil=True)
@no_type_check
def _side(neighbors, sq_distances, axis):
    """1 if at least half of the neighbours lie on the side that the axis points to, else -1.

    On an exact tie the five neighbours around the median distance vote, as in PCL's SHOT frame.
    """
    dx, dy, dz = neighbors
    count = len(dx)
    positive = 0
    for i in range(count):
        positive += dx[i] * axis[0] + dy[i] * axis[1] + dz[i] * axis[2] >= 0.0
    if 2 * positive != count:
        return 1.0 if 2 * positive > count else -1.0
    # Insertion sort by distance: ties are rare, neighbourhoods small, and NumPy's sort compiles for seconds.
    nearest = np.arange(count)
    for i in range(1, count):
        neighbor, j = nearest[i], i
        while j > 0 and sq_distances[nearest[j - 1]] > sq_distances[neighbor]:
            nearest[j] = nearest[j - 1]
            j -= 1
        nearest[j] = neighbor
    votes = 0
    for j in range(count // 2 - 2, count // 2 + 3):
        i = nearest[j]
        votes += dx[i] * axis[0] + dy[i] * axis[1] + dz[i] * axis[2] > 0.0
    return 1.0 if votes >= 3 else -1.0

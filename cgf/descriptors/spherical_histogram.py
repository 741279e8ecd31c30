"""The spherical histogram of a neighbourhood: the input that the paper's network compresses (its section 4)."""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numba import njit

from cgf.descriptors.settings import AZIMUTH_BINS, ELEVATION_BINS, HISTOGRAM_BINS, RADIAL_BINS
from cgf.geometry.grid import Grid, axis_gap, build_grid, cell_range
from cgf.geometry.parallel import for_each_block

_BLOCK = 64
_HALF_SECTORS = 2 * AZIMUTH_BINS
_GATHERED = 2048
"""Candidates looked at together; they and their bins stay in the processor's first cache."""
_EDGE_COSINES = np.cos(np.arange(1, ELEVATION_BINS // 2 + 1) * np.pi / ELEVATION_BINS).astype(np.float32)
"""Of the elevation edges above the tangent plane; those below are their mirror images."""
_TURNS = np.arange(1, _HALF_SECTORS // 4) * np.pi / (_HALF_SECTORS // 2)
_TURN_COSINES, _TURN_SINES = np.cos(_TURNS).astype(np.float32), np.sin(_TURNS).astype(np.float32)
"""Of the edges between half sectors in the first quadrant; the others are mirror images."""


@dataclass(frozen=True, eq=False)
class HistogramGrid:
    """A cloud made ready for histograms of one support radius."""

    grid: Grid
    support_radius: float
    min_radius: float

    def histograms(
        self, centers: Float64[np.ndarray, "K 3"], frames: Float64[np.ndarray, "K 3 3"], *, soft: bool = False
    ) -> tuple[Float32[np.ndarray, "K 2244"], Int64[np.ndarray, "K"]]:
        """Histograms around `centers` in `frames`, each row summing to 1, and the number of neighbours.

        A bin holds its share of the neighbours; a centre itself is no neighbour. Rows without any hold zeros.

        Args:
            centers: In cloud units.
            frames: Rows are x, y, z.
            soft: Share each neighbour between the two nearest azimuth sectors, to the nearest half sector, so that a
                slightly turned frame changes little; else it counts in the one that it lies in, as in the paper.
        """
        rows, counts = self.nested_histograms(centers, frames, soft=soft, insets=(0,))
        return rows[:, 0], counts

    def nested_histograms(
        self,
        centers: Float64[np.ndarray, "K 3"],
        frames: Float64[np.ndarray, "K 3 3"],
        *,
        soft: bool,
        insets: tuple[int, ...],
    ) -> tuple[Float32[np.ndarray, "K S 2244"], Int64[np.ndarray, "K"]]:
        """Histograms of several supports around each centre, as `histograms` gives them, for little more than one.

        Args:
            centers: In cloud units.
            frames: Rows are x, y, z.
            soft: As for `histograms`.
            insets: Of each support, by how many shells it is smaller; see `nested_scales`.
        """
        shells = RADIAL_BINS - 1
        # Quirk: as in the authors' program, shell 0 is everything below `min_radius` and the other 16 are log-spaced
        # above it, where the paper's equation 1 has 17 above it; pinned by the golden test.
        growth = self.support_radius / self.min_radius
        edges = self.min_radius * growth ** (np.arange(-max(insets), shells) / shells)
        sq_edges = np.square(edges).astype(np.float32)
        centers_32, frames_32 = self.grid.local(centers), frames.astype(np.float32)
        rows = np.empty((len(centers), len(insets), HISTOGRAM_BINS), np.float32)
        counts = np.empty(len(centers), np.int64)

        def fill(part: slice) -> None:
            _fill_histograms(
                centers_32[part],
                frames_32[part],
                *self.grid.arguments(),
                np.float32(self.support_radius),
                sq_edges,
                soft,
                insets,
                rows[part],
                counts[part],
            )

        for_each_block(fill, len(centers), block=_BLOCK)
        return rows, counts


def nested_scales(insets: tuple[int, ...], *, support_radius: float, min_radius: float) -> tuple[float, ...]:
    """By what the lengths of supports are multiplied that are smaller by `insets` shells; their edges coincide."""
    growth = support_radius / min_radius
    return tuple(growth ** (-inset / (RADIAL_BINS - 1)) for inset in insets)


def histogram_grid(points: Float64[np.ndarray, "N 3"], *, support_radius: float, min_radius: float) -> HistogramGrid:
    """Prepare `points` for histograms.

    Args:
        points: Finite, in cloud units.
        support_radius: Of the sphere described, in cloud units; the paper takes 17 % of the diameter, or 1.2 m.
        min_radius: Everything nearer falls into the innermost shell; the paper takes 1.5 % of the diameter, or 0.1 m.

    Raises:
        ValueError: The radii are not positive and increasing.
    """
    if not 0 < min_radius < support_radius:
        raise ValueError(f"min_radius must lie between 0 and support_radius ({support_radius:g}), got {min_radius:g}")
    return HistogramGrid(build_grid(points, cell_size=support_radius / 4), support_radius, min_radius)


# No transcendental functions, tables or branches: comparisons with the edges, which the compiler does for several
# candidates at a time. What is no neighbour goes into a bin of its own.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
@no_type_check
def _find_bins(xs, ys, zs, count, center, frame, sq_radius, sq_edges, outside, bins):
    zero = np.float32(0.0)
    shells = np.int32(len(sq_edges) + 1)
    for i in range(count):
        dx, dy, dz = xs[i] - center[0], ys[i] - center[1], zs[i] - center[2]
        sq_distance = dx * dx + dy * dy + dz * dz
        x = dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]
        y = dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]
        z = dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2]
        shell = np.int32(0)
        for k in range(len(sq_edges)):
            shell += np.int32(sq_distance >= sq_edges[k])
        distance, height = np.sqrt(sq_distance), abs(z)
        steps = np.int32(0)
        for k in range(ELEVATION_BINS // 2):
            steps += np.int32(height > _EDGE_COSINES[k] * distance)
        elevation = np.int32(ELEVATION_BINS // 2) + (-steps if z >= zero else steps)
        # The first half sector begins at -x; they turn from there towards -y.
        along, across = abs(x), abs(y)
        steps = np.int32(0)
        for k in range(_HALF_SECTORS // 4 - 1):
            steps += np.int32(across * _TURN_COSINES[k] >= along * _TURN_SINES[k])
        half_sector = steps if (x >= zero) == (y >= zero) else np.int32(_HALF_SECTORS // 2 - 1) - steps
        half_sector += np.int32(_HALF_SECTORS // 2) * np.int32(y >= zero)
        found = shell + shells * (elevation + np.int32(ELEVATION_BINS) * half_sector)
        is_neighbor = sq_distance <= sq_radius and sq_distance > np.float32(1e-15)
        bins[i] = found if is_neighbor else outside


@njit(cache=True, nogil=True)
@no_type_check
def _fill_histograms(
    centers, frames, xs, ys, zs, starts, shape, cell_size, radius, sq_edges, soft, insets, rows, counts
):
    sq_radius = radius * radius
    near = np.empty((3, _GATHERED), np.float32)
    bins = np.empty(_GATHERED, np.int32)
    shells = len(sq_edges) + 1
    # Where candidates are counted that are no neighbours.
    outside = np.int32(_HALF_SECTORS * shells * ELEVATION_BINS)
    hits = np.empty(outside + 1, np.float32)
    for k in range(len(centers)):
        px, py, pz = centers[k, 0], centers[k, 1], centers[k, 2]
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        hits[:] = 0.0
        gathered = total = 0
        for cz in range(first_z, last_z + 1):
            gap_z = axis_gap(pz, cz, cell_size)
            for cy in range(first_y, last_y + 1):
                gap_y = axis_gap(py, cy, cell_size)
                # Only the part of this row of cells that the sphere reaches.
                sq_reach = sq_radius * np.float32(1.001) - gap_z * gap_z - gap_y * gap_y
                if sq_reach < 0.0:
                    continue
                first_x, last_x = cell_range(px, np.sqrt(sq_reach), cell_size, shape[0])
                if last_x < first_x:
                    continue
                cell = (cz * shape[1] + cy) * shape[0]
                i, end = starts[cell + first_x], starts[cell + last_x + 1]
                while i < end:
                    taken = min(end - i, _GATHERED - gathered)
                    _copy(xs[i : i + taken], near[0, gathered:])
                    _copy(ys[i : i + taken], near[1, gathered:])
                    _copy(zs[i : i + taken], near[2, gathered:])
                    i += taken
                    gathered += taken
                    if gathered == _GATHERED:
                        _find_bins(
                            near[0],
                            near[1],
                            near[2],
                            gathered,
                            centers[k],
                            frames[k],
                            sq_radius,
                            sq_edges,
                            outside,
                            bins,
                        )
                        for j in range(gathered):
                            hits[bins[j]] += np.float32(1.0)
                        total += gathered
                        gathered = 0
        _find_bins(near[0], near[1], near[2], gathered, centers[k], frames[k], sq_radius, sq_edges, outside, bins)
        for j in range(gathered):
            hits[bins[j]] += np.float32(1.0)
        counts[k] = total + gathered - int(hits[outside])
        for support in range(len(insets)):
            _add_half_sectors(hits, shells, shells - RADIAL_BINS - insets[support], soft, rows[k, support])


# One array a call: the compiler would have to rule out first that three of them overlap, and copies value by value.
@njit(cache=True, nogil=True)
@no_type_check
def _copy(values, copies):
    for i in range(len(values)):
        copies[i] = values[i]


@njit(cache=True, nogil=True)
@no_type_check
def _add_half_sectors(hits, shells, merged, soft, row):
    """The histogram of a support whose innermost shell is the first of `hits` and `merged` more."""
    # Triangles of two sectors' width around the middle of each, averaged over half sectors.
    outer, inner = (np.float32(0.25), np.float32(0.75)) if soft else (np.float32(0.0), np.float32(1.0))
    column = shells * ELEVATION_BINS
    total = np.float32(0.0)
    for sector in range(AZIMUTH_BINS):
        first, second = 2 * sector * column, (2 * sector + 1) * column
        before = (2 * sector - 1) % _HALF_SECTORS * column
        after = (2 * sector + 2) % _HALF_SECTORS * column
        for elevation in range(ELEVATION_BINS):
            start, to = elevation * shells, (sector * ELEVATION_BINS + elevation) * RADIAL_BINS
            for shell in range(RADIAL_BINS):
                j = start + merged + shell
                row[to + shell] = inner * (hits[first + j] + hits[second + j]) + outer * (
                    hits[before + j] + hits[after + j]
                )
            for j in range(start, start + merged):
                row[to] += inner * (hits[first + j] + hits[second + j]) + outer * (hits[before + j] + hits[after + j])
            for shell in range(RADIAL_BINS):
                total += row[to + shell]
    # Sums of quarters are exact.
    scale = np.float32(1.0) / max(total, np.float32(1.0))
    for j in range(len(row)):
        row[j] *= scale

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
_COLUMN = RADIAL_BINS * ELEVATION_BINS
_OUTSIDE = _HALF_SECTORS * _COLUMN
"""Where candidates are counted that are no neighbours."""
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
        shells = RADIAL_BINS - 1
        # Quirk: as in the authors' program, shell 0 is everything below `min_radius` and the other 16 are log-spaced
        # above it, where the paper's equation 1 has 17 above it; pinned by the golden test.
        edges = self.min_radius * (self.support_radius / self.min_radius) ** (np.arange(shells) / shells)
        sq_edges = np.square(edges).astype(np.float32)
        centers_32, frames_32 = self.grid.local(centers), frames.astype(np.float32)
        rows = np.empty((len(centers), HISTOGRAM_BINS), np.float32)
        counts = np.empty(len(centers), np.int64)

        def fill(part: slice) -> None:
            _fill_histograms(
                centers_32[part],
                frames_32[part],
                *self.grid.arguments(),
                np.float32(self.support_radius),
                sq_edges,
                soft,
                rows[part],
                counts[part],
            )

        for_each_block(fill, len(centers), block=_BLOCK)
        return rows, counts


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
def _find_bins(xs, ys, zs, count, center, frame, sq_radius, sq_edges, bins):
    zero = np.float32(0.0)
    for i in range(count):
        dx, dy, dz = xs[i] - center[0], ys[i] - center[1], zs[i] - center[2]
        sq_distance = dx * dx + dy * dy + dz * dz
        x = dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]
        y = dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]
        z = dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2]
        shell = np.int32(0)
        for k in range(RADIAL_BINS - 1):
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
        found = shell + np.int32(RADIAL_BINS) * (elevation + np.int32(ELEVATION_BINS) * half_sector)
        is_neighbor = sq_distance <= sq_radius and sq_distance > np.float32(1e-15)
        bins[i] = found if is_neighbor else np.int32(_OUTSIDE)


@njit(cache=True, nogil=True)
@no_type_check
def _fill_histograms(centers, frames, xs, ys, zs, starts, shape, cell_size, radius, sq_edges, soft, rows, counts):
    sq_radius = radius * radius
    near = np.empty((3, _GATHERED), np.float32)
    bins = np.empty(_GATHERED, np.int32)
    hits = np.empty(_OUTSIDE + 1, np.float32)
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
                            near[0], near[1], near[2], gathered, centers[k], frames[k], sq_radius, sq_edges, bins
                        )
                        for j in range(gathered):
                            hits[bins[j]] += np.float32(1.0)
                        total += gathered
                        gathered = 0
        _find_bins(near[0], near[1], near[2], gathered, centers[k], frames[k], sq_radius, sq_edges, bins)
        for j in range(gathered):
            hits[bins[j]] += np.float32(1.0)
        counts[k] = total + gathered - int(hits[_OUTSIDE])
        _add_half_sectors(hits, np.float32(1.0) / np.float32(max(counts[k], 1)), soft, rows[k])


# One array a call: the compiler would have to rule out first that three of them overlap, and copies value by value.
@njit(cache=True, nogil=True)
@no_type_check
def _copy(values, copies):
    for i in range(len(values)):
        copies[i] = values[i]


@njit(cache=True, nogil=True)
@no_type_check
def _add_half_sectors(hits, scale, soft, row):
    # Triangles of two sectors' width around the middle of each, averaged over half sectors.
    outer = np.float32(0.25) * scale if soft else np.float32(0.0)
    inner = np.float32(0.75) * scale if soft else scale
    for sector in range(AZIMUTH_BINS):
        first, second = 2 * sector * _COLUMN, (2 * sector + 1) * _COLUMN
        before = (2 * sector - 1) % _HALF_SECTORS * _COLUMN
        after = (2 * sector + 2) % _HALF_SECTORS * _COLUMN
        for j in range(_COLUMN):
            row[sector * _COLUMN + j] = inner * (hits[first + j] + hits[second + j]) + outer * (
                hits[before + j] + hits[after + j]
            )

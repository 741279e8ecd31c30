"""The spherical histogram of a neighbourhood: the input that the paper's network compresses (its section 4)."""

from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numba import njit

from cgf.descriptors.histogram_bins import HALF_SECTORS, fill_channels, fill_steps, find_bins, find_tilts, padded_edges
from cgf.descriptors.settings import (
    AZIMUTH_BINS,
    CHANNELS,
    COLUMN_BINS,
    ELEVATION_BINS,
    HISTOGRAM_BINS,
    RADIAL_BINS,
    TILT_STEPS,
)
from cgf.descriptors.tile_layout import DEPTH, EDGE, HISTOGRAM_STEPS, INNERMOST_STEP, STEPS_OF_ELEVATION, Tiles
from cgf.geometry.grid import Grid, axis_gap, build_grid, cell_range
from cgf.geometry.lanes import LANES, gather_offsets, rounded, scale_counts
from cgf.geometry.normals import unit_normals
from cgf.geometry.parallel import for_each_block

_BLOCK = 64
assert RADIAL_BINS == LANES + 1  # all shells but the innermost are scaled together
_GATHERED = 1024
"""Neighbours looked at together; they and their bins stay in the processor's first cache."""
_RUN = 256
"""Points gathered in one go."""
_NO_ROWS = np.empty((0, 0, 0), np.float32)
_NO_TILES = Tiles(np.empty((0, 0, 0, 0, 0), np.uint16), np.empty((0, 0, 0), np.bool_))
"""Where histograms are not to be written."""


@dataclass(frozen=True, eq=False)
class HistogramGrid:
    """A cloud made ready for histograms of one support radius."""

    grid: Grid
    support_radius: float
    min_radius: float
    normals: Float32[np.ndarray, "3 M"] | None = None
    """In the order of the grid; histograms are oriented where there are any."""

    def histograms(
        self, centers: Float64[np.ndarray, "K 3"], frames: Float64[np.ndarray, "K 3 3"], *, soft: bool = False
    ) -> tuple[Float32[np.ndarray, "K B"], Int64[np.ndarray, "K"]]:
        """Histograms around `centers` in `frames`, each row of 2,244 summing to 1, and the number of neighbours.

        A bin holds its share of the neighbours; a centre itself is no neighbour. Rows without any hold zeros.

        An oriented histogram holds four times 187 values for each of 12 azimuth sectors: the square roots of shares;
        then, times these roots, means of the components of the neighbours' normals along z, away from the z axis and
        around it. Components are told to a 31st.

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
        room: Float32[np.ndarray, "_"] | None = None,
    ) -> tuple[Float32[np.ndarray, "K S B"], Int64[np.ndarray, "K"]]:
        """Histograms of several supports around each centre, as `histograms` gives them, for little more than one.

        Args:
            centers: In cloud units.
            frames: Rows are x, y, z.
            soft: As for `histograms`.
            insets: Of each support, by how many shells it is smaller; see `nested_scales`.
            room: Memory for the histograms; new memory, which takes about as long to get as to fill, if None.
        """
        size = HISTOGRAM_BINS * (1 if self.normals is None else CHANNELS)
        shape = (len(centers), len(insets), size)
        rows = np.empty(shape, np.float32) if room is None else room[: np.prod(shape)].reshape(shape)
        counts = np.empty(len(centers), np.int64)

        def fill(part: slice) -> None:
            self._fill(centers[part], frames[part], soft, insets, rows[part], _NO_TILES, counts[part])

        for_each_block(fill, len(centers), block=_BLOCK)
        return rows, counts

    def fill_tiles(
        self,
        centers: Float64[np.ndarray, "K 3"],
        frames: Float64[np.ndarray, "K 3 3"],
        *,
        soft: bool,
        insets: tuple[int, ...],
        tiles: Tiles,
    ) -> Int64[np.ndarray, "K"]:
        """Write oriented histograms as `nested_histograms` gives them, one support after the other, into `tiles`.

        They are rounded to bfloat16, and ordered as `histogram_order` says; see `histogram_room`. Gives the numbers of
        neighbours.

        Raises:
            ValueError: There are no normals, or `tiles` are too few.
        """
        if self.normals is None:
            raise ValueError("points must have normals, got none; give them to histogram_grid")
        if len(tiles.numbers) * EDGE < len(centers) * len(insets):
            raise ValueError(
                f"tiles must hold {len(centers) * len(insets)} histograms, got {len(tiles.numbers)} blocks of {EDGE}; "
                "get them from histogram_room"
            )
        counts = np.empty(len(centers), np.int64)
        tiles.used[:] = False
        self._fill(centers, frames, soft, insets, _NO_ROWS, tiles, counts)
        return counts

    def _fill(
        self,
        centers: Float64[np.ndarray, "K 3"],
        frames: Float64[np.ndarray, "K 3 3"],
        soft: bool,
        insets: tuple[int, ...],
        rows: Float32[np.ndarray, "R S B"],
        tiles: Tiles,
        counts: Int64[np.ndarray, "K"],
    ) -> None:
        sq_edges, edges = _edges_of(max(insets), self.support_radius, self.min_radius)
        _fill_histograms(
            self.grid.local(centers), frames.astype(np.float32),
            tuple(self.grid.xyz), None if self.normals is None else tuple(self.normals), *self.grid.cells(),
            np.float32(self.support_radius), sq_edges, edges, soft, insets,
            rows, tiles.numbers.reshape(-1), tiles.used, counts,
        )  # fmt: skip


def shell_edges(inset: int, *, support_radius: float, min_radius: float) -> Float64[np.ndarray, "E"]:
    """Radii between the shells of a support and of the one `inset` shells smaller; `support_radius` ends the last."""
    # Quirk: as in the authors' program, shell 0 is everything below `min_radius` and the other 16 are log-spaced
    # above it, where the paper's equation 1 has 17 above it; pinned by the golden test.
    shells = RADIAL_BINS - 1
    return np.asarray(min_radius * (support_radius / min_radius) ** (np.arange(-inset, shells) / shells))


@lru_cache(maxsize=16)
def _edges_of(inset: int, support_radius: float, min_radius: float) -> tuple[Float32[np.ndarray, "P"], int]:
    """The edges as `find_bins` takes them, and how many there are; asked for again with every few points."""
    edges = shell_edges(inset, support_radius=support_radius, min_radius=min_radius)
    return padded_edges(np.square(edges).astype(np.float32)), len(edges)


def nested_scales(insets: tuple[int, ...], *, support_radius: float, min_radius: float) -> tuple[float, ...]:
    """By what the lengths of supports are multiplied that are smaller by `insets` shells; their edges coincide."""
    growth = support_radius / min_radius
    return tuple(growth ** (-inset / (RADIAL_BINS - 1)) for inset in insets)


def histogram_grid(
    points: Float64[np.ndarray, "N 3"],
    *,
    support_radius: float,
    min_radius: float,
    normals: Float64[np.ndarray, "N 3"] | None = None,
) -> HistogramGrid:
    """Prepare `points` for histograms.

    Args:
        points: Finite, in cloud units.
        support_radius: Of the sphere described, in cloud units; the paper takes 17 % of the diameter, or 1.2 m.
        min_radius: Everything nearer falls into the innermost shell; the paper takes 1.5 % of the diameter, or 0.1 m.
        normals: Make the histograms oriented. Of any length; those of none, or NaN, have no components.

    Raises:
        ValueError: The radii are not positive and increasing.
    """
    if not 0 < min_radius < support_radius:
        raise ValueError(f"min_radius must lie between 0 and support_radius ({support_radius:g}), got {min_radius:g}")
    grid = build_grid(points, cell_size=support_radius / 4)
    if normals is None:
        return HistogramGrid(grid, support_radius, min_radius)
    return HistogramGrid(grid, support_radius, min_radius, grid.sorted_columns(unit_normals(normals)))


@njit(cache=True, nogil=True)
@no_type_check
def _fill_histograms(
    centers,
    frames,
    points,
    normals,
    starts,
    shape,
    cell_size,
    radius,
    sq_edges,
    edges,
    soft,
    insets,
    rows,
    tiles,
    used,
    counts,
):
    sq_radius = radius * radius
    size = _GATHERED + LANES
    offsets = (np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32))
    bins = np.empty(size, np.uint32)
    shells = edges + 1
    columns = ELEVATION_BINS * shells
    size_of_row = HISTOGRAM_BINS * CHANNELS
    if normals is None:
        hits = np.empty(HALF_SECTORS * columns + 1, np.int32)
        quarters = np.empty((AZIMUTH_BINS, columns), np.int32)
    else:
        tilts = (np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32))
        low, high = np.empty(size, np.int64), np.empty(size, np.int64)
        sums = np.empty((HALF_SECTORS * columns + 1, CHANNELS // 2), np.int64)
        quarters = np.empty((AZIMUTH_BINS, columns * CHANNELS), np.int32)
    for k in range(len(centers)):
        px, py, pz = centers[k, 0], centers[k, 1], centers[k, 2]
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        if normals is None:
            hits[:] = 0
        else:
            sums[:] = 0
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
                    stop = min(end, i + _RUN)
                    if normals is None:
                        gathered = gather_offsets(points, i, stop, centers[k], sq_radius, offsets, gathered)
                    else:
                        gathered = gather_offsets(
                            points + normals, i, stop, centers[k], sq_radius, offsets + tilts, gathered
                        )
                    i = stop
                    if gathered > _GATHERED - _RUN:
                        find_bins(*offsets, gathered, frames[k], sq_radius, sq_edges, edges, bins)
                        if normals is None:
                            _count_hits(bins, gathered, hits)
                        else:
                            _add_tilts(offsets, tilts, gathered, frames[k], bins, low, high, sums)
                        total += gathered
                        gathered = 0
        find_bins(*offsets, gathered, frames[k], sq_radius, sq_edges, edges, bins)
        if normals is None:
            _count_hits(bins, gathered, hits)
            counts[k] = total + gathered - hits[-1]
            _add_half_sectors(hits[:-1].reshape(HALF_SECTORS, -1), soft, quarters)
            for support in range(len(insets)):
                _cut_support(quarters.reshape(-1), shells, counts[k], insets[support], rows[k, support])
        else:
            _add_tilts(offsets, tilts, gathered, frames[k], bins, low, high, sums)
            # Two sums of 32 bits in each number, the lower half first.
            counts[k] = total + gathered - (sums[-1, 0] & 0xFFFFFFFF)
            _add_half_sectors(sums[:-1].reshape(-1).view(np.int32).reshape(HALF_SECTORS, -1), soft, quarters)
            for support in range(len(insets)):
                number = k * len(insets) + support
                row = rows.reshape(-1)[number * size_of_row : (number + 1) * size_of_row]
                block, place = divmod(number, EDGE)
                to = (block * AZIMUTH_BINS * HISTOGRAM_STEPS * EDGE + place) * DEPTH
                _cut_oriented(quarters.reshape(-1), shells, counts[k], insets[support], row, tiles, to, used, block)


@njit(cache=True, nogil=True)
@no_type_check
def _count_hits(bins, count, hits):
    for i in range(count):
        hits[bins[i]] += 1


@njit(cache=True, nogil=True)
@no_type_check
def _add_tilts(offsets, normals, count, frame, bins, low, high, sums):
    find_tilts(offsets, normals, count, frame, low, high)
    for i in range(count):
        sums[bins[i], 0] += low[i]
        sums[bins[i], 1] += high[i]


@njit(cache=True, nogil=True)
@no_type_check
def _add_half_sectors(hits, soft, quarters):
    """Four times what each sector counts."""
    for sector in range(AZIMUTH_BINS):
        i = 2 * sector
        before, first, second, after = hits[i - 1], hits[i], hits[i + 1], hits[(i + 2) % HALF_SECTORS]
        column = quarters[sector]
        if soft:
            # Triangles of two sectors' width around the middle of each, averaged over half sectors.
            for j in range(len(column)):
                within = first[j] + second[j]
                column[j] = within + within + within + before[j] + after[j]
        else:
            for j in range(len(column)):
                column[j] = (first[j] + second[j]) << np.int32(2)


@njit(cache=True, nogil=True)
@no_type_check
def _cut_support(quarters, shells, count, inset, row):
    """The histogram of the support without the `inset` outer shells, whose innermost has all that are left over."""
    total = 4 * count
    if inset > 0:
        for start in range(0, len(quarters), shells):
            for j in range(start + shells - inset, start + shells):
                total -= quarters[j]
    scale = np.float32(1.0) / np.float32(max(total, 1))
    innermost = shells - inset - RADIAL_BINS
    for start in range(0, len(quarters), shells):
        to = start // shells * RADIAL_BINS
        merged = np.int32(0)
        for j in range(start, start + innermost + 1):
            merged += quarters[j]
        row[to] = scale * np.float32(merged)
        scale_counts(quarters, start + innermost + 1, scale, row, to + 1)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _cut_oriented(quarters, shells, count, inset, row, tiles, to, used, block):
    """As `_cut_support`, of sums that stand together for each bin; or into the row of `tiles` that begins at `to`.

    What is not zero is marked in `used[block]`.
    """
    total = 4 * count
    if inset > 0:
        for start in range(0, len(quarters), shells * CHANNELS):
            for j in range(start + (shells - inset) * CHANNELS, start + shells * CHANNELS, CHANNELS):
                total -= quarters[j]
    scale = np.float32(1.0) / np.float32(max(total, 1))
    surplus = shells - inset - RADIAL_BINS
    step = np.float32(1.0 / TILT_STEPS)
    for place in range(AZIMUTH_BINS * ELEVATION_BINS):
        start = place * shells * CHANNELS
        sector, elevation = divmod(place, ELEVATION_BINS)
        innermost = np.int32(0)
        for j in range(start, start + (surplus + 1) * CHANNELS, CHANNELS):
            innermost += quarters[j]
        root = part = merged = np.float32(0.0)
        along, away, around = np.int32(0), np.int32(0), np.int32(0)
        # A surface leaves most of them empty.
        if innermost > 0:
            for j in range(start, start + (surplus + 1) * CHANNELS, CHANNELS):
                along += quarters[j + 1]
                away += quarters[j + 2]
                around += quarters[j + 3]
            merged = np.float32(innermost)
            root = np.sqrt(scale * merged)
            part = scale / root
        along_z = part * (step * np.float32(along) - merged)
        off_axis = part * (step * np.float32(away) - merged)
        around_axis = part * (step * np.float32(around) - merged)
        first = start + (surplus + 1) * CHANNELS
        if len(tiles) == 0:
            at = sector * COLUMN_BINS * CHANNELS + elevation * RADIAL_BINS
            row[at] = root
            row[at + COLUMN_BINS] = along_z
            row[at + 2 * COLUMN_BINS] = off_axis
            row[at + 3 * COLUMN_BINS] = around_axis
            fill_channels(quarters, first, scale, row, at + 1, COLUMN_BINS)
        else:
            column = to + sector * HISTOGRAM_STEPS * EDGE * DEPTH
            after = elevation * CHANNELS
            step_of_innermost, step_of_others = INNERMOST_STEP + after // DEPTH, elevation * STEPS_OF_ELEVATION
            at = column + step_of_innermost * EDGE * DEPTH + after % DEPTH
            tiles[at] = rounded(root)
            tiles[at + 1] = rounded(along_z)
            tiles[at + 2] = rounded(off_axis)
            tiles[at + 3] = rounded(around_axis)
            if innermost > 0:
                used[block, sector, step_of_innermost] = True
            if fill_steps(quarters, first, scale, tiles, column + step_of_others * EDGE * DEPTH):
                used[block, sector, step_of_others : step_of_others + STEPS_OF_ELEVATION] = True

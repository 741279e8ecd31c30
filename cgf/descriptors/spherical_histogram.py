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
_TABLE_SIZE = 1024
_SIN_30, _SIN_60 = np.float32(0.5), np.float32(np.sqrt(0.75))


@dataclass(frozen=True, eq=False)
class HistogramGrid:
    """A cloud made ready for histograms of one support radius."""

    grid: Grid
    support_radius: float
    min_radius: float

    def histograms(
        self, centers: Float64[np.ndarray, "K 3"], frames: Float64[np.ndarray, "K 3 3"]
    ) -> tuple[Float32[np.ndarray, "K 2244"], Int64[np.ndarray, "K"]]:
        """Histograms around `centers` in `frames`, each row summing to 1, and the number of neighbours.

        A bin holds its share of the neighbours; a centre itself is no neighbour. Rows without any hold zeros.
        """
        sq_edges, radial_table = _radial_table(self.support_radius, self.min_radius)
        cosines, elevation_table = _elevation_table()
        centers_32, frames_32 = self.grid.local(centers), frames.astype(np.float32)
        rows = np.zeros((len(centers), HISTOGRAM_BINS), np.float32)
        counts = np.zeros(len(centers), np.int64)

        def fill(part: slice) -> None:
            _fill_histograms(
                centers_32[part],
                frames_32[part],
                *self.grid.arguments(),
                np.float32(self.support_radius),
                sq_edges,
                radial_table,
                cosines,
                elevation_table,
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


def _radial_table(support_radius: float, min_radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared outer edges of the shells but the last, and the shell at the lower end of each table cell.

    Quirk: as in the authors' program, shell 0 is everything below `min_radius` and the other 16 are log-spaced
    above it, where the paper's equation 1 has 17 above it; pinned by the golden test.
    """
    shells = RADIAL_BINS - 1
    edges = min_radius * (support_radius / min_radius) ** (np.arange(shells) / shells)
    lower = np.arange(_TABLE_SIZE + 1) / _TABLE_SIZE * support_radius**2
    return (edges**2).astype(np.float32), np.searchsorted(edges**2, lower, side="right").astype(np.int32)


def _elevation_table() -> tuple[np.ndarray, np.ndarray]:
    """Cosines of the inner elevation edges, descending, and the bin at the upper end of each table cell."""
    cosines = np.cos(np.arange(1, ELEVATION_BINS) * np.pi / ELEVATION_BINS)
    upper = (np.arange(_TABLE_SIZE + 1) + 1) / (_TABLE_SIZE / 2) - 1
    return cosines.astype(np.float32), (upper[:, None] <= cosines).sum(axis=1).astype(np.int32)


@njit(inline="always")
@no_type_check
def _sector(x, y):
    """Azimuth bin of a direction: 30 degrees each, the first begins at -x and they turn from there towards -y."""
    half = 0
    if y >= 0.0:
        half = AZIMUTH_BINS // 2
    else:
        x, y = -x, -y
    return (
        half
        + (y * _SIN_60 >= x * _SIN_30)
        + (y * _SIN_30 >= x * _SIN_60)
        + (x <= 0.0)
        + (-y * _SIN_30 >= x * _SIN_60)
        + (-y * _SIN_60 >= x * _SIN_30)
    )


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
@no_type_check
def _fill_histograms(
    centers,
    frames,
    xs,
    ys,
    zs,
    starts,
    shape,
    cell_size,
    radius,
    sq_edges,
    radial_table,
    cosines,
    elevation_table,
    rows,
    counts,
):
    sq_radius = radius * radius
    radial_scale = np.float32(_TABLE_SIZE) / sq_radius
    half_table = np.float32(_TABLE_SIZE // 2)
    for k in range(len(centers)):
        px, py, pz = centers[k, 0], centers[k, 1], centers[k, 2]
        xx, xy, xz = frames[k, 0, 0], frames[k, 0, 1], frames[k, 0, 2]
        yx, yy, yz = frames[k, 1, 0], frames[k, 1, 1], frames[k, 1, 2]
        zx, zy, zz = frames[k, 2, 0], frames[k, 2, 1], frames[k, 2, 2]
        first_y, last_y = cell_range(py, radius, cell_size, shape[1])
        first_z, last_z = cell_range(pz, radius, cell_size, shape[2])
        row = rows[k]
        count = 0
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
                for i in range(starts[cell + first_x], starts[cell + last_x + 1]):
                    dx, dy, dz = xs[i] - px, ys[i] - py, zs[i] - pz
                    sq_distance = dx * dx + dy * dy + dz * dz
                    if sq_distance > sq_radius or sq_distance <= np.float32(1e-15):
                        continue
                    shell = radial_table[int(sq_distance * radial_scale)]
                    while shell < RADIAL_BINS - 1 and sq_distance >= sq_edges[shell]:
                        shell += 1
                    cosine = (dx * zx + dy * zy + dz * zz) / np.sqrt(sq_distance)
                    elevation = elevation_table[max(min(int((cosine + np.float32(1.0)) * half_table), _TABLE_SIZE), 0)]
                    while elevation < ELEVATION_BINS - 1 and cosine <= cosines[elevation]:
                        elevation += 1
                    sector = _sector(dx * xx + dy * xy + dz * xz, dx * yx + dy * yy + dz * yz)
                    row[shell + RADIAL_BINS * (elevation + ELEVATION_BINS * sector)] += np.float32(1.0)
                    count += 1
        counts[k] = count
        if count > 0:
            row /= np.float32(count)

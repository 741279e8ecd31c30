"""The spherical histogram by its formula, as a first version would compute it."""

from typing import no_type_check

import numpy as np
from numba import njit

from cgf.descriptors.settings import AZIMUTH_BINS, ELEVATION_BINS, HISTOGRAM_BINS, RADIAL_BINS


def find_neighbors(points: np.ndarray, centers: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `points` around each centre, end to end, and where those of each begin."""
    from scipy.spatial import cKDTree

    found = cKDTree(points).query_ball_point(centers, radius, return_sorted=False)
    starts = np.zeros(len(centers) + 1, np.int64)
    np.cumsum([len(rows) for rows in found], out=starts[1:])
    return np.concatenate([np.array(rows, np.int64) for rows in found]), starts


@njit(cache=True)
@no_type_check
def straight_histograms(points, centers, frames, neighbors, starts, support_radius, min_radius):
    """Logarithm, arc cosine and arc tangent, one neighbour at a time; rows sum to 1."""
    rows = np.zeros((len(centers), HISTOGRAM_BINS), np.float32)
    gain = (RADIAL_BINS - 1) / np.log(support_radius / min_radius)
    for k in range(len(centers)):
        count = 0
        for i in neighbors[starts[k] : starts[k + 1]]:
            dx, dy, dz = points[i, 0] - centers[k, 0], points[i, 1] - centers[k, 1], points[i, 2] - centers[k, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if distance == 0 or distance > support_radius:
                continue
            x = frames[k, 0, 0] * dx + frames[k, 0, 1] * dy + frames[k, 0, 2] * dz
            y = frames[k, 1, 0] * dx + frames[k, 1, 1] * dy + frames[k, 1, 2] * dz
            z = frames[k, 2, 0] * dx + frames[k, 2, 1] * dy + frames[k, 2, 2] * dz
            shell = min(max(int(gain * np.log(distance / min_radius) + 1), 0), RADIAL_BINS - 1)
            cosine = min(max(z / distance, -1.0), 1.0)
            elevation = min(int(ELEVATION_BINS * np.arccos(cosine) / np.pi), ELEVATION_BINS - 1)
            azimuth = min(int(AZIMUTH_BINS * (np.arctan2(y, x) + np.pi) / (2 * np.pi)), AZIMUTH_BINS - 1)
            rows[k, shell + RADIAL_BINS * (elevation + ELEVATION_BINS * azimuth)] += 1
            count += 1
        if count:
            rows[k] /= count
    return rows

"""Which clouds overlap: the paper's section 5, with eps the largest of the median point spacings."""

from itertools import combinations

import numpy as np

from cgf.geometry.neighbors import median_spacing, nearest
from cgf.types import PointCloud


def overlapping_pairs(clouds: list[PointCloud], *, least: float = 0.3) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of aligned clouds that overlap by `least`, from both sides.

    Args:
        clouds: In one common frame.
        least: Share of the points of either cloud that must lie within eps of the other.
    """
    if not clouds:
        return []
    eps = max(median_spacing(cloud.points) for cloud in clouds)
    pairs = []
    for i, j in combinations(range(len(clouds)), 2):
        if _share_within(clouds[i], clouds[j], eps) >= least and _share_within(clouds[j], clouds[i], eps) >= least:
            pairs.append((i, j))
    return pairs


def _share_within(cloud: PointCloud, other: PointCloud, eps: float) -> float:
    """Share of the points of `cloud` with a point of `other` within `eps` (alpha in the paper)."""
    return float(np.mean(nearest(other.points, cloud.points)[1] <= eps))

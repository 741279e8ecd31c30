"""What every estimator reports about the motion it found."""

import math

import numpy as np
from jaxtyping import Float64

from cgf.geometry import transforms
from cgf.geometry.neighbors import build_tree
from cgf.types import PointCloud, RegistrationResult


def nothing_found(method: str) -> RegistrationResult:
    """The result of an estimator that found no motion."""
    return RegistrationResult(None, np.zeros(0, dtype=np.int64), 0.0, math.nan, method)


def surface_agreement(
    source: PointCloud, target: PointCloud, target_from_source: Float64[np.ndarray, "4 4"], inlier_distance: float
) -> tuple[float, float]:
    """Share of moved source points with a target point within `inlier_distance`, and their RMS distance to it."""
    moved = transforms.apply(target_from_source, source.points)
    distances, _ = build_tree(target.points).query(moved, distance_upper_bound=inlier_distance, workers=-1)
    near = distances[np.isfinite(distances)]
    if not len(near):
        return 0.0, math.nan
    return len(near) / len(source), float(np.sqrt(np.mean(near**2)))

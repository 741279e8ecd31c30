"""Rigid motions in closed form."""

import numpy as np
from jaxtyping import Float64

from cgf.geometry import transforms


def fit_rigid(
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    weights: Float64[np.ndarray, "C"] | None = None,
) -> Float64[np.ndarray, "4 4"]:
    """The rigid motion with the least sum of squared residuals (Kabsch 1976; Umeyama 1991 for the sign).

    Args:
        source_points: One or more, in cloud units.
        target_points: Where they should come to lie, row by row.
        weights: Of the squared residuals, 0 or more and not all 0; None weighs all alike.
    """
    source_center = np.average(source_points, axis=0, weights=weights)
    target_center = np.average(target_points, axis=0, weights=weights)
    arms = source_points - source_center
    if weights is not None:
        arms *= weights[:, None]
    rotation = fit_rotations(arms[None], (target_points - target_center)[None])[0]
    return transforms.rigid(rotation, target_center - rotation @ source_center)


def fit_rotations(
    source_samples: Float64[np.ndarray, "S K 3"], target_samples: Float64[np.ndarray, "S K 3"]
) -> Float64[np.ndarray, "S 3 3"]:
    """The rotation of each sample, whose points are relative to their centre; never a reflection."""
    u, _, vt = np.linalg.svd(np.einsum("ski,skj->sij", target_samples, source_samples))
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    return np.asarray(u @ vt)

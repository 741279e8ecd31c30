"""Measures of correspondences and of motions under a known pose.

Thresholds are arguments everywhere; what papers call them is in the docstrings.
"""

import math

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.typing import ArrayLike

from cgf.checks import check_positive
from cgf.geometry import transforms
from cgf.geometry.neighbors import overlap_mask


def correspondence_errors(
    source_points: Float64[np.ndarray, "N 3"],
    target_points: Float64[np.ndarray, "M 3"],
    indices: Int64[np.ndarray, "C 2"],
    target_from_source: Float64[np.ndarray, "4 4"],
) -> Float64[np.ndarray, "C"]:
    """Distance from each moved source point to the target point it was matched with, in cloud units.

    Args:
        source_points: All points of the source.
        target_points: All points of the target.
        indices: Source row, target row of each correspondence.
        target_from_source: The true pose.
    """
    moved = transforms.apply(target_from_source, source_points[indices[:, 0]])
    return np.asarray(np.linalg.norm(moved - target_points[indices[:, 1]], axis=1))


def has_partner(
    source_points: Float64[np.ndarray, "N 3"],
    target_points: Float64[np.ndarray, "M 3"],
    target_from_source: Float64[np.ndarray, "4 4"],
    *,
    tau: float,
) -> Bool[np.ndarray, "N"]:
    """Which source points have any target point within `tau` under the true pose.

    The others cannot be matched rightly, whatever the feature; the paper's figure draws them grey.
    """
    return overlap_mask(transforms.apply(target_from_source, source_points), target_points, tau)


def precision(errors: Float64[np.ndarray, "C"], *, threshold: float) -> float:
    """Share of errors of at most `threshold`; nan where there are none.

    The paper's precision leaves out points without a true partner: pass `errors[partner]` for that. The inlier ratio
    counts all of them: pass all.
    """
    return float(precision_curve(errors, [threshold])[0])


def precision_curve(errors: Float64[np.ndarray, "C"], thresholds: ArrayLike) -> Float64[np.ndarray, "X"]:
    """Precision at every one of `thresholds` (1-D, in cloud units), as in the paper's precision figures."""
    limits = np.asarray(thresholds, dtype=np.float64)
    if not len(errors):
        return np.full(len(limits), np.nan)
    return np.asarray(np.searchsorted(np.sort(errors), limits, side="right") / len(errors))


def feature_matching_recall(inlier_ratios: ArrayLike, *, threshold: float = 0.05) -> float:
    """Share of pairs whose inlier ratio exceeds `threshold` (Deng et al., PPFNet, 2018); nan without pairs.

    A pair without any correspondence (nan) counts as one that failed.
    """
    ratios = np.asarray(inlier_ratios, dtype=np.float64)
    return float(np.mean(ratios > threshold)) if len(ratios) else math.nan


def registration_rmse(
    estimate: Float64[np.ndarray, "4 4"],
    truth: Float64[np.ndarray, "4 4"],
    information: Float64[np.ndarray, "6 6"],
) -> float:
    """Root mean square distance between true correspondences after the estimate, from `gt.info`.

    Choi, Zhou and Koltun (2015), as the 3DMatch evaluation computes it: with the twist x = (t, vector part of the
    quaternion) of inverse(truth) estimate, the square is x' information x / information[0, 0].

    Args:
        estimate: `target_from_source` that an estimator found.
        truth: The true one.
        information: Of the pair; its first entry is the number of true correspondences.

    Raises:
        ValueError: The information matrix counts no correspondence.
    """
    check_positive(float(information[0, 0]), "information[0, 0]")
    difference = transforms.invert(truth) @ estimate
    twist = np.concatenate([difference[:3, 3], _quaternion_vector(difference[:3, :3])])
    return math.sqrt(max(float(twist @ information @ twist) / float(information[0, 0]), 0.0))


def registration_recall(rmses: ArrayLike, *, threshold: float = 0.2) -> float:
    """Share of pairs registered with an RMSE below `threshold` (3DMatch takes 20 cm); nan without pairs.

    A pair for which no motion was found (nan) counts as one that failed.
    """
    values = np.asarray(rmses, dtype=np.float64)
    return float(np.mean(values < threshold)) if len(values) else math.nan


def _quaternion_vector(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    """The vector part of the rotation's unit quaternion with non-negative scalar part: axis times sin(angle / 2)."""
    from scipy.spatial.transform import Rotation  # on first use: it costs half a second to import

    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True)[:3], dtype=np.float64)

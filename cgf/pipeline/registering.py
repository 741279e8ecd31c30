"""The last stage: the motion that correspondences and surfaces agree on."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from cgf import registration
from cgf.checks import InputError
from cgf.pipeline.settings import ResolvedSettings
from cgf.registration import IcpMetric
from cgf.types import Correspondences, IsCancelled, PointCloud, Progress, RegistrationResult

LOW_FITNESS = 0.1
LOW_AGREEMENT = 0.01
"""Share of correspondences that agree on the best of many motions by chance alone: 0.3 % on shuffled ones."""
COARSE_SHARE = 0.8
"""Of the progress of an estimate that is refined afterwards."""
KEPT_FITNESS = 0.9
"""A refinement that loses more of the surfaces than the rest has gone astray."""


@dataclass(frozen=True)
class RegistrationSettings:
    """How the motion is looked for; None takes what suits the pair or the method."""

    method: str = "ransac"
    """One of `cgf.registration.available()`; `icp` improves a motion and looks at no correspondences."""
    inlier_distance: float | None = None
    """How far a moved source point may lie from its partner, in cloud units."""
    iterations: int | None = None
    """At most, of whatever the method repeats."""
    refine: bool = True
    """Whether ICP follows on the other methods."""
    metric: IcpMetric = "plane"
    """What ICP makes small: distances to planes, or to points."""

    def __post_init__(self) -> None:
        if self.method not in registration.available():
            raise InputError(f"--method must be one of {', '.join(registration.available())}, got {self.method}")
        if self.inlier_distance is not None and not 0 < self.inlier_distance < np.inf:
            raise InputError(f"--inlier-distance must be positive, got {self.inlier_distance:g}")
        if self.iterations is not None and self.iterations < 1:
            raise InputError(f"--iterations must be at least 1, got {self.iterations}")


def register_pair(
    source: PointCloud,
    target: PointCloud,
    correspondences: Correspondences,
    settings: ResolvedSettings,
    wanted: RegistrationSettings | None = None,
    *,
    initial: Float64[np.ndarray, "4 4"] | None = None,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> RegistrationResult:
    """Find the motion that most correspondences agree with, and refine it on the surfaces.

    Args:
        source: Prepared cloud.
        target: Prepared cloud.
        correspondences: Between their rows, filtered as the user likes.
        settings: Of the pair; gives the inlier distance where `wanted` has none, and the seed.
        wanted: How to look for it; None takes RANSAC, then ICP.
        initial: `target_from_source` that the method `icp` starts from; None is the identity.
        progress: Told the share done, and what is being done.
        cancelled: Asked now and then whether to give up.

    Returns:
        `target_from_source` is None where no motion is agreed on.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    wanted = RegistrationSettings() if wanted is None else wanted
    distance = settings.inlier_distance if wanted.inlier_distance is None else wanted.inlier_distance
    estimator = registration.make_estimator(
        wanted.method,
        inlier_distance=distance,
        iterations=wanted.iterations,
        seed=settings.seed,
        initial=initial,
        metric=wanted.metric,
    )
    refine = wanted.refine and wanted.method != "icp"

    def told(share: float, text: str) -> None:
        if progress is not None:
            progress(COARSE_SHARE * share if refine else share, text)

    coarse = estimator.estimate(source, target, correspondences, progress=told, cancelled=cancelled)
    if coarse.target_from_source is None or not refine:
        return coarse
    if progress is not None:
        progress(COARSE_SHARE, "Refining on the surfaces")
    icp = registration.make_estimator(
        "icp", inlier_distance=distance, initial=coarse.target_from_source, metric=wanted.metric
    )
    fine = icp.estimate(source, target, correspondences, cancelled=cancelled)
    return replace(fine, method=f"{coarse.method}+icp") if fine.fitness >= KEPT_FITNESS * coarse.fitness else coarse


def registration_warning(
    result: RegistrationResult, correspondences: Correspondences, settings: ResolvedSettings
) -> str | None:
    """A line for the user where the motion is missing or doubtful, else None."""
    if result.target_from_source is None:
        return (
            f"No motion was found that enough of the {len(correspondences):,} correspondences agree with; "
            "do the clouds overlap?"
        )
    near, agree = f"{settings.inlier_distance:.2g}", len(result.inliers)
    if agree < LOW_AGREEMENT * len(correspondences):
        return (
            f"Only {agree:,} of {len(correspondences):,} correspondences agree with the motion found (within {near}), "
            "as many as chance gives; do the clouds overlap?"
        )
    if result.fitness < LOW_FITNESS:
        return (
            f"Only {result.fitness:.0%} of the source's points come within {near} of the target after moving; "
            "do the clouds overlap?"
        )
    return None

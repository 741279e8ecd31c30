"""Fast global registration over given correspondences (Zhou, Park and Koltun, ECCV 2016).

Open3D has it as well, and a test compares the two; but its import alone takes longer than this whole estimate, and it
cannot be stopped.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import check_count, check_fraction, check_positive
from cgf.geometry import transforms
from cgf.registration.agreement import nothing_found, surface_agreement
from cgf.registration.alignment import fit_rigid
from cgf.registration.ransac import SAMPLE, edges_agree
from cgf.types import Correspondences, IsCancelled, PointCloud, Progress, RegistrationResult, raise_if_cancelled

BATCH = 20_000
"""Triples drawn at once."""
DRAWS_PER_CORRESPONDENCE = 100
"""Triples drawn at most."""
STEPS_PER_SCALE = 4
"""Between two divisions of the scale of the penalty."""
SCALE_DIVISOR = 1.4
CONVERGED = 1e-7
"""A step that changes no entry of the motion of the unit-sized clouds by more ends the search."""


@dataclass(frozen=True)
class FgrConfig:
    """What agrees, and how long to look for it."""

    inlier_distance: float
    """Where the penalty ends: residuals far beyond have no say, in cloud units."""
    iterations: int = 200
    """At most; a hundred and some bring the penalty from the size of the clouds down to the inlier distance."""
    tuples: int = 1_000
    """Triples of correspondences with similar edges that are optimised over; 0 takes all correspondences."""
    edge_ratio: float = 0.95
    """A triple is kept if the shorter of each two edges that correspond is at least this share of the longer."""
    min_inliers: int = 6
    """Fewer correspondences that agree are no consensus."""
    seed: int = 0
    """Of the triples: same seed, same result."""

    def __post_init__(self) -> None:
        check_positive(self.inlier_distance, "inlier_distance")
        check_count(self.iterations, "iterations", minimum=1)
        check_count(self.tuples, "tuples", minimum=0)
        check_fraction(self.edge_ratio, "edge_ratio")
        check_count(self.min_inliers, "min_inliers", minimum=SAMPLE)
        check_count(self.seed, "seed", minimum=0)


@dataclass(frozen=True)
class Fgr:
    """Minimises a robust penalty over all correspondences, which sharpens from convex to narrow."""

    config: FgrConfig

    @property
    def name(self) -> str:
        return "fgr"

    def estimate(
        self,
        source: PointCloud,
        target: PointCloud,
        correspondences: Correspondences,
        *,
        progress: Progress | None = None,
        cancelled: IsCancelled | None = None,
    ) -> RegistrationResult:
        """Keep triples of correspondences whose edges agree in length, and align them.

        Returns:
            `target_from_source` is None if fewer than `min_inliers` correspondences agree in the end.

        Raises:
            Cancelled: `cancelled` returned True.
        """
        config = self.config
        source_points = source.points[correspondences.indices[:, 0]]
        target_points = target.points[correspondences.indices[:, 1]]
        rows = np.arange(len(correspondences))
        if config.tuples:
            rows = _similar_triples(source_points, target_points, config, cancelled)
        if len(rows) < SAMPLE:
            return nothing_found(self.name)
        pose = _align(source_points[rows], target_points[rows], config, progress, cancelled)
        residuals = np.linalg.norm(transforms.apply(pose, source_points) - target_points, axis=1)
        inliers = np.flatnonzero(residuals <= config.inlier_distance)
        if len(inliers) < config.min_inliers:
            return nothing_found(self.name)
        fitness, inlier_rmse = surface_agreement(source, target, pose, config.inlier_distance)
        return RegistrationResult(pose, inliers, fitness, inlier_rmse, self.name)


def _similar_triples(
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    config: FgrConfig,
    cancelled: IsCancelled | None,
) -> Int64[np.ndarray, "T"]:
    """Rows of random triples that pass the test of section 3.2, one after another; a row may come several times."""
    count = len(source_points)
    if count < SAMPLE:
        return np.zeros(0, dtype=np.int64)
    rng = np.random.default_rng(config.seed)
    kept: list[Int64[np.ndarray, "S 3"]] = []
    found, left = 0, DRAWS_PER_CORRESPONDENCE * count
    while found < config.tuples and left > 0:
        raise_if_cancelled(cancelled)
        samples = rng.integers(0, count, size=(min(BATCH, left), SAMPLE))
        left -= len(samples)
        kept.append(samples[edges_agree(source_points[samples], target_points[samples], config.edge_ratio)])
        found += len(kept[-1])
    return np.concatenate(kept)[: config.tuples].ravel()


def _align(
    source_points: Float64[np.ndarray, "T 3"],
    target_points: Float64[np.ndarray, "T 3"],
    config: FgrConfig,
    progress: Progress | None,
    cancelled: IsCancelled | None,
) -> Float64[np.ndarray, "4 4"]:
    # Unit size about the centres, so that one threshold says when it has come to rest.
    source_center, target_center = source_points.mean(axis=0), target_points.mean(axis=0)
    source_points, target_points = source_points - source_center, target_points - target_center
    size = float(np.sqrt(max(np.square(cloud).sum(axis=1).max() for cloud in (source_points, target_points))))
    source_points, target_points = source_points / size, target_points / size
    last_scale = (config.inlier_distance / size) ** 2
    scale, motion = 1.0, np.eye(4)
    for step in range(config.iterations):
        raise_if_cancelled(cancelled)
        if progress is not None:
            progress(step / config.iterations, "Aligning correspondences")
        if step % STEPS_PER_SCALE == 0 and scale > last_scale:
            scale /= SCALE_DIVISOR
        residuals = transforms.apply(motion, source_points) - target_points
        # Eq. 6, the line process of the Geman-McClure penalty.
        weights = np.square(scale / (scale + np.square(residuals).sum(axis=1)))
        # Departure: the paper linearises the rotation (eq. 8); under fixed weights the closed form is exact.
        before, motion = motion, fit_rigid(source_points, target_points, weights)
        if scale <= last_scale and float(np.abs(motion - before).max()) < CONVERGED:
            break
    rotation = motion[:3, :3]
    return transforms.rigid(rotation, size * motion[:3, 3] + target_center - rotation @ source_center)

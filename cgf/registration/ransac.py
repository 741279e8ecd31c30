"""Random sample consensus over correspondences (Fischler and Bolles 1981), all in numpy.

Sampling is cheap here because most samples of three correspondences are thrown away after comparing
the lengths of their edges (Buch et al. 2013), many thousands at a time; only the rest are aligned and scored.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from cgf.checks import check_count, check_fraction, check_positive
from cgf.geometry import transforms
from cgf.registration.agreement import nothing_found, surface_agreement
from cgf.registration.alignment import fit_rigid, fit_rotations
from cgf.types import Correspondences, IsCancelled, PointCloud, Progress, RegistrationResult, raise_if_cancelled

SAMPLE = 3
BATCH = 5_000
"""Samples drawn at once."""
SCORE_VALUES = 2_000_000
"""Residuals held at once (8 MB a temporary)."""
POLISH_STEPS = 10


@dataclass(frozen=True)
class RansacConfig:
    """What agrees, and how long to look for it."""

    inlier_distance: float
    """How far a moved source point may lie from its partner, in cloud units."""
    iterations: int = 1_000_000
    """Samples drawn at most."""
    confidence: float = 0.999
    """Stops when a better motion is found with this probability, if the inlier ratio is that of the best so far."""
    edge_ratio: float = 0.9
    """A sample is kept if the shorter of each two edges that correspond is at least this share of the longer."""
    min_inliers: int = 6
    """Fewer correspondences that agree are no consensus: three always do."""
    seed: int = 0
    """Same seed, same result."""

    def __post_init__(self) -> None:
        check_positive(self.inlier_distance, "inlier_distance")
        check_count(self.iterations, "iterations", minimum=1)
        check_fraction(self.confidence, "confidence")
        check_fraction(self.edge_ratio, "edge_ratio")
        check_count(self.min_inliers, "min_inliers", minimum=SAMPLE)
        check_count(self.seed, "seed", minimum=0)


@dataclass(frozen=True)
class Ransac:
    """Finds the motion that most correspondences agree with."""

    config: RansacConfig

    @property
    def name(self) -> str:
        return "ransac"

    def estimate(
        self,
        source: PointCloud,
        target: PointCloud,
        correspondences: Correspondences,
        *,
        progress: Progress | None = None,
        cancelled: IsCancelled | None = None,
    ) -> RegistrationResult:
        """Sample, score, and polish by least squares over the inliers.

        Returns:
            `target_from_source` is None if fewer than `min_inliers` correspondences agree on any motion tried.

        Raises:
            Cancelled: `cancelled` returned True.
        """
        source_points = source.points[correspondences.indices[:, 0]]
        target_points = target.points[correspondences.indices[:, 1]]
        found = _consensus(source_points, target_points, self.config, progress, cancelled)
        if found is None:
            return nothing_found(self.name)
        target_from_source, inliers = found
        fitness, inlier_rmse = surface_agreement(source, target, target_from_source, self.config.inlier_distance)
        return RegistrationResult(target_from_source, inliers, fitness, inlier_rmse, self.name)


def _consensus(
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    config: RansacConfig,
    progress: Progress | None,
    cancelled: IsCancelled | None,
) -> tuple[Float64[np.ndarray, "4 4"], Int64[np.ndarray, "I"]] | None:
    count = len(source_points)
    if count < config.min_inliers:
        return None
    # Centred, so that float32 scores are as good far from the origin (UTM coordinates).
    source_center, target_center = source_points.mean(axis=0), target_points.mean(axis=0)
    source_points, target_points = source_points - source_center, target_points - target_center
    rng = np.random.default_rng(config.seed)
    best: Float64[np.ndarray, "4 4"] | None = None
    best_score, needed, drawn = 0.0, config.iterations, 0
    while drawn < needed:
        raise_if_cancelled(cancelled)
        if progress is not None:
            progress(drawn / needed, "Sampling correspondences")
        samples = rng.integers(0, count, size=(min(BATCH, needed - drawn), SAMPLE))
        drawn += len(samples)
        samples = samples[edges_agree(source_points[samples], target_points[samples], config.edge_ratio)]
        if not len(samples):
            continue
        rotations, translations = _align(source_points[samples], target_points[samples])
        scores = _scores(rotations, translations, source_points, target_points, config.inlier_distance)
        winner = int(np.argmax(scores))
        if scores[winner] <= best_score:
            continue
        motion = transforms.rigid(rotations[winner], translations[winner])
        best, best_score, inliers = _polish(motion, source_points, target_points, config.inlier_distance)
        needed = min(config.iterations, _draws_needed(len(inliers) / count, config.confidence))
    if best is None:
        return None
    inliers = np.flatnonzero(_sq_residuals(best, source_points, target_points) <= config.inlier_distance**2)
    if len(inliers) < config.min_inliers:
        return None
    rotation = best[:3, :3]
    return transforms.rigid(rotation, best[:3, 3] + target_center - rotation @ source_center), inliers


def edges_agree(
    source_samples: Float64[np.ndarray, "S 3 3"], target_samples: Float64[np.ndarray, "S 3 3"], edge_ratio: float
) -> Bool[np.ndarray, "S"]:
    """Which samples of three correspondences have edges of positive length that differ by `edge_ratio` at most."""
    keep = np.ones(len(source_samples), dtype=bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        sq_source = np.square(source_samples[:, a] - source_samples[:, b]).sum(axis=1)
        sq_target = np.square(target_samples[:, a] - target_samples[:, b]).sum(axis=1)
        shorter, longer = np.minimum(sq_source, sq_target), np.maximum(sq_source, sq_target)
        # An edge of length 0 is a correspondence or a point drawn twice, which fixes no motion.
        keep &= (shorter >= edge_ratio**2 * longer) & (shorter > 0)
    return keep


def _align(
    source_samples: Float64[np.ndarray, "S K 3"], target_samples: Float64[np.ndarray, "S K 3"]
) -> tuple[Float64[np.ndarray, "S 3 3"], Float64[np.ndarray, "S 3"]]:
    source_center, target_center = source_samples.mean(axis=1), target_samples.mean(axis=1)
    rotations = fit_rotations(source_samples - source_center[:, None], target_samples - target_center[:, None])
    return rotations, target_center - np.einsum("sij,sj->si", rotations, source_center)


def _scores(
    rotations: Float64[np.ndarray, "S 3 3"],
    translations: Float64[np.ndarray, "S 3"],
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    inlier_distance: float,
) -> Float64[np.ndarray, "S"]:
    """Truncated quadratic score (MSAC, Torr and Zisserman 2000): a perfect inlier counts 1, one at the border 0."""
    scores = np.empty(len(rotations))
    step = max(SCORE_VALUES // len(source_points), 1)
    homogeneous = np.column_stack([source_points, np.ones(len(source_points))]).T.astype(np.float32)
    goal: Float32[np.ndarray, "3 1 C"] = target_points.T.astype(np.float32)[:, None]
    motions = np.concatenate([rotations, translations[:, :, None]], axis=2).astype(np.float32)
    for start in range(0, len(rotations), step):
        part = motions[start : start + step]
        sq = np.zeros((len(part), len(source_points)), dtype=np.float32)
        for axis in range(3):
            sq += np.square(part[:, axis] @ homogeneous - goal[axis])
        np.minimum(sq, inlier_distance**2, out=sq)
        scores[start : start + step] = len(source_points) - sq.sum(axis=1, dtype=np.float64) / inlier_distance**2
    return scores


def _polish(
    motion: Float64[np.ndarray, "4 4"],
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    inlier_distance: float,
) -> tuple[Float64[np.ndarray, "4 4"], float, Int64[np.ndarray, "I"]]:
    """Least squares over the inliers while that improves the score; the motion, its score and its inliers."""
    sq = _sq_residuals(motion, source_points, target_points)
    score = _score(sq, inlier_distance)
    for _ in range(POLISH_STEPS):
        inliers = np.flatnonzero(sq <= inlier_distance**2)
        if len(inliers) < SAMPLE:
            break
        refined = fit_rigid(source_points[inliers], target_points[inliers])
        refined_sq = _sq_residuals(refined, source_points, target_points)
        refined_score = _score(refined_sq, inlier_distance)
        if refined_score <= score:
            break
        motion, sq, score = refined, refined_sq, refined_score
    return motion, score, np.flatnonzero(sq <= inlier_distance**2)


def _sq_residuals(
    motion: Float64[np.ndarray, "4 4"],
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
) -> Float64[np.ndarray, "C"]:
    return np.asarray(np.square(transforms.apply(motion, source_points) - target_points).sum(axis=1))


def _score(sq_residuals: Float64[np.ndarray, "C"], inlier_distance: float) -> float:
    return float((1 - np.minimum(sq_residuals / inlier_distance**2, 1)).sum())


def _draws_needed(inlier_ratio: float, confidence: float) -> int:
    all_inliers = inlier_ratio**SAMPLE
    if all_inliers >= 1:
        return 1
    if all_inliers <= 0:
        return np.iinfo(np.int64).max
    return math.ceil(math.log(1 - confidence) / math.log1p(-all_inliers))

"""Descriptors over a data set: the paper's precision (its equation 6), inlier ratios and recalls."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from cgf import pipeline
from cgf.checks import InputError
from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.evaluation import metrics
from cgf.geometry.transforms import apply
from cgf.pipeline import PairSettings
from cgf.types import Features, Pair, PointCloud, Progress


@dataclass(frozen=True)
class PairScore:
    """How one descriptor did on one pair, from source to target, exact nearest neighbours without a filter."""

    pair: str
    descriptor: str
    dim: int
    points: int
    """Points of both clouds that are described."""
    partners: int
    """Source points with a true partner within tau."""
    precision: float
    """Share of their matches within the precision radius."""
    precision_in_tau: float
    """The same within tau."""
    inlier_ratio: float
    """Share of all matches within the precision radius."""
    describe_s: float
    """Seconds to describe both clouds."""
    match_s: float


@dataclass(frozen=True)
class Summary:
    """Means over the pairs of one descriptor."""

    descriptor: str
    dim: int
    pairs: int
    precision: float
    precision_in_tau: float
    inlier_ratio: float
    feature_matching_recall: float
    """Share of pairs with an inlier ratio above 5 %."""
    describe_ms_per_1000: float
    """Milliseconds to describe 1,000 points."""


def evaluate_pair(pair: Pair, choices: Sequence[PairSettings]) -> list[PairScore]:
    """Score every one of `choices` on a pair whose true pose is known.

    Thresholds that are shares of the diameter take the diagonal of the box around both clouds, aligned.

    Raises:
        InputError: The pair has no true pose.
    """
    pose = pair.target_from_source
    if pose is None:
        raise InputError(f"{pair.name} must have a true pose to be evaluated, got none; add it to the log")
    both = np.concatenate([apply(pose, pair.source.points), pair.target.points])
    diameter = float(np.linalg.norm(np.ptp(both, axis=0)))
    prepared: dict[tuple[object, ...], tuple[PointCloud, PointCloud]] = {}
    described: dict[tuple[object, ...], tuple[Features, Features, float]] = {}
    scores = []
    for choice in choices:
        settings = pipeline.resolve(choice, pair.source, pair.target)
        limits = MODEL_DEFAULTS[settings.model].scaled(diameter)
        key = settings.preparation_key
        if key not in prepared:
            prepared[key] = pipeline.prepare(pair.source, settings), pipeline.prepare(pair.target, settings)
        source, target = prepared[key]
        if settings.description_key not in described:
            started = perf_counter()
            features = pipeline.describe(source, settings), pipeline.describe(target, settings)
            described[settings.description_key] = (*features, perf_counter() - started)
        source_features, target_features, describe_s = described[settings.description_key]
        started = perf_counter()
        table = pipeline.match_features(source_features, target_features, settings)
        match_s = perf_counter() - started
        indices = table.correspondences.indices
        errors = metrics.correspondence_errors(source.points, target.points, indices, pose)
        partner = metrics.has_partner(source.points, target.points, pose, tau=limits.tau)[indices[:, 0]]
        scores.append(
            PairScore(
                pair=pair.name,
                descriptor=settings.descriptor,
                dim=settings.dim,
                points=len(source_features) + len(target_features),
                partners=int(partner.sum()),
                precision=metrics.precision(errors[partner], threshold=limits.precision_radius),
                precision_in_tau=metrics.precision(errors[partner], threshold=limits.tau),
                inlier_ratio=metrics.precision(errors, threshold=limits.precision_radius),
                describe_s=describe_s,
                match_s=match_s,
            )
        )
    return scores


def evaluate(
    pairs: Iterable[Pair], choices: Sequence[PairSettings], *, count: int, progress: Progress | None = None
) -> list[PairScore]:
    """Score every one of `choices` on every one of the `count` pairs."""
    scores: list[PairScore] = []
    for done, pair in enumerate(pairs):
        if progress is not None:
            progress(done / count, pair.name)
        scores.extend(evaluate_pair(pair, choices))
    return scores


def summarise(scores: Sequence[PairScore]) -> list[Summary]:
    """Means over pairs, one row per descriptor and dimension, in the order they first come."""
    rows = []
    for descriptor, dim in dict.fromkeys((score.descriptor, score.dim) for score in scores):
        chosen = [score for score in scores if (score.descriptor, score.dim) == (descriptor, dim)]
        ratios = [score.inlier_ratio for score in chosen]
        seconds = sum(score.describe_s for score in chosen)
        rows.append(
            Summary(
                descriptor=descriptor,
                dim=dim,
                pairs=len(chosen),
                precision=float(np.mean([score.precision for score in chosen])),
                precision_in_tau=float(np.mean([score.precision_in_tau for score in chosen])),
                inlier_ratio=float(np.mean(ratios)),
                feature_matching_recall=metrics.feature_matching_recall(ratios),
                describe_ms_per_1000=1e6 * seconds / max(sum(score.points for score in chosen), 1),
            )
        )
    return rows

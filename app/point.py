"""The picked point for the page: its candidates, its place among all distances, and its histograms."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Scores
from app.explorer import Findings
from app.funnel import stage_text
from cgf.pipeline import ALIKE, REJECTIONS, PointInspection, Rejection, Side, Surroundings, best_turn, shell_edges
from cgf.types import Features

BINS = 40
"""Of the distribution of feature distances."""

Floats = npt.NDArray[np.floating]


@dataclass(frozen=True)
class Candidate:
    """A point of the other cloud that looks like the picked one."""

    row: int
    feature_distance: float
    ratio: float
    """The nearest's feature distance over this one's; the second's is that of the ratio test."""
    error: float | None
    """From the true place, in cloud units; None where no pose is known."""
    right: bool | None


@dataclass(frozen=True)
class Partner:
    """The point of the other cloud nearest to the true place."""

    row: int
    rank: int | None
    """Its place by feature distance, 1 for the match; None where it has no feature."""
    feature_distance: float | None
    gap: float
    """From the true place, in cloud units."""


@dataclass(frozen=True)
class Distribution:
    """Numbers of feature distances between edges that grow by a common factor."""

    edges: tuple[float, ...]
    points: tuple[int, ...]
    """From the picked point to every point of the other cloud."""
    right: tuple[int, ...]
    """From every point of its own cloud to its match, where that is right."""
    wrong: tuple[int, ...]
    """The same where it is wrong, or where no pose says."""


@dataclass(frozen=True)
class Histogram:
    """The spherical histogram of one point."""

    row: int
    neighbors: int
    bins: tuple[float, ...]
    """Shares of the neighbours: the shell runs fastest, then the elevation ring, then the azimuth sector."""
    turn: int
    """By how many sectors it must be turned to fit the picked point's best."""


@dataclass(frozen=True)
class PointDetails:
    """Everything about the picked point."""

    revision: int
    """Of the state that it belongs to."""
    side: Side
    index: int
    position: tuple[float, float, float]
    """In the frame and units of the file."""
    stage: Rejection
    label: str
    mutual: bool | None
    """Whether its match is mutual; None without a match."""
    quality: float | None
    """Of its feature, from 0 to 1; None where the descriptor does not say."""
    surer: float | None
    """Share of its own cloud's features whose quality is higher."""
    candidates: tuple[Candidate, ...]
    """The match and the runners-up."""
    partner: Partner | None
    features: int
    """Points of the other cloud that have a feature."""
    nearer_matches: float | None
    """Share of its own cloud's matches whose feature distance is smaller."""
    modes: int
    """Places far apart that look like the match, itself included."""
    modes_apart: float
    """How far apart, in cloud units."""
    alike: float
    """How alike: the nearest's feature distance over theirs at least."""
    distribution: Distribution | None
    shells: tuple[float, ...]
    """Radii between the shells, in cloud units."""
    point_histogram: Histogram | None
    match_histogram: Histogram | None
    partner_histogram: Histogram | None


def point_details(
    revision: int, analysis: Analysis, scores: Scores, findings: Findings, *, near: float
) -> PointDetails:
    """Put the findings on the picked point into plain values; errors up to `near` are right."""
    picked, stages = findings.picked, findings.stages
    assert picked is not None
    assert stages is not None
    is_source = picked.side == "source"
    own = analysis.source if is_source else analysis.target
    table = analysis.matches if is_source else analysis.back_matches
    errors = scores.forward.errors if is_source else scores.back.errors
    other_features = analysis.target_features if is_source else analysis.source_features
    assert table is not None
    assert other_features is not None
    row = picked.point.row
    quality, surer = _quality(analysis.source_features if is_source else analysis.target_features, row)
    code = int((stages.source if is_source else stages.target)[row])
    match_rows = np.flatnonzero(table.correspondences.indices[:, 0] == row)
    distances = table.correspondences.distances
    x, y, z = own.points[row].tolist()
    return PointDetails(
        revision=revision,
        side=picked.side,
        index=row,
        position=(x, y, z),
        stage=REJECTIONS[code],
        label=stage_text(REJECTIONS[code], judged=stages.judged),
        mutual=bool(table.mutual[match_rows[0]]) if len(match_rows) else None,
        quality=quality,
        surer=surer,
        candidates=_candidates(picked, near=near),
        partner=_partner(picked),
        features=len(other_features),
        nearer_matches=float(np.mean(distances < distances[match_rows[0]])) if len(match_rows) else None,
        modes=len(picked.modes),
        modes_apart=analysis.resolved.support_radius / 2,
        alike=ALIKE,
        distribution=_distribution(picked, distances, errors <= near),
        shells=tuple(shell_edges(analysis.resolved).tolist()),
        point_histogram=_histogram(picked.point, picked.point),
        match_histogram=_histogram(picked.match, picked.point),
        partner_histogram=_histogram(picked.partner, picked.point),
    )


def _quality(features: Features | None, row: int) -> tuple[float | None, float | None]:
    """Quality of the feature of a row, and the share of features that are better."""
    if features is None or features.quality is None or row not in features.indices:
        return None, None
    own = features.quality[features.indices == row][0]
    return float(own), float(np.mean(features.quality > own))


def _candidates(picked: PointInspection, *, near: float) -> tuple[Candidate, ...]:
    if not len(picked.nearest):
        return ()
    distances = picked.distances[picked.nearest].tolist()
    return tuple(
        Candidate(
            row,
            distance,
            distances[0] / distance if distance > 0 else 1.0,
            None if math.isnan(error) else error,
            None if math.isnan(error) else error <= near,
        )
        for row, distance, error in zip(picked.nearest.tolist(), distances, picked.errors.tolist(), strict=True)
    )


def _partner(picked: PointInspection) -> Partner | None:
    if picked.partner is None:
        return None
    distance = float(picked.distances[picked.partner.row])
    return Partner(
        picked.partner.row, picked.partner_rank, None if math.isnan(distance) else distance, picked.partner_gap
    )


def _distribution(picked: PointInspection, matched: Floats, is_right: npt.NDArray[np.bool_]) -> Distribution | None:
    known = picked.distances[np.isfinite(picked.distances)]
    positive = np.concatenate([known[known > 0], matched[matched > 0]])
    if not len(known) or not len(positive):
        return None
    low, high = float(positive.min()), float(positive.max())
    edges = np.geomspace(low, max(high, 1.01 * low), BINS + 1)

    def counts(values: Floats) -> tuple[int, ...]:
        numbers: list[int] = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].tolist()
        return tuple(numbers)

    return Distribution(tuple(edges.tolist()), counts(known), counts(matched[is_right]), counts(matched[~is_right]))


def _histogram(item: Surroundings | None, point: Surroundings) -> Histogram | None:
    if item is None or item.histogram is None:
        return None
    bins = tuple(float(f"{share:.3g}") for share in item.histogram.ravel().tolist())
    turn = 0 if point.histogram is None else best_turn(point.histogram, item.histogram)
    return Histogram(item.row, item.neighbors, bins, turn)

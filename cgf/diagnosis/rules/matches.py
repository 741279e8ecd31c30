"""Findings about what comes after the input: shape, radius, estimator, repetition, overlap, features, filters."""

import math

from cgf.diagnosis.findings import Evidence, Finding, Severity
from cgf.diagnosis.measures import RELIABLE_COUNT, RELIABLE_LEAD, RELIABLE_STABILITY, Measures
from cgf.diagnosis.rules.clouds import judge_density, judge_normals, judge_points, judge_truth
from cgf.diagnosis.rules.common import (
    FEW_NEIGHBORS,
    LOW_OVERLAP,
    agreement_evidence,
    finding,
    least_frame,
    rounded,
    trial_evidence,
)
from cgf.diagnosis.surfaces import FREE_MOTION, Surface

FAIR_OVERLAP = 0.45
"""All pairs with more register; with these weights, all but one of 98, which share 0.2 or more."""
LOW_LIKENESS, FAIR_LIKENESS = 0.32, 0.33
"""Share of points that look more like their match than like their own cloud: halves of a room that share nothing have
up to 0.31; of 69 pairs that share half of their points two have 0.28 and 0.32, which register, the others 0.34 or more.
"""
FEATURELESS = 0.003
"""Of a cloud's stability: made planes, spheres and cylinders have less, of 98 pairs none."""
FEW_DISTINCTIVE = 0.3
"""Pairs that share half of their points have 0.44 or more."""
LOW_PRECISION = 0.11
"""Of matches of points that have a partner; pairs that register have 0.20 or more, the one that does not has 0.08."""
KEPT = 0.15
"""Share of the best pose's matches that a refined estimate keeps; right ones have 0.67 or more."""
RIVAL = 0.5
"""Support of the second pose over that of the first; right poses have 0.48 or less, but for one with 0.61."""
EQUAL, MANY = 0.7, 60
"""A second pose with this share of the first one's matches, of which there are so many, is no chance."""
SELF_LIKE = 0.25
"""Distance in feature space to the most similar other place, over the typical one: grids of boxes have 0.07 to 0.2,
real scans 0.3 or more in 16 or 32 dimensions, and 0.14 or more in 8 or with FPFH."""
MORE_OVERLAP = "Take scans that overlap by a third or more, or go by way of one between them."


def judge_shape(measured: Measures) -> Finding | None:
    """Whether the shape of the clouds, and of what they share, fixes a pose."""
    weakest = min((measured.source, measured.target), key=lambda surface: surface.stability)
    evidence = [
        Evidence("Weakest constraint of the shape over the strongest", weakest.stability, "ratio", FREE_MOTION),
        Evidence("Motions that hardly change it, of 6", weakest.free_motions, "count", 0, "at most"),
    ]
    known = measured.truth or measured.best
    if weakest.free_motions:
        name = "source" if weakest is measured.source else "target"
        is_right = measured.outcome == "registered" and measured.case.truth is not None
        severity: Severity = "caution" if is_right or weakest.stability > FEATURELESS else "problem"
        return finding(
            "shape", "features", severity,
            f"The {name} is {_named(weakest)}: it can be moved along itself without any change to be seen.",
            tuple(evidence), "Scan more of the surroundings, so that the shape fixes the pose.", {}, 0.9,
        )  # fmt: skip
    if known is not None and known.overlap > 0.05:
        estimated = measured.truth is None
        evidence.append(Evidence("The same of the overlap", known.stability, "ratio", FREE_MOTION, estimated=estimated))
        if known.stability < FREE_MOTION:
            return finding(
                "shape", "features", "caution",
                "What the clouds share is nearly featureless, so that one can slide along the other.",
                tuple(evidence), "Scan so that more than a plane is seen from both places.", {}, 0.6,
            )  # fmt: skip
    return Finding("shape", "features", "fine", "The shape of both clouds fixes a pose.", tuple(evidence))


def judge_radius(measured: Measures) -> Finding | None:
    """Whether the lengths chosen suit the clouds."""
    settings, trial = measured.case.settings, measured.trials.get("radius")
    support = min(measured.source.support_neighbors, measured.target.support_neighbors)
    evidence = (
        Evidence("Support radius", settings.support_radius, "length"),
        Evidence("Point spacing", settings.spacing, "length"),
        Evidence("Points in a support, median", support, "count", 100),
        Evidence("Neighbours in a frame, median", least_frame(measured), "count", FEW_NEIGHBORS),
    )
    if trial is not None and trial.is_better:
        return finding(
            "radius", "radius", "problem", "The lengths chosen do not suit these clouds: the usual ones match better.",
            (*evidence, *trial_evidence(trial)), "Go back to the usual lengths.", trial.changes, 0.97,
        )  # fmt: skip
    if measured.outcome != "registered" and (support < 100 or least_frame(measured) < FEW_NEIGHBORS):
        radius = min(settings.support_radius * 2, settings.diameter * 0.5)
        return finding(
            "radius", "radius", "caution", "The neighbourhoods that features describe hold few points.", evidence,
            "Take a larger radius or denser clouds.", {"support_radius": rounded(radius)}, 0.5,
        )  # fmt: skip
    if support < 100 or least_frame(measured) < FEW_NEIGHBORS:
        return None
    return Finding("radius", "radius", "fine", "The radii are well above the point spacing.", evidence)


def judge_estimator(measured: Measures) -> Finding | None:
    """Whether the estimator missed a pose that the matches give."""
    under = measured.estimate
    agreeing = 0 if under is None else under.agreeing
    pose, truth = measured.pose, measured.truth
    if measured.outcome == "registered":
        if pose is None or agreeing >= KEPT * measured.counts[0]:
            return None
        return finding(
            "estimator", "estimator", "caution", "The estimate has moved away from most of the matches that agree.",
            (
                Evidence("Mutual matches that agree on one pose", measured.counts[0], "count"),
                Evidence("With the estimate", agreeing, "count", rounded(KEPT * measured.counts[0])),
            ),
            "Compare with an estimate from mutual matches only.", {"mutual": True}, 0.7,
        )  # fmt: skip
    if pose is None and truth is not None and truth.agreeing >= max(RELIABLE_COUNT, RELIABLE_LEAD * agreeing):
        best = truth.agreeing
    elif pose is not None and (truth is None or truth.agreeing > agreeing):
        best = measured.counts[0]
    else:
        return None
    return finding(
        "estimator", "estimator", "problem",
        "The matches are good enough, but the estimator missed the pose that most of them agree on."
        if measured.case.estimate is not None
        else "The matches are good enough, but the estimator found no pose.",
        (
            Evidence("Mutual matches that agree on one pose", best, "count", RELIABLE_COUNT),
            Evidence("With the estimate", agreeing, "count"),
        ),
        "Estimate again from mutual matches only, or with another seed or estimator.", {"mutual": True}, 0.95,
    )  # fmt: skip


def judge_repetition(measured: Measures) -> Finding | None:
    """Whether a second pose fits the matches about as well."""
    (first, second), settings = measured.counts, measured.case.settings
    if first < RELIABLE_COUNT or measured.source.free_motions or measured.target.free_motions:
        return None
    evidence = (
        Evidence("Matches that agree on the best pose", first, "count"),
        Evidence("On the next best, over that", second / first, "ratio", RIVAL, "at most"),
    )
    if second <= RIVAL * first:
        return Finding("repetition", "features", "fine", "No second pose comes near the best.", evidence)
    if measured.pose_stability < RELIABLE_STABILITY:
        return None
    if measured.likeness.self_likeness > SELF_LIKE or first < MANY or second < EQUAL * first:
        return finding(
            "repetition", "features", "caution", "A second pose has nearly as many matches behind it.", evidence, "",
            {}, 0.5,
        )  # fmt: skip
    return finding(
        "repetition", "features", "problem" if measured.outcome != "registered" else "caution",
        "The scene repeats itself: several poses fit the matches about as well.",
        (*evidence, Evidence(
            "Distance to the most similar other place, of the typical one", measured.likeness.self_likeness, "ratio",
            SELF_LIKE,
        )),
        "Take a larger support radius, so that features see past one repetition; or start from a rough pose.",
        {"support_radius": rounded(min(1.5 * settings.support_radius, settings.diameter / 2))}, 0.85,
    )  # fmt: skip


def judge_overlap(measured: Measures) -> Finding | None:
    """How much the clouds share: measured under a pose where one is known, else told from the features."""
    likeness = measured.likeness.overlap
    alike = Evidence(
        "Points more like their match than like their own cloud", likeness, "share", LOW_LIKENESS, estimated=True
    )
    known = measured.truth or measured.best
    if known is not None and judge_truth(measured) is None:
        estimated = measured.truth is None
        evidence = (
            Evidence("Source points with a partner", known.overlap, "share", LOW_OVERLAP, estimated=estimated),
            alike,
        )
        if known.overlap < FAIR_OVERLAP and measured.outcome != "registered":
            severity: Severity = "problem" if known.overlap < LOW_OVERLAP else "caution"
            return finding(
                "overlap", "overlap", severity,
                f"The clouds share little: {known.overlap:.0%} of the source has a partner.", evidence,
                MORE_OVERLAP, {}, 0.9,
            )  # fmt: skip
        if known.overlap < LOW_OVERLAP:
            return finding(
                "overlap", "overlap", "caution",
                f"The clouds share little ({known.overlap:.0%} of the source), but enough.", evidence, "", {}, 0.9,
            )  # fmt: skip
        return Finding("overlap", "overlap", "fine", f"{known.overlap:.0%} of the source has a partner.", evidence)
    if known is not None or measured.outcome == "registered":
        return None
    judged = [judge_points(measured), judge_density(measured), judge_normals(measured)]
    clouds_differ = any(item is not None and item.severity != "fine" for item in judged)
    if likeness < FAIR_LIKENESS and not (clouds_differ or measured.source.free_motions or measured.target.free_motions):
        severity = "problem" if likeness < LOW_LIKENESS else "caution"
        return finding(
            "overlap", "overlap", severity,
            "The clouds share little, or what they share looks different in each: most places are no more like their "
            "match than like another place of their own cloud.",
            (alike,), MORE_OVERLAP, {}, 0.6,
        )  # fmt: skip
    return None


def judge_features(measured: Measures) -> Finding | None:
    """Whether features tell places apart."""
    distinctive = Evidence(
        "Distinctive points (match nearer than 0.9 of the next place)",
        measured.likeness.distinctive,
        "share",
        FEW_DISTINCTIVE,
    )
    truth = measured.truth
    if truth is None or not math.isfinite(truth.precision) or truth.overlap < 0.05:
        severity: Severity = "fine" if measured.outcome == "registered" or distinctive.holds else "caution"
        sentence = (
            "Many features are distinctive."
            if distinctive.holds
            else "Few features are distinctive: most places look alike."
        )
        if measured.outcome == "registered" and not distinctive.holds:
            sentence = "Few features are distinctive, but enough."
        remedy = "" if severity == "fine" else "Try another descriptor or more dimensions, and a larger support radius."
        return finding("features", "features", severity, sentence, (distinctive,), remedy, {}, 0.5)
    precise = Evidence("Right matches, of points with a partner", truth.precision, "share", LOW_PRECISION)
    if measured.outcome != "registered" and not precise.holds and truth.overlap >= LOW_OVERLAP:
        return finding(
            "features", "features", "problem", "The clouds overlap, but their features do not tell places apart.",
            (precise, distinctive), "Try another descriptor or more dimensions, and a larger support radius.", {}, 0.8,
        )  # fmt: skip
    if measured.outcome != "registered" and not precise.holds:
        return finding(
            "features", "features", "caution", "Even where the clouds overlap, few features find their partner.",
            (precise, distinctive),
            "At the edge of a scan features miss half of their surroundings; try a smaller radius.", {}, 0.6,
        )  # fmt: skip
    return Finding("features", "features", "fine", "Features find their partners.", (precise, distinctive))


def judge_filters(measured: Measures) -> Finding | None:
    """Whether the filters leave matches enough."""
    kept, asked = len(measured.case.rows), len(measured.asked)
    if measured.outcome == "registered" or kept >= RELIABLE_COUNT or kept >= asked:
        return None
    changes = {"max_ratio": None} | ({} if measured.case.settings.surest is None else {"surest": None})
    return finding(
        "filters", "matching", "problem", f"The filters leave only {kept} of {len(measured.case.table):,} matches.",
        (Evidence("Matches left", kept, "count", RELIABLE_COUNT),), "Relax the filters.", changes, 0.9,
    )  # fmt: skip


def judge_agreement(measured: Measures) -> Finding | None:
    """Whether one pose has enough matches behind it."""
    evidence = agreement_evidence(measured)
    if measured.pose is not None:
        return Finding("agreement", "matching", "fine", "One pose has enough matches behind it.", evidence)
    if measured.outcome == "registered":
        return None
    return finding(
        "agreement", "matching", "problem", "No pose has enough matches behind it.", evidence,
        "Try another descriptor or radius, scans that overlap more, or a rough pose to start from.", {}, 0.9,
    )  # fmt: skip


def _named(surface: Surface) -> str:
    if surface.free_motions >= 3:
        return "a plane" if surface.normal_spread < 0.02 else "a sphere, or flat"
    if surface.free_motions == 2:
        return "much like a cylinder"
    return "the same along one direction or about one axis"

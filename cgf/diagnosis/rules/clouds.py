"""Findings about the input: pose, scale, unit, points, density and normals."""

import math
from typing import Any

from cgf.diagnosis.findings import Evidence, Finding, Severity
from cgf.diagnosis.measures import Measures, UnderPose
from cgf.diagnosis.remedies import (
    ABSURD,
    LARGER,
    OPPOSED,
    SCALE_GAIN,
    SCALE_SHIFT,
    SPACING_RATIO,
    TILTED_DEG,
    extent_ratio,
    flip_changes,
    scale_changes,
    spacing_ratio,
)
from cgf.diagnosis.rules.common import (
    FEW_NEIGHBORS,
    LOW_OVERLAP,
    agreement_evidence,
    finding,
    least_frame,
    rounded,
    trial_evidence,
)
from cgf.diagnosis.surfaces import Surface
from cgf.pipeline import PairSettings

FEW_POINTS = 300
AGAINST = 0.4
"""Share of overlapping points whose normals oppose the other cloud's; right poses have 0.25 or less."""
MOSTLY_AGAINST = 0.6
"""From here on it is certain."""
OTHER_WAY = 0.2
"""Overlap under the inverse of a pose from which on that is believed to be meant."""


def judge_truth(measured: Measures) -> Finding | None:
    """Whether the pose that was given as true can be."""
    truth = measured.truth
    if truth is None or measured.case.truth is None:
        return None
    evidence = [Evidence("Overlap under the true pose", truth.overlap, "share", 0.05)]
    if truth.overlap >= 0.05:
        return None
    if measured.inverse_overlap >= OTHER_WAY:
        return Finding(
            "truth", "input", "problem", "The pose given as true maps the wrong way.",
            (*evidence, Evidence("Overlap under its inverse", measured.inverse_overlap, "share")),
            "Give its inverse: it must map the source, the first cloud, onto the target.", confidence=0.95,
        )  # fmt: skip
    if measured.pose is not None and measured.best is not None and measured.best.overlap > LOW_OVERLAP:
        return Finding(
            "truth", "input", "problem", "The pose given as true contradicts the matches.",
            (
                *evidence,
                *agreement_evidence(measured),
                Evidence("Overlap under their pose", measured.best.overlap, "share"),
            ),
            "Check that the pose belongs to these two files, and its unit.", confidence=0.9,
        )  # fmt: skip
    return None


def judge_scale(measured: Measures) -> Finding | None:
    """Whether one cloud is larger than the other, by units or by the scanner."""
    loaded = measured.case.loaded_source, measured.case.loaded_target
    ratio = extent_ratio(*loaded)
    larger = max(ratio, 1 / ratio)
    evidence = [Evidence("Extent of one cloud over the other's", larger, "ratio", LARGER, "at most")]
    trial = measured.trials.get("scale")
    if trial is not None and trial.is_better:
        return finding(
            "scale", "input", "problem",
            f"The clouds differ in scale: {in_other_units(measured.case.wanted, trial.changes)}.",
            (*evidence, *trial_evidence(trial)), "Scale the source by that.", trial.changes, 0.97,
        )  # fmt: skip
    if abs(math.log(measured.scale)) > SCALE_SHIFT and measured.scale_gain >= SCALE_GAIN:
        gain = Evidence(
            "Gain in agreeing distances between matches", measured.scale_gain, "ratio", SCALE_GAIN, "at most"
        )
        changes = {"source_scale": rounded(measured.case.wanted.source_scale * measured.scale, 4)}
        return finding(
            "scale", "input", "problem", f"The target is {measured.scale:.3g} times as large as the source.",
            (Evidence("Scale by distances between matches", measured.scale, "ratio"), gain),
            "Scale the source by that.", changes, 0.85,
        )  # fmt: skip
    if larger > ABSURD:
        changes = next(iter(scale_changes(measured.case.wanted, *loaded)), {})
        return finding(
            "scale", "input", "problem", f"One cloud is {larger:,.0f} times as large as the other.", tuple(evidence),
            "Scale the source to the unit of the target." if changes else "Bring both to the same unit.", changes,
            0.9,
        )  # fmt: skip
    if larger > LARGER:
        return None if measured.outcome == "registered" else Finding(
            "scale", "input", "caution", f"One cloud is {larger:.1f} times as large as the other.", tuple(evidence),
            "Check that both have the same unit.", confidence=0.4,
        )  # fmt: skip
    shares = Evidence("Scale by distances between matches", measured.scale, "ratio")
    if measured.pose is not None or measured.outcome == "registered":
        evidence.append(shares)
    return Finding("scale", "input", "fine", "Both clouds have the same scale, as far as can be seen.", tuple(evidence))


def judge_unit(measured: Measures) -> Finding | None:
    """Whether the coordinates look like millimetres; None where they do not."""
    warning = measured.case.settings.choice.warning
    if warning is None or "millimetres" not in warning:
        return None
    trial = measured.trials.get("unit")
    helps = trial is not None and trial.is_better
    return finding(
        "unit", "input", "problem" if helps and measured.outcome != "registered" else "caution",
        "The coordinates look like a room in millimetres, but are taken for those of an object.",
        (Evidence("Diameter, in units", measured.case.settings.diameter, "count"), *trial_evidence(trial)),
        "Say that the unit is the millimetre, so that lengths and features are those for rooms.", {"unit": "mm"},
        0.95 if helps else 0.6,
    )  # fmt: skip


def judge_points(measured: Measures) -> Finding | None:
    """Whether there are points enough."""
    fewest = min(measured.source.points, measured.target.points)
    evidence = (
        Evidence("Points of the smaller cloud", fewest, "count", FEW_POINTS),
        Evidence("Neighbours in a frame", least_frame(measured), "count", FEW_NEIGHBORS),
    )
    if fewest < FEW_POINTS:
        loaded = min(len(measured.case.loaded_source), len(measured.case.loaded_target))
        changes: dict[str, Any] = {}
        remedy = "Take a denser scan."
        if loaded > 2 * fewest:
            changes = {"voxel_size": rounded(measured.case.settings.voxel_size / 2)}
            remedy = "Keep more points, with a smaller voxel size."
        return finding(
            "points", "input", "problem" if measured.outcome != "registered" else "caution",
            f"Only {fewest:,} points are left of one cloud.", evidence, remedy, changes, 0.8,
        )  # fmt: skip
    return Finding("points", "input", "fine", "Both clouds have points enough.", evidence)


def judge_density(measured: Measures) -> Finding | None:
    """Whether both clouds are about as dense."""
    ratio = spacing_ratio(measured)
    larger, trial = max(ratio, 1 / ratio), measured.trials.get("density")
    evidence = (
        Evidence("Spacing of one cloud over the other's", larger, "ratio", SPACING_RATIO, "at most"),
        Evidence("Spacing of the source", measured.source.spacing, "length"),
        Evidence("Spacing of the target", measured.target.spacing, "length"),
    )
    if larger <= SPACING_RATIO:
        return Finding("density", "input", "fine", "Both clouds are about as dense.", evidence)
    sparse = "source" if ratio > 1 else "target"
    helps = trial is not None and trial.is_better
    return finding(
        "density", "input", "problem" if helps and measured.outcome != "registered" else "caution",
        f"The {sparse} is much sparser than the other cloud, so that the same place looks different.",
        (*evidence, *trial_evidence(trial if helps else None)),
        "Thin out both to the spacing of the sparser one, with a larger voxel size.",
        {"voxel_size": rounded(max(measured.loaded_spacings))}, 0.95 if helps else 0.5,
    )  # fmt: skip


def judge_normals(measured: Measures) -> Finding | None:
    """Whether normals are those of the surface, and on the same side in both clouds."""
    trial = measured.trials.get("normals")
    opposed = max(measured.source.opposed_share, measured.target.opposed_share)
    tilt = max(measured.source.tilt_deg, measured.target.tilt_deg)
    evidence = [
        Evidence("Points whose neighbours' normals oppose theirs", opposed, "share", OPPOSED, "at most"),
        Evidence("Angle between normals and surface, median", tilt, "degrees", TILTED_DEG, "at most"),
    ]
    known = measured.truth or measured.best
    if known is not None and known.overlap > 0.05:
        evidence.append(_against(measured, known))
    severity: Severity = "caution" if measured.outcome == "registered" else "problem"
    if tilt > TILTED_DEG or opposed > OPPOSED:
        which = "both clouds" if min(_doubts(measured.source), _doubts(measured.target)) > 1 else "one cloud"
        says = "are not those of the surface" if tilt > TILTED_DEG else "point to either side at random"
        helps = trial is not None and trial.is_better and "normals" in trial.changes
        return finding(
            "normals", "input", severity, f"The normals of {which} {says}.",
            (*evidence, *trial_evidence(trial if helps else None)),
            "Estimate them anew, turned to the sensor; give its position with --viewpoint if it is not the origin.",
            {"normals": "estimated"} if measured.case.wanted.normals == "stored" else {}, 0.95 if helps else 0.85,
        )  # fmt: skip
    if trial is not None and trial.is_better and "flip_normals" in trial.changes:
        return finding(
            "normals", "input", severity, "The normals of one cloud point to the other side of the surface.",
            (*evidence, *trial_evidence(trial)),
            "Turn round the normals of one cloud, so that both face the sensor.", trial.changes, 0.97,
        )  # fmt: skip
    if known is not None and known.overlap > 0.05 and known.opposed > AGAINST:
        return finding(
            "normals", "input", "problem" if known.opposed > MOSTLY_AGAINST else "caution",
            "Where the clouds overlap, their normals point to opposite sides.", tuple(evidence),
            "Turn round the normals of one cloud, so that both face the sensor.", flip_changes(measured), 0.9,
        )  # fmt: skip
    return Finding("normals", "input", "fine", "Normals are consistent.", tuple(evidence), confidence=0.9)


def _against(measured: Measures, known: UnderPose) -> Evidence:
    return Evidence(
        "Overlapping points with opposed normals", known.opposed, "share", AGAINST, "at most",
        estimated=measured.truth is None,
    )  # fmt: skip


def _doubts(surface: Surface) -> float:
    """Above 1 where the normals of this cloud contradict it."""
    return max(surface.opposed_share / OPPOSED, surface.tilt_deg / TILTED_DEG)


def in_other_units(wanted: PairSettings, changes: dict[str, Any]) -> str:
    """By what the source must be multiplied, and which units differ by that."""
    factor = changes["source_scale"] / wanted.source_scale
    named = {1000: "metres and millimetres", 100: "metres and centimetres", 10: "centimetres and millimetres",
             25.4: "inches and millimetres", 2.54: "inches and centimetres", 3.28084: "metres and feet"}  # fmt: skip
    units = next(
        (name for size, name in named.items() if math.isclose(max(factor, 1 / factor), size, rel_tol=1e-3)), ""
    )
    return f"the source must be multiplied by {factor:.4g}" + (f", as between {units}" if units else "")

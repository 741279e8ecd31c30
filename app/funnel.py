"""How many points each stage rejects, and which one rejected the picked point."""

from dataclasses import dataclass

import numpy as np

from app.analysis import Analysis, Scores
from app.explorer import Findings, step_order, step_place
from app.plots import right_within
from app.settings import ViewSettings
from cgf.pipeline import REJECTIONS, Rejection, Side, uses_frames


@dataclass(frozen=True)
class Step:
    """One stage of the way from points to right matches."""

    name: str
    count: int
    """Of the source's points that no stage up to this one rejects."""
    right: int | None = None
    """Those whose match is right; None where there is no match yet, or no pose to judge by."""
    precision: float | None = None
    """`right` over `count`."""


@dataclass(frozen=True)
class PickedInfo:
    """The point looked into, in short; `/api/point` has the rest."""

    side: Side
    index: int
    stage: Rejection
    label: str
    """The stage for people."""
    step: int | None
    """Its place among the matches that are gone through one by one, from 1."""
    steps: int
    """How many these are."""


_STEPS: dict[Rejection, str] = {
    "no_frame": "With a frame",
    "no_feature": "With a feature",
    "no_partner": "Overlapping",
    "not_mutual": "Mutual",
    "above_ratio": "Ratio",
    "unsure": "Surest",
    "outlier": "Inliers",
}
"""What passes each stage."""


def funnel_of(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[Step, ...]:
    """How many of the source's points are left after each stage, and how many of their matches are right."""
    steps = [Step("Points in the source", len(analysis.pair.source)), Step("After downsampling", len(analysis.source))]
    if findings.stages is None or scores is None or analysis.matches is None:
        if analysis.source_features is not None:
            steps.append(Step(_STEPS["no_feature"], len(analysis.source_features)))
        return tuple(steps)
    stages = findings.stages.source
    is_judged = scores.reference is not None
    right = np.zeros(len(stages), dtype=np.bool_)
    near = right_within(analysis, settings)
    right[analysis.matches.correspondences.indices[:, 0]] = scores.forward.errors <= near
    framed, undescribed = uses_frames(analysis.resolved), bool((stages == REJECTIONS.index("no_feature")).any())
    asked = {
        "no_frame": framed, "no_feature": undescribed or not framed, "no_partner": is_judged,
        "not_mutual": settings.mutual, "above_ratio": settings.max_ratio is not None,
        "unsure": settings.surest is not None, "outlier": findings.stages.judged,
    }  # fmt: skip
    for code, (stage, name) in enumerate(_STEPS.items()):
        if asked[stage]:
            passing = stages > code
            count, good = int(np.count_nonzero(passing)), int(np.count_nonzero(right & passing))
            matched = is_judged and not (stage == "no_frame" and undescribed)
            steps.append(Step(name, count, good if matched else None, good / count if matched and count else None))
    return tuple(steps)


def stage_text(stage: Rejection, *, judged: bool) -> str:
    """What became of a point, in a few words."""
    return {
        "no_frame": "no frame",
        "no_feature": "no feature",
        "no_partner": "no true partner",
        "not_mutual": "not mutual",
        "above_ratio": "above the ratio",
        "unsure": "not among the surest",
        "outlier": "outlier",
        "none": "inlier" if judged else "passes",
    }[stage]


def picked_of(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> PickedInfo | None:
    """The picked point, once there are matches."""
    picked = settings.picked
    if picked is None or findings.picked is None or findings.stages is None or scores is None:
        return None
    assert analysis.matches is not None
    stages = findings.stages.source if picked.side == "source" else findings.stages.target
    stage = REJECTIONS[int(stages[picked.index])]
    rows = step_order(analysis, scores, settings)
    place = step_place(analysis.matches.correspondences.indices[rows, 0], picked)
    label = stage_text(stage, judged=findings.stages.judged)
    return PickedInfo(picked.side, picked.index, stage, label, None if place is None else place + 1, len(rows))

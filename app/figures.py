"""What the page is told: figures, ranges of controls, and what to know before trusting them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from app.analysis import Analysis, Scores, kept_rows
from app.coloring import error_scale, has_quality
from app.explorer import Findings
from app.funnel import funnel_of, picked_of
from app.legend import legend_of
from app.pair_source import PairSource, match_command, open_command
from app.plots import right_within
from app.poses import shown_pose
from app.settings import MAX_LINES, POINT_SIZES, Coloring, Pose, Reference, ViewSettings
from app.shown import Shown
from app.snapshot import CloudInfo, Controls, Curve, Estimate, Limits, Message, Model, Numbers, Snapshot, Status, Unit
from app.state_text import write_state
from app.wording import in_words_of_the_page
from cgf import descriptors, pipeline
from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.evaluation import metrics
from cgf.geometry import transforms
from cgf.types import Features, PointCloud

CURVE_STEPS = 60
STARTING = Status("working", "Starting", 0.0)


def unit_of(analysis: Analysis) -> Unit:
    """Metres for rooms, else whatever the file has."""
    resolved = analysis.resolved
    return Unit("m" if resolved.model == "indoor" else "units", resolved.diameter, resolved.unit_m)


def controls_of(analysis: Analysis) -> Controls:
    """Ranges that make sense for this pair."""
    resolved = analysis.resolved
    defaults = MODEL_DEFAULTS[resolved.model].scaled(resolved.diameter, resolved.unit_m)
    poses: list[Pose] = ["loaded"]
    references: list[Reference] = []
    if analysis.truth is not None:
        poses.append("ground_truth")
        references.append("ground_truth")
    if analysis.estimate is not None:
        poses.append("estimate")
        references.append("estimate")
    spacing = resolved.spacing
    return Controls(
        descriptors=descriptors.available(),
        dims=descriptors.dimensions(resolved.descriptor, resolved.model, weights=resolved.weights),
        dim=resolved.dim,
        poses=tuple(poses),
        references=tuple(references),
        # While features are computed, nobody knows yet whether they will have a quality.
        colorings=tuple(
            name for name in get_args(Coloring)
            if name != "quality" or analysis.source_features is None or has_quality(analysis)
        ),
        support_radius=Limits(
            max(2 * spacing, defaults.support_radius / 8), min(resolved.diameter, 2.5 * defaults.support_radius),
            defaults.support_radius,
        ),
        lrf_radius=Limits(
            max(2 * spacing, defaults.lrf_radius / 4), min(resolved.diameter, 4 * defaults.lrf_radius),
            max(defaults.lrf_radius, 3 * spacing),
        ),
        voxel_size=Limits(defaults.voxel_size / 4, 4 * defaults.voxel_size, defaults.voxel_size),
        error_scale=Limits(defaults.error_scale / 10, 4 * defaults.error_scale, defaults.error_scale),
        line_count=Limits(0, min(MAX_LINES, 2_000), 300),
        point_size=Limits(*POINT_SIZES, 1.0),
    )  # fmt: skip


def numbers_of(analysis: Analysis, scores: Scores, settings: ViewSettings) -> tuple[Numbers | None, Curve | None]:
    """Headline figures and the curve of the matches that pass the filters; None where no pose is known."""
    if analysis.matches is None or scores.reference is None:
        return None, None
    rows = kept_rows(analysis.matches, settings)
    errors, partner = scores.forward.errors[rows], scores.forward.has_partner[rows]
    near = right_within(analysis, settings)
    judged = errors[partner]
    precision = metrics.precision(judged, threshold=near)
    numbers = Numbers(
        matches=len(rows),
        with_partner=len(judged),
        right=int(np.count_nonzero(judged <= near)),
        precision=_finite(precision),
        inlier_ratio=_finite(metrics.precision(errors, threshold=near)),
        median_error=_finite(float(np.median(judged))) if len(judged) else None,
        precision_radius=near,
        tau=analysis.resolved.tau,
    )
    if not len(judged):
        return numbers, None
    thresholds = np.linspace(0, error_scale(analysis, settings), CURVE_STEPS + 1)
    shares = metrics.precision_curve(judged, thresholds)
    return numbers, Curve(tuple(thresholds.tolist()), tuple(shares.tolist()), len(judged))


def estimate_of(analysis: Analysis) -> Estimate | None:
    """What is known of the estimate, and how far it is from the truth."""
    registration, pose, truth = analysis.registration, analysis.estimate, analysis.truth
    given = analysis.given_estimate is not None
    if analysis.chosen_run is not None:
        given, registration = False, analysis.chosen_run.result
    if registration is None and not given:
        return None
    compared = pose is not None and truth is not None
    return Estimate(
        given=given,
        found=pose is not None,
        method="given" if given or registration is None else registration.method,
        fitness=None if given or registration is None else _finite(registration.fitness),
        rmse=None if given or registration is None else _finite(registration.inlier_rmse),
        rotation_error_deg=transforms.rotation_error_deg(pose, truth) if compared else None,  # type: ignore[arg-type]
        translation_error=transforms.translation_error(pose, truth) if compared else None,  # type: ignore[arg-type]
    )


def messages_of(
    analysis: Analysis, scores: Scores | None, numbers: Numbers | None, settings: ViewSettings
) -> list[Message]:
    """What a person should know about this pair before trusting the figures."""
    found = []
    resolved = analysis.resolved
    if resolved.choice.warning is not None:
        found.append(Message("warning", resolved.choice.warning))
    if analysis.registration is not None and analysis.matches is not None:
        correspondences = analysis.matches.correspondences.take(kept_rows(analysis.matches, settings))
        warning = pipeline.registration_warning(analysis.registration, correspondences, resolved)
        if warning is not None:
            found.append(Message("warning", warning))
    if scores is not None and numbers is not None and scores.reference is not None:
        name = "ground truth" if scores.reference == "ground_truth" else "estimate"
        if not scores.source_partner.any():
            text = f"Under the {name} the clouds do not overlap: no source point comes within {resolved.tau:.3g} of the"
            found.append(Message("warning", f"{text} target. Check the pose, and that both files belong to this pair."))
        elif not numbers.matches:
            found.append(Message("warning", "No match passes the filters; relax them."))
        if analysis.truth is None:
            found.append(Message("info", "No ground truth: errors are relative to the estimate."))
    return found


def pose_of(analysis: Analysis, settings: ViewSettings) -> str | None:
    """Name of the pose that is drawn; None between two."""
    return shown_pose(analysis, settings).name


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def first_snapshot(pairs: Sequence[PairSource], settings: ViewSettings, *, error: str | None) -> Snapshot:
    """What is told before there are clouds."""
    return Snapshot(
        revision=0, status=STARTING, settled=False, previewed=None, pairs=tuple(pair.name for pair in pairs),
        settings=settings, source=None, target=None, unit=None, model=None, controls=None, pose=None, reference=None,
        numbers=None, estimate=None, curve=None, funnel=(), picked=None, legend=None, messages=_failures(error),
        diagnosis=None, columns=(), command="", shared=write_state(settings), open_command="",
    )  # fmt: skip


def snapshot_of(
    analysis: Analysis,
    scores: Scores | None,
    findings: Findings,
    settings: ViewSettings,
    pairs: Sequence[PairSource],
    *,
    error: str | None,
) -> Snapshot:
    """What is told of an analysis; what is compared with it, and its diagnosis, are told beside it.

    Args:
        analysis: As far as it has come.
        scores: Of its matches; None before there are any.
        findings: What is known of stages and of the picked point.
        settings: As chosen, which may be those of an analysis to come.
        pairs: All that were opened.
        error: Why the last change failed.
    """
    numbers, curve = (None, None) if scores is None else numbers_of(analysis, scores, settings)
    warnings = tuple(
        replace(message, text=in_words_of_the_page(message.text))
        for message in messages_of(analysis, scores, numbers, settings)
    )
    choice = analysis.resolved.choice
    return replace(
        first_snapshot(pairs, settings, error=error),
        source=_cloud_info(analysis.pair.source, analysis.source_shown, analysis.source, analysis.source_features),
        target=_cloud_info(analysis.pair.target, analysis.target_shown, analysis.target, analysis.target_features),
        unit=unit_of(analysis),
        model=Model(choice.name, choice.reason),
        controls=controls_of(analysis),
        pose=pose_of(analysis, settings),
        reference=None if scores is None else scores.reference,
        numbers=numbers,
        estimate=estimate_of(analysis),
        curve=curve,
        funnel=funnel_of(analysis, scores, settings, findings),
        picked=picked_of(analysis, scores, settings, findings),
        legend=legend_of(analysis, scores, settings, findings),
        messages=(*_failures(error), *warnings),
        command=match_command(pairs[analysis.index], settings),
        open_command=open_command(pairs[analysis.index], settings),
    )


def _failures(error: str | None) -> tuple[Message, ...]:
    return () if error is None else (Message("error", error),)


def _cloud_info(loaded: PointCloud, shown: Shown, prepared: PointCloud, features: Features | None) -> CloudInfo:
    count = None if features is None else len(features)
    return CloudInfo(loaded.name, len(loaded), len(shown.cloud), len(prepared), count)

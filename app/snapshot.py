"""What the page is told: plain values, ready to become JSON."""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from app.analysis import Analysis, Scores, kept_rows
from app.colors import (
    NO_MATCH,
    NO_PARTNER,
    PARTNER,
    PICKED,
    SOURCE_TINT,
    STAGE_COLORS,
    TARGET_TINT,
    UNJUDGED,
    are_colors_usable,
    distance_colors,
    error_colors,
    quality_colors,
    shaded_colors,
)
from app.compare import ColumnInfo
from app.explorer import Findings, distance_range
from app.funnel import PickedInfo, Step, stage_text
from app.picture import error_scale, has_quality, residual_scale, shown_coloring
from app.plots import right_within
from app.poses import shown_pose
from app.settings import MAX_LINES, POINT_SIZES, Coloring, Pose, Reference, ViewSettings
from app.tasks import Task
from cgf import descriptors, pipeline
from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.evaluation import metrics
from cgf.geometry import transforms
from cgf.pipeline import REJECTIONS

CURVE_STEPS = 60
LEGEND_STEPS = 256


@dataclass(frozen=True)
class Status:
    """What the worker does."""

    phase: Literal["working", "ready", "failed"]
    text: str
    progress: float
    """Share done, from 0 to 1."""
    elapsed_s: float | None = None
    """How long the last change took, once it is done."""
    tasks: tuple[Task, ...] = ()
    """What panels have done beside the main work."""


@dataclass(frozen=True)
class CloudInfo:
    """One of the two clouds."""

    name: str
    points: int
    """In the file."""
    shown: int
    """Drawn: fewer where the file has very many."""
    prepared: int
    """After downsampling: those that features and matches count."""
    features: int | None


@dataclass(frozen=True)
class Unit:
    """How lengths are to be written."""

    name: Literal["m", "units"]
    diameter: float
    """Of the larger cloud; lengths of objects are understood as shares of it."""
    metres: float = 1.0
    """Length of one unit of the clouds, where `name` is m."""


@dataclass(frozen=True)
class Model:
    """Which weights and defaults, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Limits:
    """Range of a length's slider, in cloud units; other values may be typed."""

    low: float
    high: float
    default: float


@dataclass(frozen=True)
class Controls:
    """What each control of the page shows and offers."""

    descriptors: tuple[str, ...]
    dims: tuple[int, ...]
    dim: int
    """The one in use."""
    poses: tuple[Pose, ...]
    references: tuple[Reference, ...]
    colorings: tuple[Coloring, ...]
    support_radius: Limits
    lrf_radius: Limits
    voxel_size: Limits
    error_scale: Limits
    line_count: Limits
    point_size: Limits


@dataclass(frozen=True)
class Numbers:
    """The figures of merit of the matches that pass the filters."""

    matches: int
    with_partner: int
    """Those whose source point has a true partner."""
    right: int
    """Those within `precision_radius` among the latter."""
    precision: float | None
    """`right` over `with_partner`."""
    inlier_ratio: float | None
    """Share of all matches within `precision_radius`."""
    median_error: float | None
    """Of matches with a true partner, in cloud units."""
    precision_radius: float
    tau: float


@dataclass(frozen=True)
class Estimate:
    """The pose that was brought along, or estimated from the matches."""

    given: bool
    found: bool
    method: str
    fitness: float | None
    """Share of source points near the target after moving."""
    rmse: float | None
    rotation_error_deg: float | None
    """Against the ground truth; None without one."""
    translation_error: float | None


@dataclass(frozen=True)
class Curve:
    """Precision over the error that is still accepted."""

    thresholds: tuple[float, ...]
    precision: tuple[float, ...]
    count: int
    """Matches it is taken over."""


@dataclass(frozen=True)
class Swatch:
    """A colour with a meaning."""

    color: str
    label: str


@dataclass(frozen=True)
class Tick:
    """A mark along a ramp."""

    at: float
    label: str


@dataclass(frozen=True)
class Legend:
    """What the colours in the picture mean, from the functions that painted it."""

    coloring: Coloring
    title: str
    ramp: tuple[str, ...]
    """From no error to `scale`, or along `ticks`; empty where colours mean neither."""
    scale: float | None
    """In cloud units."""
    swatches: tuple[Swatch, ...]
    ticks: tuple[Tick, ...] = ()
    """Of a ramp that means something else than errors, from 0 to 1 along it."""


@dataclass(frozen=True)
class Message:
    """A line for the person."""

    level: Literal["error", "warning", "info"]
    text: str


@dataclass(frozen=True)
class DiagnosisInfo:
    """A diagnosis in short."""

    number: int
    """Grows with every diagnosis."""
    outcome: str
    verdict: str
    problems: int
    cautions: int


@dataclass(frozen=True)
class Snapshot:
    """The whole state of the page."""

    revision: int
    """Grows with every change but the status's."""
    status: Status
    settled: bool
    """Whether everything shown belongs to the settings shown."""
    previewed: int | None
    """Points whose features colour all others for the moment, while the numbers are still those before the change."""
    pairs: tuple[str, ...]
    settings: ViewSettings
    """As chosen; None where the default of `controls` holds."""
    source: CloudInfo | None
    target: CloudInfo | None
    unit: Unit | None
    model: Model | None
    controls: Controls | None
    pose: str | None
    """Where the source is drawn: one of `controls.poses`, a run, or None between two poses."""
    reference: Reference | None
    """What errors are measured against."""
    numbers: Numbers | None
    estimate: Estimate | None
    curve: Curve | None
    funnel: tuple[Step, ...]
    picked: PickedInfo | None
    legend: Legend | None
    messages: tuple[Message, ...]
    diagnosis: DiagnosisInfo | None
    """Whether the pair registers and why not; None until that is found out."""
    columns: tuple[ColumnInfo, ...]
    """What is compared, one beside the other; empty where it is the pair itself that is shown."""
    command: str
    """The command line that gives the same matches; empty where the pair has no files."""
    shared: str
    """The settings that differ from their defaults, as links and `--state` carry them."""
    open_command: str
    """The command line that opens the pair; with `shared` behind `--state`, it shows the same. Empty without files."""


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


def legend_of(analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings) -> Legend:
    """Explain the colours, which are made by the functions that coloured the points."""
    if settings.columns:
        # Columns show errors, whatever the pair itself showed.
        settings = replace(settings, coloring="error")
    coloring = shown_coloring(analysis, scores, settings, findings)
    if coloring == "distance":
        return _distance_legend(findings)
    if coloring == "stage":
        return _stage_legend(findings)
    if coloring == "quality":
        return _quality_legend()
    if coloring == "residual":
        scale = residual_scale(analysis, settings)
        ramp = error_colors(np.linspace(0, scale, LEGEND_STEPS), scale=scale, palette=settings.palette)
        title = "Distance to the nearest point of the other cloud, as drawn"
        return Legend(coloring, title, tuple(hexed(color) for color in ramp.tolist()), scale, ())
    judged = scores is not None and scores.reference is not None
    swatches: list[Swatch] = []
    if coloring == "error":
        points = "Error of each point's match"
        swatches += [
            Swatch(hexed(NO_PARTNER), "no true partner"),
            Swatch(hexed(NO_MATCH), "no match" if settings.bar is None else "other match"),
        ]
    elif coloring == "features":
        points = "Points: like features, like colours"
        if len(analysis.source_features or ()) < len(analysis.source):
            swatches.append(Swatch(hexed(NO_MATCH), "no feature"))
    else:
        points = "Points: own colours"
        sides = (("source", analysis.source_shown, SOURCE_TINT), ("target", analysis.target_shown, TARGET_TINT))
        for side, shown, tint in sides:
            if shown.cloud.colors is None or not are_colors_usable(shown.cloud.colors):
                points = "Points: shaded"
                swatches.append(Swatch(hexed(_facing(tint)), side))
    if scores is None:
        return Legend(coloring, points, (), None, tuple(swatches))
    if not judged:
        swatches.append(Swatch(hexed(UNJUDGED), "match, no pose to judge it"))
        return Legend(coloring, points, (), None, tuple(swatches))
    title = points if coloring == "error" else f"{points} · Lines: error"
    scale = error_scale(analysis, settings)
    ramp = error_colors(np.linspace(0, scale, LEGEND_STEPS), scale=scale, palette=settings.palette)
    return Legend(coloring, title, tuple(hexed(color) for color in ramp.tolist()), scale, tuple(swatches))


def _distance_legend(findings: Findings) -> Legend:
    ends = distance_range(findings.picked)
    assert ends is not None
    low, high = ends
    ramp = distance_colors(np.geomspace(low, high, LEGEND_STEPS), low=low, high=high)
    magnitudes = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    round_values = (magnitudes[:, None] * [1, 2, 3, 5, 7]).ravel()
    inside = [value for value in round_values.tolist() if 1.04 * low < value < high / 1.04]
    ticks = [Tick(math.log(value / low) / math.log(high / low), f"{value:.3g}") for value in (low, *inside, high)]
    return Legend(
        "distance",
        "Feature distance to the picked point",
        tuple(hexed(color) for color in ramp.tolist()),
        None,
        (
            Swatch(hexed(PICKED), "picked"),
            Swatch(hexed(PARTNER), "true partner"),
            Swatch(hexed(NO_MATCH), "no feature"),
        ),
        tuple(ticks),
    )


def _quality_legend() -> Legend:
    ramp = quality_colors(np.linspace(0, 1, LEGEND_STEPS))
    return Legend(
        "quality",
        "Quality of features · Lines: product of both ends",
        tuple(hexed(color) for color in ramp.tolist()),
        None,
        (Swatch(hexed(NO_MATCH), "no feature"),),
        tuple(Tick(value, f"{value:g}") for value in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)),
    )


def _stage_legend(findings: Findings) -> Legend:
    assert findings.stages is not None
    present = set(np.unique(np.concatenate([findings.stages.source, findings.stages.target])).tolist())
    swatches = [
        Swatch(hexed(STAGE_COLORS[name]), stage_text(name, judged=findings.stages.judged))
        for code, name in enumerate(REJECTIONS)
        if code in present
    ]
    return Legend("stage", "The stage that rejects a point or match", (), None, tuple(swatches))


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


def _facing(tint: tuple[int, int, int]) -> list[int]:
    """The tint as points have it that face the sensor."""
    up = np.array([[0.0, 0.0, 1.0]])
    color: list[int] = shaded_colors(tint, np.zeros((1, 3)), up, viewpoint=up[0])[0].tolist()
    return color


def hexed(color: tuple[int, int, int] | list[int]) -> str:
    """A colour as pages write it."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

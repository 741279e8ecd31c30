"""How errors and feature distances of the matches are spread, and how precision depends on dimension and radius."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Analyst, Scores, kept_rows
from app.coloring import error_scale
from app.colors import error_colors
from app.jobs import Job
from app.settings import ViewSettings
from cgf import descriptors, pipeline
from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.evaluation import metrics
from cgf.matching import MatchTable, filter_rows
from cgf.types import PointCloud

ERROR_BARS = 30
DISTANCE_BARS = 40
RADIUS_FACTORS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Of the model's own radius: the radii that are tried."""

SweepName = Literal["dim", "radius"]


@dataclass(frozen=True)
class ErrorBars:
    """Matches that have a true partner, by their error."""

    edges: tuple[float, ...]
    """In cloud units, one more than bars."""
    counts: tuple[int, ...]
    colors: tuple[str, ...]
    """Of the points and lines with such an error."""
    beyond: int
    """Matches with a larger error than the last edge."""


@dataclass(frozen=True)
class DistanceBars:
    """Right and wrong matches that have a true partner, by their feature distance."""

    edges: tuple[float, ...]
    right: tuple[int, ...]
    wrong: tuple[int, ...]
    separation: float | None
    """How often a right match drawn at random is nearer than a wrong one (area under the ROC curve)."""


@dataclass(frozen=True)
class SweepPoint:
    """Precision with another value of one setting."""

    value: float
    precision: float | None
    """None while it is not computed."""


@dataclass(frozen=True)
class Sweep:
    """Precision over one setting."""

    points: tuple[SweepPoint, ...]
    current: float
    """The value in use."""


@dataclass(frozen=True)
class Plots:
    """What the plots draw, under the settings of now."""

    revision: int
    """Of the state they belong to."""
    right_within: float
    """Error up to which a match is right, in cloud units."""
    error_bars: ErrorBars | None
    """None where no pose is known."""
    distance_bars: DistanceBars | None
    dims: Sweep
    radii: Sweep


def right_within(analysis: Analysis, settings: ViewSettings) -> float:
    """Error up to which a match counts as right, in cloud units."""
    return analysis.resolved.precision_radius if settings.right_within is None else settings.right_within


def make_plots(revision: int, analysis: Analysis, scores: Scores, settings: ViewSettings, analyst: Analyst) -> Plots:
    """All plots of an analysis that has matches."""
    near = right_within(analysis, settings)
    error_bars = distance_bars = None
    if scores.reference is not None:
        assert analysis.matches is not None
        rows = kept_rows(analysis.matches, settings)
        rows = rows[scores.forward.has_partner[rows]]
        errors = scores.forward.errors[rows]
        error_bars = _error_bars(errors, error_scale(analysis, settings), settings)
        distance_bars = _distance_bars(analysis.matches.correspondences.distances[rows], errors <= near)
    return Plots(
        revision=revision,
        right_within=near,
        error_bars=error_bars,
        distance_bars=distance_bars,
        dims=_sweep("dim", analysis, scores, settings, analyst, near),
        radii=_sweep("radius", analysis, scores, settings, analyst, near),
    )


def _error_bars(errors: npt.NDArray[np.float64], scale: float, settings: ViewSettings) -> ErrorBars:
    edges = np.linspace(0, scale, ERROR_BARS + 1)
    counts, _ = np.histogram(errors, edges)
    middles = (edges[:-1] + edges[1:]) / 2
    colors = error_colors(middles, scale=scale, palette=settings.palette).tolist()
    return ErrorBars(
        edges=tuple(edges.tolist()),
        counts=tuple(counts.tolist()),
        colors=tuple("#{:02x}{:02x}{:02x}".format(*color) for color in colors),
        beyond=int(np.count_nonzero(errors > scale)),
    )


def _distance_bars(distances: npt.NDArray[np.float32], is_right: npt.NDArray[np.bool_]) -> DistanceBars | None:
    if not len(distances):
        return None
    # A few outliers shall not squeeze all the others into one bar.
    edges = np.linspace(0.0, max(float(np.percentile(distances, 99.5)), 1e-9), DISTANCE_BARS + 1)
    inside = np.minimum(distances, edges[-1])
    right, _ = np.histogram(inside[is_right], edges)
    wrong, _ = np.histogram(inside[~is_right], edges)
    return DistanceBars(
        edges=tuple(edges.tolist()),
        right=tuple(right.tolist()),
        wrong=tuple(wrong.tolist()),
        separation=separation(distances[is_right], distances[~is_right]),
    )


def separation(right: npt.NDArray[np.float32], wrong: npt.NDArray[np.float32]) -> float | None:
    """How often one of `right` is smaller than one of `wrong`, ties counting half; None if either is empty."""
    if not len(right) or not len(wrong):
        return None
    ordered = np.sort(wrong)
    above = len(wrong) - (np.searchsorted(ordered, right, "left") + np.searchsorted(ordered, right, "right")) / 2
    return float(above.mean() / len(wrong))


def sweep_settings(name: SweepName, analysis: Analysis, settings: ViewSettings) -> dict[float, ViewSettings]:
    """The settings that a sweep computes, by the value of the setting it is about; ascending."""
    resolved = analysis.resolved
    if name == "dim":
        dims = descriptors.dimensions(resolved.descriptor, resolved.model, weights=resolved.weights)
        return {float(dim): replace(settings, dim=dim) for dim in dims}
    default = MODEL_DEFAULTS[resolved.model].scaled(resolved.diameter, resolved.unit_m).support_radius
    values = {float(f"{factor * default:.3g}") for factor in RADIUS_FACTORS}
    radii = sorted(value for value in values if 2 * resolved.spacing < value <= resolved.diameter)
    # The model's own radius and the one in use come as they are, so that what is known of them is found again.
    by_value = {
        (default if math.isclose(value, default, rel_tol=5e-3) else value): replace(
            settings, support_radius=None if math.isclose(value, default, rel_tol=5e-3) else value, min_radius=None
        )
        for value in radii
    }
    by_value[resolved.support_radius] = settings
    return dict(sorted(by_value.items()))


def run_sweep(name: SweepName, analysis: Analysis, settings: ViewSettings, analyst: Analyst, job: Job) -> bool:
    """Compute the next value of a sweep that is not known yet; tells whether there was one.

    Raises:
        InputError: That value cannot be used with this pair.
        Cancelled: The job is no longer wanted.
    """
    chosen = sweep_settings(name, analysis, settings)
    missing = [value for value, wanted in chosen.items() if _known(analysis, wanted, analyst) is None]
    if not missing:
        return False
    done = len(chosen) - len(missing)
    part = job.part(done / len(chosen), (done + 1) / len(chosen), f"{done + 1} of {len(chosen)}")
    analyst.run(chosen[missing[0]], part, lambda _: None)
    assert _known(analysis, chosen[missing[0]], analyst) is not None
    return True


def _known(analysis: Analysis, wanted: ViewSettings, analyst: Analyst) -> MatchTable | None:
    try:
        resolved = pipeline.resolve(wanted.pair_settings(), analysis.pair.source, analysis.pair.target)
    except ValueError:
        return None
    found = analyst.known_matches(analysis.index, resolved)
    return None if found is None else found[0]


def _sweep(
    name: SweepName, analysis: Analysis, scores: Scores, settings: ViewSettings, analyst: Analyst, near: float
) -> Sweep:
    current = float(analysis.resolved.dim) if name == "dim" else analysis.resolved.support_radius
    points = []
    for value, wanted in sweep_settings(name, analysis, settings).items():
        table = _known(analysis, wanted, analyst)
        points.append(SweepPoint(value, None if table is None else _precision(analysis, scores, settings, table, near)))
    return Sweep(tuple(points), current)


def _precision(
    analysis: Analysis, scores: Scores, settings: ViewSettings, table: MatchTable, near: float
) -> float | None:
    """Of matches of the same prepared clouds, so that the points with a true partner are those of `scores`."""
    known = analysis.reference(settings.reference)
    if known is None:
        return None
    pose = tuple(known[1].ravel().tolist())
    errors = _judged_errors(
        table, scores, analysis.source, analysis.target, pose,
        mutual=settings.mutual, max_ratio=settings.max_ratio, surest=settings.surest,
    )  # fmt: skip
    precision = metrics.precision(errors, threshold=near)
    return precision if math.isfinite(precision) else None


@lru_cache(maxsize=48)
def _judged_errors(
    table: MatchTable, scores: Scores, source: PointCloud, target: PointCloud, pose: tuple[float, ...], *,
    mutual: bool, max_ratio: float | None, surest: float | None,
) -> npt.NDArray[np.float64]:  # fmt: skip
    """Errors of the matches that pass the filters and have a true partner; asked for again as the threshold moves."""
    rows = filter_rows(table, mutual=mutual, max_ratio=max_ratio, surest=surest)
    indices = table.correspondences.indices[rows]
    indices = indices[scores.source_partner[indices[:, 0]]]
    return metrics.correspondence_errors(source.points, target.points, indices, np.array(pose).reshape(4, 4))

"""Which colour each point has, and what it is taken from."""

import weakref
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Scores, kept_rows
from app.colors import (
    NO_MATCH,
    SOURCE_TINT,
    TARGET_TINT,
    Colors,
    are_colors_usable,
    distance_colors,
    error_colors,
    feature_basis,
    feature_colors,
    quality_colors,
    shaded_colors,
    stage_colors,
)
from app.explorer import Findings, distance_range
from app.poses import residuals, shown_pose
from app.settings import Coloring, ViewSettings
from app.shown import Shown
from cgf.evaluation.matches import MatchErrors
from cgf.matching import MatchTable
from cgf.types import Features, PointCloud


def shown_coloring(analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings) -> Coloring:
    """The colouring chosen, or what comes closest before the stages for that are done."""
    wanted = settings.coloring
    if wanted == "residual":
        return "residual"
    if wanted == "original" or analysis.source_features is None:
        return "original"
    if wanted == "stage" and findings.stages is not None:
        return "stage"
    if wanted == "distance" and distance_range(findings.picked) is not None:
        return "distance"
    if wanted == "quality" and has_quality(analysis):
        return "quality"
    return "error" if wanted != "features" and scores is not None and scores.reference is not None else "features"


def has_quality(analysis: Analysis) -> bool:
    """Whether the features say how distinctive they are."""
    both = (analysis.source_features, analysis.target_features)
    return all(features is not None and features.quality is not None for features in both)


def point_colors(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[Colors, Colors]:
    """Colours of the points drawn."""
    prepared = _prepared_colors(analysis, scores, settings, findings)
    if prepared is None:
        return (
            _own_colors(analysis.source_shown, analysis.source, SOURCE_TINT),
            _own_colors(analysis.target_shown, analysis.target, TARGET_TINT),
        )
    return prepared[0][analysis.source_shown.prepared_rows], prepared[1][analysis.target_shown.prepared_rows]


def _prepared_colors(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[Colors, Colors] | None:
    """Colours of the prepared points; None where the points' own are to be shown."""
    source_features, target_features = analysis.source_features, analysis.target_features
    coloring = shown_coloring(analysis, scores, settings, findings)
    if coloring == "residual":
        scale = residual_scale(analysis, settings)
        both = residuals(analysis, shown_pose(analysis, settings).matrix, limit=scale)
        source, target = (error_colors(distances, scale=scale, palette=settings.palette) for distances in both)
        return source, target
    if coloring == "original" or source_features is None or target_features is None:
        return None
    if coloring == "stage":
        assert findings.stages is not None
        return stage_colors(findings.stages.source), stage_colors(findings.stages.target)
    if coloring == "distance":
        return _distances_of_points(findings)
    if coloring == "error":
        assert scores is not None
        assert analysis.matches is not None
        assert analysis.back_matches is not None
        scale = error_scale(analysis, settings)
        return (
            _errors_of_points(len(analysis.source), analysis.matches, scores.forward, scores.source_partner,
                              settings, scale),
            _errors_of_points(len(analysis.target), analysis.back_matches, scores.back, scores.target_partner,
                              settings, scale),
        )  # fmt: skip
    if source_features.quality is not None and target_features.quality is not None and coloring == "quality":
        source, target = quality_colors(source_features.quality), quality_colors(target_features.quality)
    else:
        source, target = _colors_of_features(source_features, target_features)
    return (
        _spread(source_features, source, len(analysis.source)),
        _spread(target_features, target, len(analysis.target)),
    )


_FEATURE_COLORS: WeakKeyDictionary[Features, tuple[weakref.ref[Features], tuple[Colors, Colors]]] = WeakKeyDictionary()
"""Of source features, with the target features that share their basis: pictures change more often than features."""


def _colors_of_features(source: Features, target: Features) -> tuple[Colors, Colors]:
    kept = _FEATURE_COLORS.get(source)
    if kept is None or kept[0]() is not target:
        basis = feature_basis(source.vectors, target.vectors)
        colors = feature_colors(source.vectors, basis), feature_colors(target.vectors, basis)
        kept = _FEATURE_COLORS[source] = (weakref.ref(target), colors)
    return kept[1]


def _distances_of_points(findings: Findings) -> tuple[Colors, Colors]:
    picked, ends = findings.picked, distance_range(findings.picked)
    assert picked is not None
    assert ends is not None
    own, other = (
        distance_colors(distances, low=ends[0], high=ends[1]) for distances in (picked.own_distances, picked.distances)
    )
    return (own, other) if picked.side == "source" else (other, own)


def error_scale(analysis: Analysis, settings: ViewSettings) -> float:
    """Error from which on the colour is the last of the palette, in cloud units."""
    return analysis.resolved.error_scale if settings.error_scale is None else settings.error_scale


def residual_scale(analysis: Analysis, settings: ViewSettings) -> float:
    """Distance between the surfaces from which on the colour is the last of the palette, in cloud units."""
    return analysis.resolved.inlier_distance if settings.error_scale is None else settings.error_scale


def in_bar(
    rows: npt.NDArray[np.int64], table: MatchTable, measured: MatchErrors, settings: ViewSettings
) -> npt.NDArray[np.int64]:
    """Those of `rows` that fall in the bar of a histogram that was chosen, if one was."""
    bar = settings.bar
    if bar is None:
        return rows
    values = (measured.errors if bar.kind == "error" else table.correspondences.distances)[rows]
    return rows[(values >= bar.low) & (values <= bar.high) & measured.has_partner[rows]]


def _own_colors(shown: Shown, prepared: PointCloud, tint: tuple[int, int, int]) -> Colors:
    if shown.cloud.colors is not None and are_colors_usable(shown.cloud.colors):
        return shown.cloud.colors
    shades = shaded_colors(tint, prepared.points, prepared.normals, viewpoint=prepared.viewpoint)
    return shades[shown.prepared_rows]


def _spread(features: Features, colors: Colors, count: int) -> Colors:
    """Colours of the described points among all points of a cloud."""
    all_colors = np.tile(np.asarray(NO_MATCH, dtype=np.uint8), (count, 1))
    all_colors[features.indices] = colors
    return all_colors


def _errors_of_points(
    count: int, table: MatchTable, measured: MatchErrors, partner: npt.NDArray[np.bool_], settings: ViewSettings,
    scale: float,
) -> Colors:  # fmt: skip
    errors = np.full(count, np.nan)
    rows = in_bar(kept_rows(table, settings), table, measured, settings)
    errors[table.correspondences.indices[rows, 0]] = measured.errors[rows]
    return error_colors(errors, scale=scale, palette=settings.palette, has_partner=partner)

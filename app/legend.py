"""What the colours in the picture mean, told by the functions that paint them."""

import math
from dataclasses import replace

import numpy as np

from app.analysis import Analysis, Scores
from app.coloring import error_scale, residual_scale, shown_coloring
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
from app.explorer import Findings, distance_range
from app.funnel import stage_text
from app.settings import ViewSettings
from app.snapshot import Legend, Swatch, Tick
from cgf.pipeline import REJECTIONS

LEGEND_STEPS = 256


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


def _facing(tint: tuple[int, int, int]) -> list[int]:
    """The tint as points have it that face the sensor."""
    up = np.array([[0.0, 0.0, 1.0]])
    color: list[int] = shaded_colors(tint, np.zeros((1, 3)), up, viewpoint=up[0])[0].tolist()
    return color


def hexed(color: tuple[int, int, int] | list[int]) -> str:
    """A colour as pages write it."""
    return "#{:02x}{:02x}{:02x}".format(*color)

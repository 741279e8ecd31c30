"""The suite's plots: precision over the threshold, over the dimension, and after changes."""

from collections.abc import Sequence

from cgf.descriptors.settings import ModelName
from cgf.evaluation.suite.perturbation import Change, perturbations
from cgf.evaluation.suite.plots import Panel, Series, figure
from cgf.evaluation.suite.scoring import THRESHOLDS
from cgf.evaluation.suite.sets import SetName
from cgf.evaluation.suite.summary import Summary
from cgf.evaluation.suite.tables import base_name, is_headline

_SETS: dict[SetName, str] = {"fgr": "FGR level 1", "happy": "Happy Buddha, raw scans", "rooms": "Rooms", "demo": "Demo"}
_NAMES = {"cgf": "CGF", "paper": "paper", "fpfh": "FPFH", "pca": "PCA"}
_SHADES = {
    "cgf": {8: "#9cc4e4", 16: "#5b9fd0", 32: "#2a78b5"},
    "paper": {8: "#f0c090", 16: "#e09a50", 32: "#c8701a"},
    "fpfh": {33: "#59626b"},
    "pca": {32: "#9aa1a8"},
}
_CHANGES: dict[Change, str] = {
    "noise": "noise, standard deviation in voxels",
    "density": "share of the source's points kept",
    "holes": "share of the source's points lost in holes",
    "radius": "support radius over the usual",
}


def threshold_plot(summaries: Sequence[Summary]) -> str:
    """A panel for each set: how precision grows with the error that still counts as right."""
    panels = []
    for key, name in _SETS.items():
        chosen = [summary for summary in summaries if summary.set == key and is_headline(summary)]
        series = []
        for summary in chosen:
            color = _SHADES.get(base_name(summary), {}).get(summary.dim)
            if color is not None:
                points = ((0.0, 0.0), *zip(THRESHOLDS[summary.model], summary.mean["curve"], strict=True))
                series.append(Series(_short(summary), color, _percent(points)))
        if series:
            panels.append(Panel(name, *_threshold_axis(chosen[0].model), tuple(series)))
    return figure(panels)


def dimension_plot(summaries: Sequence[Summary]) -> str:
    """A panel for each set: how precision grows with the number of values of a feature."""
    panels = []
    for key in ("fgr", "rooms"):
        found: dict[str, list[Summary]] = {}
        for summary in summaries:
            if summary.set == key and is_headline(summary):
                found.setdefault(base_name(summary), []).append(summary)
        series = []
        for name, chosen in found.items():
            chosen.sort(key=lambda summary: summary.dim)
            points = tuple((float(summary.dim), summary.mean["precision"]) for summary in chosen)
            color = list(_SHADES[name].values())[-1]
            series.append(Series(_NAMES[name], color, _percent(points)))
        if series:
            last = max(x for line in series for x, _ in line.points)
            ticks = tuple(
                (float(value), str(value)) for value in (0, 8, 16, 24, 32, 40, 48, 56, 64) if value < last + 8
            )
            panels.append(Panel(_SETS[key], "dimensions", ticks, tuple(series)))
    return figure(panels)


def robustness_plot(summaries: Sequence[Summary]) -> str:
    """A row of panels for each change, objects beside rooms."""
    places: dict[ModelName, str] = {"object": "Objects", "indoor": "Rooms"}
    panels = []
    for change, x_label in _CHANGES.items():
        steps = [step for step in perturbations() if step.change in (change, "none")]
        usual = {"noise": 0.0, "density": 1.0, "holes": 0.0, "radius": 1.0}[change]
        for model, place in places.items():
            series = []
            for summary in summaries:
                if summary.set != "robustness" or summary.model != model or summary.dim not in (32, 33):
                    continue
                points = sorted(
                    (
                        usual if step.change == "none" else step.amount,
                        summary.parts[f"{model}: {step.label}"]["precision"],
                    )
                    for step in steps
                    if f"{model}: {step.label}" in summary.parts
                )
                color = _SHADES[summary.row][summary.dim]
                series.append(Series(_short(summary), color, _percent(points)))
            values = sorted({x for line in series for x, _ in line.points})
            if len(values) > 1:
                ticks = tuple(
                    (value, f"{value:g}" if change in ("noise", "radius") else f"{100 * value:g} %") for value in values
                )
                panels.append(Panel(f"{place}: {change}", x_label, ticks, tuple(series)))
    return figure(panels)


def _threshold_axis(model: ModelName) -> tuple[str, tuple[tuple[float, str], ...]]:
    if model == "object":
        return "error in % of the diameter", tuple((value, f"{100 * value:g}") for value in (0.0, 0.01, 0.02, 0.03))
    return "error in cm", tuple((value, f"{100 * value:g}") for value in (0.0, 0.05, 0.1, 0.15, 0.2, 0.25))


def _short(summary: Summary) -> str:
    name = _NAMES[base_name(summary)]
    return name if summary.row == "fpfh" else f"{name}-{summary.dim}"


def _percent(points: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    return tuple((x, 100 * y) for x, y in points)

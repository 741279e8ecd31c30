"""Which remedies are worth a trial, and what the trials gave."""

import math
from dataclasses import dataclass
from typing import Any

from cgf.diagnosis.measures import Measures
from cgf.diagnosis.trials import Trial, attempt, usual_lengths
from cgf.pipeline import PairSettings, choose_model, correct
from cgf.types import IsCancelled, PointCloud

LARGER = 2.2
"""Ratio of the clouds' extents from which on their units are doubted; two fragments of one place rarely differ more."""
ABSURD = 50.0
"""Ratio that no two views of one place have."""
UNIT_RATIOS = (1000.0, 304.8, 100.0, 39.370079, 25.4, 12.0, 10.0, 3.2808399, 2.54)
"""Metre, centimetre, millimetre, foot and inch in terms of each other."""
NEAR_RATIO = 2.5
"""A ratio of units is tried where it explains the extents within this factor."""
SPACING_RATIO = 1.6
"""Of the prepared clouds; those of one data set differ by less than 1.1."""
OPPOSED = 0.12
"""Share of points whose neighbours' normals oppose theirs; real scans have 0.05 or less."""
TILTED_DEG = 25.0
"""Median angle between normals and surface; real scans have 12 degrees or less."""
SCALE_GAIN = 2.0
SCALE_SHIFT = 0.06
"""Of the logarithm; 3DMatch's own distortions reach 0.026."""

_TOGGLED = {
    "source": {"none": "source", "source": "none", "target": "both", "both": "target"},
    "target": {"none": "target", "target": "none", "source": "both", "both": "source"},
}


@dataclass(frozen=True)
class Remedy:
    """Changes of settings that may help, and with what they have to do."""

    kind: str
    changes: dict[str, Any]


def seek(measured: Measures, *, cancelled: IsCancelled | None = None) -> dict[str, Trial]:
    """Try what the measures suggest, until something helps; half a second each.

    Returns:
        Trials by the kind of the finding that they belong to; those that did not help, too.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    done: dict[str, Trial] = {}
    for remedy in suggestions(measured):
        trial = attempt(measured.case, remedy.changes, cancelled=cancelled)
        if trial is None:
            continue
        if remedy.kind not in done or trial.agreeing > done[remedy.kind].agreeing:
            done[remedy.kind] = trial
        if trial.is_better:
            if remedy.kind == "normals" and "flip_normals" in remedy.changes:
                done["normals"] = _better_side(measured, trial, cancelled)
            break
    return done


def _better_side(measured: Measures, trial: Trial, cancelled: IsCancelled | None) -> Trial:
    """Turning round the normals of the other cloud makes them agree, too, but only one way do they face the sensor."""
    changes = {"flip_normals": _TOGGLED["target"][measured.case.wanted.flip_normals]}
    other = attempt(measured.case, changes, cancelled=cancelled)
    return trial if other is None or other.share <= trial.share else other


def suggestions(measured: Measures) -> list[Remedy]:
    """What is worth a trial, likeliest first."""
    wanted, settings = measured.case.wanted, measured.case.settings
    loaded = measured.case.loaded_source, measured.case.loaded_target
    found = [Remedy("scale", changes) for changes in scale_changes(wanted, *loaded)]
    if measured.outcome == "registered" and measured.case.truth is None:
        # A wrong pose of clouds in two units may look right; what else registers needs no remedy.
        return found
    if measured.outcome == "registered":
        return []
    if measured.source.free_motions or measured.target.free_motions:
        # Matches agree on nothing there, whatever is changed.
        return found
    if abs(math.log(measured.scale)) > SCALE_SHIFT and measured.scale_gain >= SCALE_GAIN:
        found.append(Remedy("scale", {"source_scale": float(f"{wanted.source_scale * measured.scale:.4g}")}))
    if settings.choice.warning is not None and "millimetres" in settings.choice.warning:
        found.append(Remedy("unit", {"unit": "mm"}))
    if usual_lengths(wanted):
        found.append(Remedy("radius", usual_lengths(wanted)))
    if wanted.normals == "stored" and are_normals_doubtful(measured):
        found.append(Remedy("normals", {"normals": "estimated"}))
    ratio = spacing_ratio(measured)
    if max(ratio, 1 / ratio) > SPACING_RATIO:
        found.append(Remedy("density", {"voxel_size": max(measured.loaded_spacings)}))
    found.append(Remedy("normals", {"flip_normals": _TOGGLED["source"][wanted.flip_normals]}))
    return found


def flip_changes(measured: Measures) -> dict[str, Any]:
    """Turn round the normals of the cloud that faces its viewpoint less."""
    side = "source" if measured.source.facing <= measured.target.facing else "target"
    return {"flip_normals": _TOGGLED[side][measured.case.wanted.flip_normals]}


def are_normals_doubtful(measured: Measures) -> bool:
    """Whether the normals of either cloud contradict its surface, or one another."""
    return any(
        surface.opposed_share > OPPOSED or surface.tilt_deg > TILTED_DEG
        for surface in (measured.source, measured.target)
    )


def spacing_ratio(measured: Measures) -> float:
    """Spacing of the prepared source over that of the target."""
    return measured.source.spacing / measured.target.spacing if measured.target.spacing > 0 else 1.0


def extent_ratio(source: PointCloud, target: PointCloud) -> float:
    """Diameter of the target over that of the source."""
    return target.diameter / source.diameter


def scale_changes(wanted: PairSettings, source: PointCloud, target: PointCloud) -> list[dict[str, Any]]:
    """Settings that undo a difference in units which the extents of loaded clouds suggest, likeliest first."""
    ratio = extent_ratio(source, target)
    if max(ratio, 1 / ratio) < LARGER:
        return []
    factors = [factor for size in UNIT_RATIOS for factor in (size, 1 / size)]
    near = [factor for factor in factors if abs(math.log(factor / ratio)) < math.log(NEAR_RATIO)]
    near.sort(key=lambda factor: abs(math.log(factor / ratio)))
    return [_scaled(wanted, factor, source, target) for factor in near[:3]]


def _scaled(wanted: PairSettings, factor: float, source: PointCloud, target: PointCloud) -> dict[str, Any]:
    changes: dict[str, Any] = {"source_scale": float(f"{wanted.source_scale * factor:.6g}")}
    # Both clouds have the unit of the target then.
    source, target = correct(PairSettings(source_scale=factor), source, target)
    warning = choose_model(source, target, wanted.model, unit=wanted.unit).warning
    if warning is not None and "millimetres" in warning:
        changes["unit"] = "mm"
    return changes

"""What can be said where the clouds cannot even be described together."""

from dataclasses import replace
from typing import Any

from cgf.diagnosis.findings import Diagnosis, Evidence, Finding
from cgf.diagnosis.remedies import ABSURD, LARGER, extent_ratio, scale_changes
from cgf.diagnosis.rules.clouds import in_other_units
from cgf.diagnosis.rules.common import finding
from cgf.diagnosis.trials import CONVINCING, Sampled, try_settings
from cgf.pipeline import PairSettings
from cgf.types import IsCancelled, PointCloud


def diagnose_loaded(
    wanted: PairSettings,
    source: PointCloud,
    target: PointCloud,
    error: str,
    *,
    cancelled: IsCancelled | None = None,
) -> Diagnosis:
    """Diagnose a pair for which `cgf.run_pair` raised an `InputError`.

    Args:
        wanted: What was asked for.
        source: As loaded and corrected.
        target: As loaded and corrected.
        error: What the error says.
        cancelled: Asked between blocks of points whether to give up.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    found = _scale(wanted, source, target, cancelled)
    if found is None:
        found = finding("settings", "input", "problem", error, (), "", {}, 1.0)
    verdict = f"It fails at the input. {found.sentence} {found.remedy}".strip()
    return Diagnosis("failed", verdict, is_judged_by_truth=False, findings=(found,))


def _scale(
    wanted: PairSettings, source: PointCloud, target: PointCloud, cancelled: IsCancelled | None
) -> Finding | None:
    ratio = extent_ratio(source, target)
    larger = max(ratio, 1 / ratio)
    if larger < LARGER:
        return None
    extent = Evidence("Extent of one cloud over the other's", larger, "ratio", LARGER, "at most")
    best: tuple[Sampled, dict[str, Any]] | None = None
    for changes in scale_changes(wanted, source, target):
        tried = try_settings(
            replace(wanted, **changes), source, target, scaled_by=wanted.source_scale, cancelled=cancelled
        )
        if tried is not None and (best is None or tried.agreeing > best[0].agreeing):
            best = tried, changes
    if best is not None and best[0].agreeing >= CONVINCING:
        agreeing = Evidence(f"Of {best[0].asked} sampled matches, agree on one pose then", best[0].agreeing, "count")
        sentence = f"The clouds differ in scale: {in_other_units(wanted, best[1])}."
        return finding(
            "scale", "input", "problem", sentence, (extent, agreeing), "Scale the source by that.", best[1], 0.97
        )
    if larger < ABSURD:
        return None
    changes = next(iter(scale_changes(wanted, source, target)), {})
    sentence = f"One cloud is {larger:,.0f} times as large as the other."
    return finding("scale", "input", "problem", sentence, (extent,), "Bring both to the same unit.", changes, 0.9)

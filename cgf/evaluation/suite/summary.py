"""Means over pairs, and over scenes, of what was scored."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgf.descriptors.settings import MODEL_DEFAULTS, ModelName
from cgf.evaluation.metrics import feature_matching_recall
from cgf.evaluation.suite.running import GroupScores
from cgf.evaluation.suite.scoring import THRESHOLDS, PairScores
from cgf.evaluation.suite.sets import VALIDATION_PAIRS, SetName

Measures = dict[str, Any]
"""`pairs`, their number, and means over them, as shares, of what the set measures.

`precision`: within the model's radius, among points with a partner within tau. `curve`: within each of `THRESHOLDS`.
`near`: the same among points with a partner within each threshold. `inlier_ratio`; `recall_5` and `recall_20`: the
feature-matching recall above 5 and 20 %. `sure`: for each ranking the share of right matches among the surest.
"""
TEST_PAIRS = "test pairs"
"""The FGR pairs without those for validation."""


@dataclass(frozen=True)
class Summary:
    """One row in one width on one set."""

    set: SetName
    model: ModelName
    row: str
    label: str
    """Of the row in this width."""
    variant: str
    dim: int
    mean: Measures
    """Over all pairs; of scenes, the mean over them, in which each counts the same as in published tables."""
    parts: dict[str, Measures]
    """Of each scene; of the FGR set, of the test pairs."""
    describe_ms: float | None
    """Milliseconds of the processor to describe 1,000 points; None where another set's description was used."""


def summarise(results: Sequence[GroupScores]) -> list[Summary]:
    """A summary for each row, variant, width and set, in the order they first come."""
    found: dict[tuple[str, ...], list[GroupScores]] = {}
    for result in results:
        for dim in result["labels"]:
            found.setdefault((result["set"], result["model"], result["row"], result["variant"], dim), []).append(result)
    return [_summary(dim, chosen) for (*_, dim), chosen in found.items()]


def measures_of(scores: Sequence[PairScores], model: ModelName) -> Measures:
    """Means over pairs, of which there is at least one, measured in one way."""
    measures: Measures = {"pairs": len(scores)}
    if "curve" in scores[0]:
        measures["curve"] = _means([score["curve"] for score in scores])
        measures["near"] = _means([score["near"] for score in scores])
        place = THRESHOLDS[model].index(MODEL_DEFAULTS[model].precision_radius)
        measures["precision"] = measures["curve"][place]
        measures["sure"] = {by: _means([score["sure"][by] for score in scores]) for by in scores[0]["sure"]}
    if "inlier_ratio" in scores[0]:
        ratios = np.array([score["inlier_ratio"] for score in scores], dtype=np.float64)
        measures["inlier_ratio"] = float(np.nanmean(ratios))
        for percent in (5, 20):
            measures[f"recall_{percent}"] = feature_matching_recall(ratios, threshold=percent / 100)
    return measures


def _summary(dim: str, results: Sequence[GroupScores]) -> Summary:
    first = results[0]
    model: ModelName = first["model"]
    parts = {result["group"]: measures_of([pair["dims"][dim] for pair in result["pairs"]], model) for result in results}
    mean = _mean(list(parts.values()))
    if first["set"] == "fgr":
        tested = [pair["dims"][dim] for pair in first["pairs"] if pair["pair"] not in VALIDATION_PAIRS]
        parts = {TEST_PAIRS: measures_of(tested, model)} if tested else {}
    described = sum(result["described"] for result in results)
    return Summary(
        set=first["set"],
        model=model,
        row=first["row"],
        label=first["labels"][dim],
        variant=first["variant"],
        dim=int(dim),
        mean=mean,
        parts=parts,
        describe_ms=1e6 * sum(result["describe_s"] for result in results) / described if described else None,
    )


def _mean(parts: Sequence[Measures]) -> Measures:
    mean: Measures = {"pairs": sum(part["pairs"] for part in parts)}
    for key in parts[0]:
        values = [part[key] for part in parts]
        if key == "sure":
            mean[key] = {by: np.mean([value[by] for value in values], axis=0).tolist() for by in values[0]}
        elif key != "pairs":
            mean[key] = np.mean(values, axis=0).tolist()
    return mean


def _means(rows: Sequence[Sequence[float | None]]) -> list[float]:
    """Of each column, over the rows that have a number there; nan where none has."""
    values = np.array(rows, dtype=np.float64)
    counted = np.isfinite(values)
    sums, counts = np.where(counted, values, 0.0).sum(axis=0), counted.sum(axis=0)
    return np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0).tolist()

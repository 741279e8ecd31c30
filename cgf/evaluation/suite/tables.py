"""Tables of what the suite found, in Markdown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from cgf.descriptors.settings import ModelName
from cgf.evaluation.suite.perturbation import perturbations
from cgf.evaluation.suite.rows import COMPARED_DIMS
from cgf.evaluation.suite.scoring import COVERAGES, THRESHOLDS
from cgf.evaluation.suite.sets import SetName
from cgf.evaluation.suite.summary import TEST_PAIRS, Summary

Titles = Mapping[str, str]
"""What tables call rows, by their names, without the dimension."""
Value = Callable[[Summary], float | None]
HEADLINE_ROWS = ("cgf", "paper", "fpfh", "pca")
"""In the README and the plots, without the dimension at the end of the name; documents have all rows."""
_LAST = {"fpfh": 1, "pca": 2}
_RANKED = {"distance": "feature distance", "ratio": "ratio", "quality": "quality", "combined": "distance and quality"}


@dataclass(frozen=True)
class Column:
    """A figure of a set."""

    title: str
    set: SetName
    value: Value
    """The share; None where it was not measured."""


def base_name(summary: Summary) -> str:
    """The row's name without the dimension."""
    return summary.row.removesuffix(f"-{summary.dim}")


def is_headline(summary: Summary) -> bool:
    """Whether the README shows the row."""
    return base_name(summary) in HEADLINE_ROWS


def title(summary: Summary, titles: Titles) -> str:
    """What tables call the row in its width."""
    return f"{titles.get(summary.row) or base_name(summary)}, {summary.dim} dimensions"


def within(threshold: float, *, near: bool = False) -> Value:
    """The precision within one of `THRESHOLDS`."""

    def value(summary: Summary) -> float | None:
        curve = summary.mean.get("near" if near else "curve")
        return None if curve is None else curve[THRESHOLDS[summary.model].index(threshold)]

    return value


def overall(measure: str) -> Value:
    """A measure over the whole set."""
    return lambda summary: summary.mean.get(measure)


def of_part(name: str, measure: str) -> Value:
    """A measure of one scene or other part."""
    return lambda summary: summary.parts.get(name, {}).get(measure)


def headline_columns() -> list[Column]:
    """One or two figures of each set."""
    return [
        Column("FGR level 1, within 1 % of the diameter", "fgr", overall("precision")),
        Column("Happy Buddha, raw scans, within 1 %", "happy", overall("precision")),
        Column("demo, within 7.5 cm", "demo", within(0.075, near=True)),
        Column("rooms, within 10 cm", "rooms", overall("precision")),
        Column("rooms, recall at 5 %", "rooms", overall("recall_5")),
        Column("rooms, recall at 20 %", "rooms", overall("recall_20")),
        Column("little overlap, recall at 5 %", "lomatch", overall("recall_5")),
    ]


def object_columns() -> list[Column]:
    """Precision within three thresholds on the sets of objects."""
    sets: tuple[tuple[str, SetName], ...] = (("FGR", "fgr"), ("Happy Buddha", "happy"))
    columns = [
        Column(f"{name}, within {100 * limit:g} %", key, within(limit))
        for name, key in sets
        for limit in (0.005, 0.01, 0.02)
    ]
    return [
        *columns[:3],
        Column("FGR, 20 test pairs, within 1 %", "fgr", of_part(TEST_PAIRS, "precision")),
        *columns[3:],
    ]


def scene_columns(scene: str, key: SetName) -> list[Column]:
    """What is measured of a scene."""
    columns = [
        Column("inlier ratio", key, of_part(scene, "inlier_ratio")),
        Column("recall at 5 %", key, of_part(scene, "recall_5")),
        Column("recall at 20 %", key, of_part(scene, "recall_20")),
    ]
    precision = [Column("precision within 10 cm", key, of_part(scene, "precision"))] if key == "rooms" else []
    return [*precision, *columns]


def demo_columns() -> list[Column]:
    """Precision within three thresholds, each among points with a partner that near."""
    return [Column(f"within {100 * limit:g} cm", "demo", within(limit, near=True)) for limit in (0.05, 0.075, 0.1)]


def comparison(summaries: Sequence[Summary], columns: Sequence[Column], titles: Titles) -> list[str]:
    """A line for each row and width; of each column the best is bold."""
    shown = [s for s in summaries if s.dim in COMPARED_DIMS or s.row == s.label]
    found = {(summary.set, summary.label): summary for summary in shown}
    columns = [column for column in columns if any(column.set == key for key, _ in found)]
    first = {summary.label: summary for summary in reversed(shown)}
    order = list(dict.fromkeys(base_name(summary) for summary in shown))
    labels = sorted(
        first,
        key=lambda label: (_LAST.get(first[label].row, 0), order.index(base_name(first[label])), -first[label].dim),
    )
    lines = []
    for label in labels:
        values = [
            column.value(found[column.set, label]) if (column.set, label) in found else None for column in columns
        ]
        if any(value is not None for value in values):
            lines.append((title(first[label], titles), values))
    return _table([column.title for column in columns], lines)


def radii(summaries: Sequence[Summary]) -> list[str]:
    """The precision of FPFH with every radius, on the validation pairs."""
    places: dict[ModelName, str] = {"object": "FGR, 5 validation pairs", "indoor": "mit_lab_hj, 15 pairs"}
    lines: list[tuple[str, list[float | None]]] = [
        (f"{places[summary.model]}, radius {summary.variant}", [summary.mean["precision"]])
        for summary in summaries
        if summary.set == "radii"
    ]
    return _table(["precision"], lines, bold=False)


def surest(summaries: Sequence[Summary], titles: Titles, sets: Mapping[SetName, str]) -> list[str]:
    """The share of right matches among the surest, by what they are ranked by."""
    lines = []
    for summary in summaries:
        if summary.set in sets and summary.dim in (32, 33) and is_headline(summary):
            for by, shares in summary.mean.get("sure", {}).items():
                lines.append((f"{sets[summary.set]}: {title(summary, titles)}, by {_RANKED[by]}", shares))
    return _table([f"surest {100 * share:g} %" for share in COVERAGES], lines, bold=False)


def robustness(summaries: Sequence[Summary], titles: Titles) -> list[str]:
    """Precision after each change, for both models side by side."""
    chosen = [summary for summary in summaries if summary.set == "robustness" and summary.dim in (32, 33)]
    places: dict[ModelName, str] = {"object": "objects", "indoor": "rooms"}
    lines = [
        (
            change.label,
            [summary.parts.get(f"{summary.model}: {change.label}", {}).get("precision") for summary in chosen],
        )
        for change in perturbations()
    ]
    return _table([f"{places[summary.model]}: {title(summary, titles)}" for summary in chosen], lines, bold=False)


def times(summaries: Sequence[Summary], titles: Titles) -> list[str]:
    """Milliseconds of the processor to describe 1,000 points."""
    sets: dict[SetName, str] = {"fgr": "objects", "rooms": "rooms"}
    lines = [f"| | {' | '.join(sets.values())} |", f"|---|{'--:|' * len(sets)}"]
    widest: dict[tuple[str, str], dict[str, Summary]] = {}
    for summary in summaries:
        if summary.set in sets and summary.describe_ms is not None:
            widest.setdefault((summary.row, summary.variant), {})[summary.set] = summary
    for (_, variant), by_set in widest.items():
        some = next(iter(by_set.values()))
        name = f"{titles.get(some.row) or some.row} {variant and f'({variant})'}".strip()
        cells = [f"{by_set[key].describe_ms:.0f}" if key in by_set else "" for key in sets]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def cross_validation(summaries: Sequence[Summary]) -> list[str]:
    """Of every scene, the recall of the weights that were not trained on it, and the mean over scenes."""
    chosen = [summary for summary in summaries if summary.set == "cross"]
    dims = sorted({summary.dim for summary in chosen}, reverse=True)
    scenes = sorted({scene for summary in chosen for scene in summary.parts})
    measures = ("recall_5", "recall_20", "inlier_ratio")
    lines: list[tuple[str, list[float | None]]] = []
    for scene in scenes:
        values: list[float | None] = []
        for dim in dims:
            of = next((summary for summary in chosen if summary.dim == dim and scene in summary.parts), None)
            values += [of.parts[scene][measure] if of else None for measure in measures]
        pairs = next(summary.parts[scene]["pairs"] for summary in chosen if scene in summary.parts)
        trained = next(base_name(summary) for summary in chosen if scene in summary.parts)
        lines.append((f"{scene} ({pairs} pair{'s' * (pairs > 1)}, {trained})", values))
    if lines:
        columns = zip(*(values for _, values in lines), strict=True)
        lines.append((f"mean over {len(scenes)} scenes", [_mean(column) for column in columns]))
    heads = [f"{text}, {dim} dimensions" for dim in dims for text in ("recall at 5 %", "at 20 %", "inlier ratio")]
    return _table(heads, lines, bold=False)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _table(
    heads: Sequence[str], lines: Sequence[tuple[str, Sequence[float | None]]], *, bold: bool = True
) -> list[str]:
    """Shares in percent; where `bold`, the highest of each column stands out."""
    tops = [
        max((value for value in column if value is not None), default=None)
        for column in zip(*(v for _, v in lines), strict=True)
    ]
    text = [f"| | {' | '.join(heads)} |", f"|---|{'--:|' * len(heads)}"]
    for name, values in lines if heads else ():
        cells = [_cell(value, bold and value == top) for value, top in zip(values, tops, strict=True)]
        text.append(f"| {name} | {' | '.join(cells)} |")
    return text


def _cell(value: float | None, bold: bool) -> str:
    if value is None:
        return ""
    text = f"{100 * value:.1f}"
    return f"**{text}**" if bold else text

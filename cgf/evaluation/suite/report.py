"""Puts what the suite found into documents and onto the weights' cards."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from cgf.checks import InputError
from cgf.descriptors.network import NetworkCard
from cgf.evaluation.matches import write_text
from cgf.evaluation.suite import curves, tables
from cgf.evaluation.suite.rows import COMPARED_DIMS, Row
from cgf.evaluation.suite.running import GroupScores
from cgf.evaluation.suite.sets import TEST_SCENES, SetName
from cgf.evaluation.suite.summary import Summary

COMMAND = "cgf evaluate --suite paper --update"
DOCUMENT = Path("docs/results.md")
README = Path("README.md")
_PLOTS = {
    "results-precision.svg": curves.threshold_plot,
    "results-dimensions.svg": curves.dimension_plot,
    "results-robustness.svg": curves.robustness_plot,
}
_END = "<!-- until here -->"


def as_json(summaries: Sequence[Summary], results: Sequence[GroupScores]) -> str:
    """Means and the scores of every pair."""
    return json.dumps({"summaries": [asdict(summary) for summary in summaries], "results": results}, indent=1) + "\n"


def update_documents(
    root: Path, summaries: Sequence[Summary], rows: Sequence[Row], *, limit: int | None = None
) -> list[Path]:
    """Write the tables into the README and `docs/results.md` of a checkout, the plots beside it, scores onto cards.

    Args:
        root: Of the checkout.
        summaries: Of all sets, or of those that the documents shall show.
        rows: That they are of.
        limit: Most pairs that were measured of each set and scene, which the documents then say; None for all.

    Returns:
        The files written.

    Raises:
        InputError: A document is missing, or has no place for the table.
    """
    titles = {row.name: row.title for row in rows}
    remark = "" if limit is None else f"At most {limit} pairs of each set and scene, evenly spread.\n\n"
    replace_marked(root / README, remark + "\n".join(readme_table(summaries, titles)), command=COMMAND)
    replace_marked(root / DOCUMENT, remark + document(summaries, titles), command=COMMAND)
    written = [root / README, root / DOCUMENT]
    for name, draw in _PLOTS.items():
        write_text(root / "docs" / name, draw(summaries))
        written.append(root / "docs" / name)
    for row in rows:
        scores = card_scores(row, summaries)
        if row.weights is not None and scores:
            path = row.weights.with_suffix(".json")
            card = NetworkCard.from_json(path.read_text("utf-8"), source=str(path))
            write_text(path, replace(card, scores=scores).to_json())
            written.append(path)
    return written


def replace_marked(path: Path, content: str, *, command: str) -> None:
    """Put `content` between the two comments of a document that say which command makes it.

    Raises:
        InputError: The document is missing, or has no such comments.
    """
    begin = f"<!-- made by: {command} -->\n"
    try:
        text = path.read_text("utf-8")
    except OSError as error:
        raise InputError(f"{path} must be a document to be updated, got: {error.strerror or error}") from error
    before, found, rest = text.partition(begin)
    _, found_end, after = rest.partition(_END)
    if not found or not found_end:
        raise InputError(f"{path} must have the lines {begin.strip()} and {_END}, got no such lines")
    write_text(path, f"{before}{begin}\n{content.strip()}\n\n{_END}{after}")


def readme_table(summaries: Sequence[Summary], titles: tables.Titles) -> list[str]:
    """One or two figures of each set, for the rows that everybody asks for."""
    chosen = [summary for summary in summaries if tables.is_headline(summary)]
    return tables.comparison(chosen, tables.headline_columns(), titles)


def document(summaries: Sequence[Summary], titles: tables.Titles) -> str:
    """All tables, with the plots."""
    sections = [("All sets", tables.comparison(summaries, tables.headline_columns(), titles))]
    sections += [("Objects", tables.comparison(summaries, tables.object_columns(), titles))]
    sections += [("Demo", tables.comparison(summaries, tables.demo_columns(), titles))]
    of_scenes: dict[SetName, str] = {"rooms": "Rooms", "lomatch": "Little overlap"}
    for key, name in of_scenes.items():
        for scene in TEST_SCENES:
            lines = tables.comparison(summaries, tables.scene_columns(scene, key), titles)
            pairs = next((s.parts[scene]["pairs"] for s in summaries if s.set == key and scene in s.parts), 0)
            sections += [(f"{name}: {scene}, {pairs} pairs", lines)]
    sections += [
        ("FPFH's radii", tables.radii(summaries)),
        ("Surest matches", tables.surest(summaries, titles, {"fgr": "FGR", "happy": "Happy Buddha", "rooms": "rooms"})),
        ("Robustness", tables.robustness(summaries, titles)),
        ("Cross-validation", tables.cross_validation(summaries)),
        ("Time", tables.times(summaries, titles)),
    ]
    return "\n".join(f"### {name}\n\n" + "\n".join(lines) + "\n" for name, lines in sections if len(lines) > 2)


def card_scores(row: Row, summaries: Sequence[Summary]) -> dict[str, float]:
    """The figures of the tables that a row has, in percent, by what they are."""
    scores: dict[str, float] = {}
    for summary in summaries:
        if (summary.row, summary.model) != (row.name, row.model) or summary.dim not in {*COMPARED_DIMS, row.dims[-1]}:
            continue
        for column in tables.headline_columns():
            value = column.value(summary) if column.set == summary.set else None
            if value is not None:
                scores[f"{column.title}, {summary.dim} dimensions"] = round(100 * value, 1)
        for scene, part in summary.parts.items() if summary.set == "cross" else ():
            scores[f"{scene}, recall at 5 %, {summary.dim} dimensions"] = round(100 * part["recall_5"], 1)
    return scores

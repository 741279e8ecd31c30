"""Which matches are drawn as lines, and in which colours."""

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Scores, kept_rows
from app.coloring import error_scale, in_bar, shown_coloring
from app.colors import UNJUDGED, Colors, error_colors, quality_colors, stage_colors
from app.explorer import Findings
from app.settings import ViewSettings


def lines(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[npt.NDArray[np.int64], Colors]:
    """The matches to draw: their two rows, and their colours."""
    nothing = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.uint8)
    if analysis.matches is None or scores is None:
        return nothing
    coloring = shown_coloring(analysis, scores, settings, findings)
    # A heat map shows one point only, and so does what is isolated; between surfaces that are compared by their
    # distance, lines would only hide them.
    if coloring in ("distance", "residual") or (settings.isolate and findings.picked is not None):
        return nothing
    indices = analysis.matches.correspondences.indices
    by_stage = coloring == "stage"
    # Where the colours say which stage rejects a match, the rejected ones are drawn too.
    rows = np.arange(len(indices)) if by_stage else kept_rows(analysis.matches, settings)
    rows = in_bar(rows, analysis.matches, scores.forward, settings)
    if settings.selected is not None:
        column = 0 if settings.selected.side == "source" else 1
        rows = rows[np.isin(indices[rows, column], settings.selected.indices)]
    is_judged = scores.reference is not None
    chosen = choose_lines(
        rows,
        # Without a pose nothing is known but how alike the features are.
        scores.forward.errors if is_judged else analysis.matches.correspondences.distances,
        scores.forward.has_partner if is_judged and not by_stage else np.ones(len(indices), dtype=bool),
        settings,
    )
    if by_stage:
        assert findings.stages is not None
        return indices[chosen], stage_colors(findings.stages.source[indices[chosen, 0]])
    quality = analysis.matches.quality
    if coloring == "quality" and quality is not None:
        return indices[chosen], quality_colors(quality[chosen])
    scale = error_scale(analysis, settings)
    colors = error_colors(
        scores.forward.errors[chosen], scale=scale, palette=settings.palette,
        has_partner=scores.forward.has_partner[chosen],
    )  # fmt: skip
    if not is_judged:
        colors = np.tile(np.asarray(UNJUDGED, dtype=np.uint8), (len(chosen), 1))
    return indices[chosen], colors


def choose_lines(
    rows: npt.NDArray[np.int64],
    badness: npt.NDArray[np.floating],
    has_partner: npt.NDArray[np.bool_],
    settings: ViewSettings,
) -> npt.NDArray[np.int64]:
    """Pick `settings.line_count` of `rows`.

    Args:
        rows: Of the table of matches, those that passed the filters.
        badness: Of every match of the table: its error.
        has_partner: Whether a match of the table could be right; the others are drawn only at random.
        settings: How many, and which.

    Returns:
        Rows of the table; the same ones for the same arguments.
    """
    count = settings.line_count
    if settings.line_choice == "random":
        order = np.random.default_rng(0).permutation(len(rows))
        return np.sort(rows[order[:count]])
    rows = rows[has_partner[rows]]
    rows = rows[np.argsort(badness[rows], kind="stable")]
    if settings.line_choice == "best":
        return rows[:count]
    if settings.line_choice == "worst":
        return rows[max(len(rows) - count, 0) :]
    # Evenly by error, so that a hundred lines show the shares that all matches have.
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(np.int64))]

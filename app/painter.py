"""Makes the pictures of one session, and keeps what stays the same from one to the next."""

from functools import lru_cache

from app.analysis import Analysis, Scores, score
from app.columns import draw_columns
from app.diagnosing import Diagnosing
from app.explorer import NO_FINDINGS, Explorer, Findings
from app.picture import Picture, draw
from app.placing import Placed, place
from app.settings import ViewSettings
from app.workbench import Workbench


class Painter:
    """For one thread at a time."""

    def __init__(self, workbench: Workbench, diagnosing: Diagnosing) -> None:
        """Nothing is drawn yet.

        Args:
            workbench: Gives what is compared.
            diagnosing: Gives what is to be pointed at.
        """
        self._workbench = workbench
        self._diagnosing = diagnosing
        self._placed: tuple[Analysis, Placed] | None = None
        self._score = lru_cache(maxsize=2)(score)
        self._explorer = Explorer()

    def scores(self, analysis: Analysis | None, settings: ViewSettings) -> Scores | None:
        """How right the matches are; None before there are any."""
        return None if analysis is None else self._score(analysis, settings.reference)

    def findings(self, analysis: Analysis | None, settings: ViewSettings) -> Findings:
        """What is known of stages and of the picked point."""
        if analysis is None:
            return NO_FINDINGS
        return self._explorer.look(analysis, self.scores(analysis, settings), settings)

    def paint(self, analysis: Analysis, settings: ViewSettings) -> Picture:
        """Draw the last good result."""
        placed = self._place(analysis)
        picture = draw(
            analysis, self.scores(analysis, settings), settings, placed, self.findings(analysis, settings)
        )  # fmt: skip
        if settings.highlight:
            picture = self._diagnosing.highlight(picture, analysis, settings)
        return self._with_columns(picture, analysis, settings, placed)

    def paint_preview(self, preview: Analysis, last: Analysis | None, settings: ViewSettings) -> Picture:
        """Draw a preview; what is known of points belongs to the `last` good result, and most have no stage yet."""
        placed = self._place(preview)
        same = last is not None and last.source is preview.source
        findings = Findings(picked=self.findings(last, settings).picked if same else None)
        picture = draw(preview, self.scores(preview, settings), settings, placed, findings)
        return self._with_columns(picture, preview, settings, placed)

    def paint_otherwise(self, analysis: Analysis, settings: ViewSettings, wanted: ViewSettings) -> Picture:
        """Draw the last good result as `wanted`, with what is known under `settings`; nothing is kept of it."""
        placed = self._placed
        # A preview may be drawn at the moment, whose points are others.
        fits = placed is not None and placed[0].source is analysis.source and placed[0].target is analysis.target
        return draw(
            analysis, self.scores(analysis, settings), wanted,
            placed[1] if placed is not None and fits else place(analysis), self.findings(analysis, settings),
        )  # fmt: skip

    def _place(self, analysis: Analysis) -> Placed:
        placed = self._placed
        if placed is None or placed[0].source is not analysis.source or placed[0].target is not analysis.target:
            self._placed = placed = (analysis, place(analysis, None if placed is None else placed[1]))
        return placed[1]

    def _with_columns(self, picture: Picture, analysis: Analysis, settings: ViewSettings, placed: Placed) -> Picture:
        if not settings.columns:
            return picture
        return draw_columns(picture, self._workbench.columns(analysis, settings), settings, placed)

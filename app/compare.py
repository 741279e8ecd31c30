"""Two or three descriptors or settings beside each other, each coloured by its own errors, on one scale."""

from dataclasses import dataclass, replace

from app.analysis import Analysis, Analyst, Scores, kept_rows, score
from app.jobs import Job
from app.plots import right_within
from app.settings import Column, ViewSettings
from cgf import pipeline
from cgf.evaluation import metrics


@dataclass(frozen=True)
class ColumnInfo:
    """What is known of one column."""

    label: str
    """Descriptor, dimensions and radius."""
    precision: float | None
    """None while it is not computed, or where no pose is known."""
    is_ready: bool
    problem: str | None
    """Why it cannot be computed, in a line."""


@dataclass(frozen=True, eq=False)
class ComparedColumn:
    """One column, as far as it has come."""

    info: ColumnInfo
    analysis: Analysis | None
    scores: Scores | None


class Comparison:
    """The columns of an analysis; what was scored once is kept until the analysis changes."""

    def __init__(self, analyst: Analyst) -> None:
        self._analyst = analyst
        self._scored: dict[tuple[object, ...], tuple[Analysis, Scores | None]] = {}
        self._of: Analysis | None = None
        self._problems: dict[tuple[object, ...], str] = {}

    def columns(self, analysis: Analysis, settings: ViewSettings) -> tuple[ComparedColumn, ...]:
        """Every column that `settings` ask for."""
        if analysis is not self._of:
            self._scored, self._of = {}, analysis
        return tuple(self._column(analysis, settings, column) for column in settings.columns)

    def run(self, analysis: Analysis, settings: ViewSettings, job: Job) -> bool:
        """Compute the next column that is not known yet; tells whether there was one.

        Raises:
            Cancelled: The job is no longer wanted.
        """
        for number, column in enumerate(settings.columns):
            wanted = column_settings(analysis, settings, column)
            if wanted.work_key in self._problems or self._known(analysis, wanted) is not None:
                continue
            count = len(settings.columns)
            part = job.part(number / count, (number + 1) / count, f"Column {number + 1} of {count}")
            try:
                self._analyst.run(wanted, part, lambda _: None)
                assert self._known(analysis, wanted) is not None
            except ValueError as error:
                self._problems[wanted.work_key] = str(error)
            return True
        return False

    def _column(self, analysis: Analysis, settings: ViewSettings, column: Column) -> ComparedColumn:
        wanted = column_settings(analysis, settings, column)
        label = _label(analysis, column)
        found = self._known(analysis, wanted)
        if found is None:
            problem = self._problems.get(wanted.work_key)
            return ComparedColumn(ColumnInfo(label, None, is_ready=False, problem=problem), None, None)
        key = (wanted.work_key, settings.reference)
        if key not in self._scored:
            self._scored[key] = (found, score(found, settings.reference))
        own, scores = self._scored[key]
        precision = None
        if scores is not None and scores.reference is not None and own.matches is not None:
            rows = kept_rows(own.matches, settings)
            rows = rows[scores.forward.has_partner[rows]]
            if len(rows):
                precision = metrics.precision(scores.forward.errors[rows], threshold=right_within(analysis, settings))
        return ComparedColumn(ColumnInfo(label, precision, is_ready=True, problem=None), own, scores)

    def _known(self, analysis: Analysis, wanted: ViewSettings) -> Analysis | None:
        """The analysis with the matches of a column in place of its own."""
        try:
            resolved = pipeline.resolve(wanted.pair_settings(), analysis.pair.source, analysis.pair.target)
        except ValueError as error:
            self._problems[wanted.work_key] = str(error)
            return None
        if resolved.preparation_key != analysis.resolved.preparation_key:
            self._problems[wanted.work_key] = "It needs other points than those shown, so it cannot stand beside them."
            return None
        found = self._analyst.known_matches(analysis.index, resolved)
        if found is None:
            return None
        return replace(analysis, resolved=resolved, matches=found[0], back_matches=found[1])


def column_settings(analysis: Analysis, settings: ViewSettings, column: Column) -> ViewSettings:
    """The settings of a column: its own descriptor, dimensions and radius, all else as in the page."""
    return replace(
        settings,
        descriptor=column.descriptor,
        dim=column.dim,
        support_radius=column.support_radius,
        min_radius=settings.min_radius if column.support_radius == settings.support_radius else None,
        # The same points for all, also where a descriptor would choose others by itself.
        voxel_size=analysis.resolved.voxel_size,
    )


def _label(analysis: Analysis, column: Column) -> str:
    name = column.descriptor.upper() if column.dim is None else f"{column.descriptor.upper()}-{column.dim}"
    if column.support_radius is None:
        return name
    resolved = analysis.resolved
    if resolved.model == "indoor":
        return f"{name}, radius {column.support_radius * resolved.unit_m:.3g} m"
    return f"{name}, radius {100 * column.support_radius / resolved.diameter:.3g} %"

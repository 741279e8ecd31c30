"""What is known beside errors: the stage that rejects each point, and the picked point in detail."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Scores, kept_rows
from app.settings import Picked, ViewSettings
from cgf.checks import InputError
from cgf.evaluation.metrics import correspondence_errors
from cgf.matching import MatchTable
from cgf.pipeline import PairResult, PointInspection, Side, inspect_point, rejections

RUNNERS_UP = 7
"""Listed and drawn beside the match."""

Codes = npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Stages:
    """The stage that rejects each prepared point, as indices into `cgf.pipeline.REJECTIONS`."""

    source: Codes
    target: Codes
    judged: bool
    """Whether there is an estimate, whose outliers are rejected."""


@dataclass(frozen=True, eq=False)
class Findings:
    """What pictures and figures are made from, beside the scores."""

    stages: Stages | None = None
    """None before there are matches."""
    picked: PointInspection | None = None
    """None where nothing is picked, or before there are matches."""


NO_FINDINGS = Findings()


def distance_range(picked: PointInspection | None) -> tuple[float, float] | None:
    """Ends of the scale of feature distances to the other cloud; None where there are none to show."""
    if picked is None:
        return None
    known = picked.distances[picked.distances > 0]
    if not len(known):
        return None
    low, high = float(known.min()), float(known.max())
    return low, max(high, 1.01 * low)


class Explorer:
    """Finds things out once as long as what they depend on stays. For one thread at a time."""

    def __init__(self) -> None:
        self._stages: tuple[tuple[object, ...], Stages | None] | None = None
        self._picked: tuple[tuple[object, ...], PointInspection | None] | None = None

    def look(self, analysis: Analysis, scores: Scores | None, settings: ViewSettings) -> Findings:
        """Everything for the settings of this moment."""
        if scores is None:
            return NO_FINDINGS
        # The scores stay the same as long as the matches and the pose that judges them do.
        stages_key = (scores, analysis.estimate, settings.mutual, settings.max_ratio, settings.surest)
        if self._stages is None or not _same(self._stages[0], stages_key):
            self._stages = (stages_key, find_stages(analysis, scores, settings))
        picked_key = (scores, settings.picked)
        if self._picked is None or not _same(self._picked[0], picked_key):
            self._picked = (picked_key, _inspect(analysis, scores, settings.picked))
        return Findings(self._stages[1], self._picked[1])


def _same(first: tuple[object, ...], second: tuple[object, ...]) -> bool:
    """Whether two keys hold the same objects, or equal ones that are no arrays."""
    return all(
        a is b or not (isinstance(a, np.ndarray) or isinstance(b, np.ndarray) or a != b)
        for a, b in zip(first, second, strict=True)
    )


def find_stages(analysis: Analysis, scores: Scores, settings: ViewSettings) -> Stages | None:
    """The stage that rejects each point of both clouds, with the filters chosen; None before there are matches."""
    source_features, target_features = analysis.source_features, analysis.target_features
    matches, back_matches = analysis.matches, analysis.back_matches
    if source_features is None or target_features is None or matches is None or back_matches is None:
        return None
    estimate = analysis.estimate
    is_known = scores.reference is not None

    def agreeing(table: MatchTable, *, back: bool) -> npt.NDArray[np.bool_] | None:
        if estimate is None:
            return None
        indices = table.correspondences.indices
        indices = indices[:, ::-1] if back else indices
        errors = correspondence_errors(analysis.source.points, analysis.target.points, indices, estimate)
        return errors <= analysis.resolved.inlier_distance

    return Stages(
        source=rejections(
            analysis.source, source_features, matches, analysis.resolved,
            has_partner=scores.source_partner if is_known else None, is_inlier=agreeing(matches, back=False),
            mutual=settings.mutual, max_ratio=settings.max_ratio, surest=settings.surest,
        ),
        target=rejections(
            analysis.target, target_features, back_matches, analysis.resolved,
            has_partner=scores.target_partner if is_known else None, is_inlier=agreeing(back_matches, back=True),
            mutual=settings.mutual, max_ratio=settings.max_ratio, surest=settings.surest,
        ),
        judged=estimate is not None,
    )  # fmt: skip


def check_rows(analysis: Analysis, settings: ViewSettings) -> None:
    """Refuse points that the prepared clouds do not have.

    Raises:
        InputError: The picked or a selected point does not exist.
    """
    wanted: list[tuple[str, Side, tuple[int, ...]]] = []
    if settings.picked is not None:
        wanted.append(("picked", settings.picked.side, (settings.picked.index,)))
    if settings.selected is not None:
        wanted.append(("selected", settings.selected.side, settings.selected.indices))
    for name, side, rows in wanted:
        count = _size(analysis, side)
        for row in rows:
            if not 0 <= row < count:
                raise InputError(f"{name} must be a row of the {side} from 0 to {count - 1}, got {row}")


def _size(analysis: Analysis, side: Side) -> int:
    return len(analysis.source if side == "source" else analysis.target)


def _inspect(analysis: Analysis, scores: Scores, picked: Picked | None) -> PointInspection | None:
    source_features, target_features, matches = analysis.source_features, analysis.target_features, analysis.matches
    if picked is None or source_features is None or target_features is None or matches is None:
        return None
    if not 0 <= picked.index < _size(analysis, picked.side):
        return None
    result = PairResult(
        settings=analysis.resolved,
        source=analysis.source,
        target=analysis.target,
        source_features=source_features,
        target_features=target_features,
        table=matches,
        rows=np.zeros(0, dtype=np.int64),
        registration=None,
        warnings=(),
    )
    reference = analysis.reference(scores.reference)
    pose = None if reference is None else reference[1]
    return inspect_point(result, picked.index, side=picked.side, target_from_source=pose, count=RUNNERS_UP + 1)


def step_order(analysis: Analysis, scores: Scores, settings: ViewSettings) -> npt.NDArray[np.int64]:
    """Rows of the matches that pass the filters, in the order in which to go through them.

    Worst and best are among those that could be right; where no pose is known, by feature distance.
    """
    assert analysis.matches is not None
    rows = kept_rows(analysis.matches, settings)
    order = settings.step_order
    if order == "random":
        return rows[np.random.default_rng(0).permutation(len(rows))]
    badness = analysis.matches.correspondences.distances
    if scores.reference is not None:
        rows = rows[scores.forward.has_partner[rows]]
        badness = scores.forward.errors
    ascending = rows[np.argsort(badness[rows], kind="stable")]
    return ascending if order == "best" else ascending[::-1]


def stepped(analysis: Analysis, scores: Scores, settings: ViewSettings, *, by: int) -> Picked | None:
    """The source point of the match `by` places from the picked one, around the ends; None where there is no match."""
    assert analysis.matches is not None
    rows = step_order(analysis, scores, settings)
    if not len(rows):
        return None
    points = analysis.matches.correspondences.indices[rows, 0]
    place = step_place(points, settings.picked)
    place = (0 if by > 0 else -1) if place is None else place + by
    return Picked("source", int(points[place % len(points)]))


def step_place(points: npt.NDArray[np.int64], picked: Picked | None) -> int | None:
    """Where the picked point comes among the source rows `points`, if it does."""
    if picked is None or picked.side != "source":
        return None
    found = np.flatnonzero(points == picked.index)
    return int(found[0]) if len(found) else None

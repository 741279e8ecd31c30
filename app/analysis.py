"""The stages of one pair, each kept until a setting that it depends on changes."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from app.jobs import Job
from app.settings import Reference, ViewSettings
from app.shown import Shown, choose_shown
from cgf import pipeline
from cgf.evaluation.matches import MatchErrors, match_errors
from cgf.evaluation.metrics import has_partner
from cgf.geometry import transforms
from cgf.matching import MatchTable, filter_rows
from cgf.pipeline import PairSettings, ResolvedSettings
from cgf.types import Features, Pair, PointCloud, RegistrationResult, Transform

Value = TypeVar("Value")
Mask = npt.NDArray[np.bool_]

_KEPT = {"load": 3, "correct": 3, "prepare": 6, "show": 6, "describe": 8, "match": 24, "register": 64}
"""How many results of each stage are kept; features are the largest, 33 MB for 65,000 points in 128 dimensions."""


class StageCache:
    """Results of stages by what they depend on; the longest unused one goes first. For one thread at a time."""

    def __init__(self) -> None:
        self._results: dict[str, OrderedDict[Hashable, Any]] = {stage: OrderedDict() for stage in _KEPT}

    def get(self, stage: str, key: Hashable, compute: Callable[[], Value]) -> Value:
        """The result kept under `key`, or else a new one; a failed or cancelled computation leaves nothing behind."""
        results = self._results[stage]
        if key in results:
            results.move_to_end(key)
            kept: Value = results[key]
            return kept
        value = compute()
        results[key] = value
        if len(results) > _KEPT[stage]:
            results.popitem(last=False)
        return value


@dataclass(frozen=True, eq=False)
class Analysis:
    """What is known so far of a pair; later stages are None until they are done."""

    index: int
    """Which of the opened pairs."""
    pair: Pair
    """As loaded, with the scale and the normals that the settings ask for."""
    resolved: ResolvedSettings
    source: PointCloud
    """Prepared: rows of it are what features and matches count."""
    target: PointCloud
    source_shown: Shown
    """The points that are drawn, which borrow their colours from prepared ones."""
    target_shown: Shown
    given_estimate: Transform | None = None
    """A pose brought along to be diagnosed, in place of one computed here."""
    source_features: Features | None = None
    target_features: Features | None = None
    matches: MatchTable | None = None
    """From each source feature to the target, unfiltered."""
    back_matches: MatchTable | None = None
    """From each target feature to the source."""
    registration: RegistrationResult | None = None

    @property
    def truth(self) -> Transform | None:
        """The true pose, where it is known."""
        return self.pair.target_from_source

    @property
    def estimate(self) -> Transform | None:
        """The pose brought along or computed."""
        if self.given_estimate is not None:
            return self.given_estimate
        return None if self.registration is None else self.registration.target_from_source

    def reference(self, wanted: Reference | None) -> tuple[Reference, Transform] | None:
        """The pose that errors are measured against: the wanted one where it is known, else the other."""
        known: dict[Reference, Transform | None] = {"ground_truth": self.truth, "estimate": self.estimate}
        order: tuple[Reference, ...] = ("estimate", "ground_truth") if wanted == "estimate" else tuple(known)
        for name in order:
            pose = known[name]
            if pose is not None:
                return name, pose
        return None


@dataclass(frozen=True, eq=False)
class Scores:
    """How right the matches of an analysis are under its reference pose."""

    reference: Reference | None
    """None where no pose is known: errors are nan then."""
    forward: MatchErrors
    """Rows as in `Analysis.matches`."""
    back: MatchErrors
    """Rows as in `Analysis.back_matches`."""
    source_partner: Mask
    """Which prepared source points have a target point near their true place."""
    target_partner: Mask


class Analyst:
    """Runs the stages, from the first that changed: `run` for one thread, `register` for another."""

    def __init__(
        self,
        load: Callable[[int], Pair],
        *,
        given_estimate: Transform | None = None,
        disk: pipeline.DiskCache | None = None,
    ) -> None:
        self._load = load
        self._given_estimate = given_estimate
        self._disk = disk
        self._cache = StageCache()
        self._registrations = StageCache()

    def run(self, settings: ViewSettings, job: Job, show: Callable[[Analysis], None]) -> None:
        """Do what `settings` ask for up to the matches, and show it stage by stage.

        Raises:
            InputError: A file or setting cannot be used.
            Cancelled: The job is no longer wanted.
        """
        job.progress(0.0, "Loading the clouds")
        wanted = settings.pair_settings()
        pair = self._corrected(settings.pair, wanted)
        resolved = pipeline.resolve(wanted, pair.source, pair.target)
        job.progress(0.03, "Preparing the clouds")
        analysis = self._prepared(settings.pair, pair, resolved)
        show(analysis)
        analysis = self._described(analysis, job)
        show(analysis)
        job.progress(0.85, "Matching features")
        analysis = self._matched(analysis, job)
        show(analysis)

    def _corrected(self, index: int, wanted: PairSettings) -> Pair:
        pair = self._cache.get("load", index, lambda: self._load(index))

        def correct() -> Pair:
            source, target = pipeline.correct(wanted, pair.source, pair.target)
            return replace(pair, source=source, target=target)

        return self._cache.get("correct", (index, wanted.source_scale, wanted.normals), correct)

    def _prepared(self, index: int, pair: Pair, resolved: ResolvedSettings) -> Analysis:
        def prepare(side: Literal["source", "target"], cloud: PointCloud) -> PointCloud:
            key = (index, side, resolved.preparation_key)
            return self._cache.get("prepare", key, lambda: pipeline.prepare(cloud, resolved, side))

        def show(side: str, cloud: PointCloud, prepared: PointCloud) -> Shown:
            key = (index, side, resolved.preparation_key)
            return self._cache.get("show", key, lambda: choose_shown(cloud, prepared))

        source, target = prepare("source", pair.source), prepare("target", pair.target)
        source_shown, target_shown = show("source", pair.source, source), show("target", pair.target, target)
        # A pose was given for the pair that was opened with it.
        estimate = self._given_estimate if index == 0 else None
        return Analysis(index, pair, resolved, source, target, source_shown, target_shown, given_estimate=estimate)

    def _described(self, analysis: Analysis, job: Job) -> Analysis:
        resolved = analysis.resolved

        def describe(side: str, cloud: PointCloud, start: float, end: float) -> Features:
            text = f"Describing the {side}"
            job.progress(start, text)
            return self._cache.get(
                "describe",
                pipeline.feature_key(cloud, resolved),
                lambda: pipeline.describe_cached(
                    cloud,
                    resolved,
                    self._disk,
                    progress=lambda share, _: job.progress(start + (end - start) * share, text),
                    cancelled=job.is_cancelled,
                ),
            )

        source = describe("source", analysis.source, 0.1, 0.48)
        target = describe("target", analysis.target, 0.48, 0.85)
        return replace(
            analysis,
            source_features=pipeline.at_dim(source, resolved),
            target_features=pipeline.at_dim(target, resolved),
        )

    def _matched(self, analysis: Analysis, job: Job) -> Analysis:
        resolved, source, target = analysis.resolved, analysis.source_features, analysis.target_features
        assert source is not None
        assert target is not None

        def match(first: Features, second: Features) -> MatchTable:
            return pipeline.match_cached(first, second, resolved, self._disk, cancelled=job.is_cancelled)

        def match_both() -> tuple[MatchTable, MatchTable]:
            # Two threads that multiply small matrices are faster than one whose products each start threads.
            with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(2) as pool:
                forward, back = pool.submit(match, source, target), pool.submit(match, target, source)
                return forward.result(), back.result()

        matches, back = self._cache.get("match", pipeline.match_key(source, target), match_both)
        return replace(analysis, matches=matches, back_matches=back)

    def register(self, analysis: Analysis) -> RegistrationResult:
        """Estimate the pose from the matches of an analysis; takes a second or more and cannot be stopped."""
        resolved, matches = analysis.resolved, analysis.matches
        assert matches is not None
        correspondences = matches.correspondences.take(pipeline.filtered_rows(matches, resolved))
        return self._registrations.get(
            "register",
            (analysis.index, resolved.match_key, resolved.mutual, resolved.max_ratio),
            lambda: pipeline.register_pair(analysis.source, analysis.target, correspondences, resolved),
        )


def score(analysis: Analysis, wanted: Reference | None) -> Scores | None:
    """Measure every match under the reference pose; None before there are matches."""
    if analysis.matches is None or analysis.back_matches is None:
        return None
    source, target, tau = analysis.source, analysis.target, analysis.resolved.tau
    known = analysis.reference(wanted)
    pose = None if known is None else known[1]
    inverse = None if pose is None else transforms.invert(pose)
    if pose is None or inverse is None:
        source_partner, target_partner = np.ones(len(source), dtype=bool), np.ones(len(target), dtype=bool)
    else:
        source_partner = has_partner(source.points, target.points, pose, tau=tau)
        target_partner = has_partner(target.points, source.points, inverse, tau=tau)
    return Scores(
        reference=None if known is None else known[0],
        forward=match_errors(source, target, analysis.matches, target_from_source=pose, tau=tau),
        back=match_errors(target, source, analysis.back_matches, target_from_source=inverse, tau=tau),
        source_partner=source_partner,
        target_partner=target_partner,
    )


def kept_rows(table: MatchTable, settings: ViewSettings) -> npt.NDArray[np.int64]:
    """Rows of `table` that pass the filters chosen in the page."""
    return filter_rows(table, mutual=settings.mutual, max_ratio=settings.max_ratio)

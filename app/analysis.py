"""The stages of one pair, each kept until a setting that it depends on changes."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from app.jobs import Job
from app.preview import borrowing, choose_rows
from app.runs import Run
from app.settings import Reference, ViewSettings
from app.shown import MAX_SHOWN, Shown, choose_shown
from app.stage_cache import StageCache
from cgf import pipeline
from cgf.checks import InputError
from cgf.evaluation.matches import MatchErrors
from cgf.evaluation.metrics import correspondence_errors, has_partner
from cgf.geometry import transforms
from cgf.geometry.compiling import told_of_compiling
from cgf.matching import MatchTable, filter_rows
from cgf.pipeline import PairSettings, ResolvedSettings
from cgf.types import Cancelled, Features, Pair, PointCloud, RegistrationResult, Transform

Mask = npt.NDArray[np.bool_]

PREVIEWED = ("cgf", "pca")
"""Descriptors that describe a few points in a fraction of the time of all."""
PREVIEWS = ((0.045, 0.4), (0.4, 0.15))
"""Time to describe the points of the first preview and of the next, in seconds, and of how many of all points at most.

Beyond that share all of them come nearly as soon; the browser, too, takes its time to draw a preview.
"""
FEWEST_PREVIEWED = 64
USUAL_POINTS_PER_S = 4_000.0
"""Until the first description is timed."""


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
    runs: tuple[Run, ...] = ()
    """Poses looked for from the page."""
    chosen_run: Run | None = None
    """The one that stands for the estimate; None leaves it to the pose brought along or computed."""

    @property
    def truth(self) -> Transform | None:
        """The true pose, where it is known."""
        return self.pair.target_from_source

    @property
    def estimate(self) -> Transform | None:
        """The pose chosen from the runs, or else brought along or computed."""
        if self.chosen_run is not None:
            return self.chosen_run.result.target_from_source
        return self.automatic_estimate

    @property
    def automatic_estimate(self) -> Transform | None:
        """The pose brought along or computed without being asked for."""
        if self.given_estimate is not None:
            return self.given_estimate
        return None if self.registration is None else self.registration.target_from_source

    @property
    def described_points(self) -> int:
        """Points with a feature in both clouds together."""
        return len(self.source_features or ()) + len(self.target_features or ())

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
    """Runs the stages, from the first that changed; several threads may do so at once."""

    def __init__(
        self,
        load: Callable[[int], Pair],
        *,
        given_estimate: Transform | None = None,
        disk: pipeline.DiskCache | None = None,
        max_shown: int = MAX_SHOWN,
    ) -> None:
        self._load = load
        self._given_estimate = given_estimate
        self._disk = disk
        self._max_shown = max_shown
        self._cache = StageCache()
        self._registrations = StageCache()
        self._last_registrations: dict[int, RegistrationResult] = {}
        self._points_per_s = USUAL_POINTS_PER_S
        self._kernels_loaded = False

    def run(
        self,
        settings: ViewSettings,
        job: Job,
        show: Callable[[Analysis], None],
        show_preview: Callable[[Analysis], None] | None = None,
    ) -> None:
        """Do what `settings` ask for up to the matches, and show it stage by stage.

        Args:
            settings: What is asked for.
            job: Told of progress, and asked whether to give up.
            show: Given what is known after each stage.
            show_preview: Given what a few points are like while all of them are described; None needs no preview.

        Raises:
            InputError: A file or setting cannot be used.
            Cancelled: The job is no longer wanted.
        """
        # Only what takes its time is told: each text has the browser paint the page before the scene.
        job.check()
        if not self._cache.has("load", settings.pair):
            job.progress(0.0, "Loading the clouds")
        wanted = settings.pair_settings()
        pair = self.corrected(settings.pair, wanted)
        resolved = pipeline.resolve(wanted, pair.source, pair.target)
        if not self._cache.has("show", (settings.pair, "target", resolved.preparation_key)):
            job.progress(0.03, "Preparing the clouds")
        analysis = self._prepared(settings.pair, pair, resolved)
        show(analysis)
        known = self._is_described(analysis)
        # What is known needs no kernels, so that they are not even loaded.
        with contextlib.nullcontext() if known else told_of_compiling(lambda: _say_compiling(job)):
            self._kernels_loaded |= not known
            if not known and show_preview is not None:
                self._preview(analysis, settings, job, show_preview)
            analysis = self._described(analysis, job)
            show(analysis)
            job.check()
            analysis = self._matched(analysis, job)
        show(analysis)

    def load_kernels(self, analysis: Analysis) -> None:
        """Load what describing needs where everything was known already, so that the next change need not wait."""
        if self._kernels_loaded:
            return
        self._kernels_loaded = True
        some = np.arange(0, len(analysis.source), 500)
        with contextlib.suppress(InputError):
            few = pipeline.describe(analysis.source, analysis.resolved, indices=some)
            pipeline.match_features(few, few, analysis.resolved)

    def corrected(self, index: int, wanted: PairSettings) -> Pair:
        """The pair as loaded, with the scale and the normals that are wanted."""
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
            return self._cache.get("show", key, lambda: choose_shown(cloud, prepared, limit=self._max_shown))

        source, target = prepare("source", pair.source), prepare("target", pair.target)
        source_shown, target_shown = show("source", pair.source, source), show("target", pair.target, target)
        # A pose was given for the pair that was opened with it.
        estimate = self._given_estimate if index == 0 else None
        return Analysis(index, pair, resolved, source, target, source_shown, target_shown, given_estimate=estimate)

    def _is_described(self, analysis: Analysis) -> bool:
        keys = [pipeline.feature_key(cloud, analysis.resolved) for cloud in (analysis.source, analysis.target)]
        return all(self._cache.has("describe", key) or (self._disk is not None and key in self._disk) for key in keys)

    def _preview(self, analysis: Analysis, settings: ViewSettings, job: Job, show: Callable[[Analysis], None]) -> None:
        """Describe, match and show a few points, and then more of them, where describing all takes long."""
        resolved, source, target = analysis.resolved, analysis.source, analysis.target
        if resolved.descriptor not in PREVIEWED:
            return
        judged = replace(analysis, registration=self._last_registrations.get(analysis.index))
        reference = judged.reference(settings.reference)
        for seconds, largest in PREVIEWS:
            count = max(int(self._points_per_s * seconds / 2), FEWEST_PREVIEWED)
            if 2 * count > largest * (len(source) + len(target)):
                return
            text = f"Preview from {2 * count:,} points"
            job.progress(0.05, text)
            rows = choose_rows(
                source, target, count=count, target_from_source=None if reference is None else reference[1]
            )
            features = [
                pipeline.describe(cloud, resolved, indices=some, cancelled=job.is_cancelled)
                for cloud, some in zip((source, target), rows, strict=True)
            ]
            preview = replace(
                judged,
                source_features=pipeline.at_dim(features[0], resolved),
                target_features=pipeline.at_dim(features[1], resolved),
                source_shown=borrowing(analysis.source_shown, source, features[0]),
                target_shown=borrowing(analysis.target_shown, target, features[1]),
            )
            matches, back = pipeline.match_both_features(features[0], features[1], resolved, cancelled=job.is_cancelled)
            show(replace(preview, matches=matches, back_matches=back))

    def _described(self, analysis: Analysis, job: Job) -> Analysis:
        resolved = analysis.resolved

        def describe(side: str, cloud: PointCloud, start: float, end: float) -> Features:
            text = f"Describing the {side}"
            job.check()
            key = pipeline.feature_key(cloud, resolved)
            return self._cache.get("describe", key, lambda: compute(key, cloud, start, end, text))

        def compute(key: str, cloud: PointCloud, start: float, end: float, text: str) -> Features:
            job.progress(start, text)
            held = self._disk is not None and key in self._disk
            started = time.perf_counter()
            features = pipeline.describe_cached(
                cloud,
                resolved,
                self._disk,
                progress=lambda share, _: job.progress(start + (end - start) * share, text),
                cancelled=job.is_cancelled,
            )
            if not held:
                self._points_per_s = len(cloud) / (time.perf_counter() - started)
            return features

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

        def match_both() -> tuple[MatchTable, MatchTable]:
            job.progress(0.85, "Matching features")
            return pipeline.match_both_cached(source, target, resolved, self._disk, cancelled=job.is_cancelled)

        both = self._cache.get("match", pipeline.match_key(source, target), match_both)
        # Found again by the settings alone, for those who do not want to describe first.
        matches, back = self._cache.get("matched", (analysis.index, resolved.match_key), lambda: both)
        return replace(analysis, matches=matches, back_matches=back)

    def known_matches(self, index: int, resolved: ResolvedSettings) -> tuple[MatchTable, MatchTable] | None:
        """Matches from source to target and back under `resolved`, if they were computed lately."""
        found: tuple[MatchTable, MatchTable] | None = self._cache.peek("matched", (index, resolved.match_key))
        return found

    def register(self, analysis: Analysis, job: Job) -> RegistrationResult:
        """Estimate the pose from the matches of an analysis.

        Raises:
            Cancelled: The job is no longer wanted.
        """
        resolved, matches = analysis.resolved, analysis.matches
        assert matches is not None
        correspondences = matches.correspondences.take(pipeline.filtered_rows(matches, resolved))
        registration = self._registrations.get(
            "register",
            (analysis.index, resolved.match_key, resolved.mutual, resolved.max_ratio, resolved.surest),
            lambda: pipeline.register_pair(
                analysis.source, analysis.target, correspondences, resolved, cancelled=job.is_cancelled
            ),
        )
        self._last_registrations[analysis.index] = registration
        return registration


def _say_compiling(job: Job) -> None:
    # The compiler must come to its end even where nobody wants the result any more.
    with contextlib.suppress(Cancelled):
        job.progress(0.05, "Compiling (first start only)")


@lru_cache(maxsize=4)
def _partners(source: PointCloud, target: PointCloud, pose: tuple[float, ...], tau: float) -> tuple[Mask, Mask]:
    """Which points of either cloud have a partner; asked for again at every change of a dimension or a filter."""
    target_from_source = np.array(pose).reshape(4, 4)
    return (
        has_partner(source.points, target.points, target_from_source, tau=tau),
        has_partner(target.points, source.points, transforms.invert(target_from_source), tau=tau),
    )


def score(analysis: Analysis, wanted: Reference | None) -> Scores | None:
    """Measure every match under the reference pose; None before there are matches."""
    if analysis.matches is None or analysis.back_matches is None:
        return None
    source, target = analysis.source, analysis.target

    def measured(first: PointCloud, second: PointCloud, table: MatchTable, pose: Transform, has: Mask) -> MatchErrors:
        rows = table.correspondences.indices
        return MatchErrors(correspondence_errors(first.points, second.points, rows, pose), has[rows[:, 0]])

    known = analysis.reference(wanted)
    if known is None:
        return Scores(
            reference=None,
            forward=_unknown_errors(analysis.matches),
            back=_unknown_errors(analysis.back_matches),
            source_partner=np.ones(len(source), dtype=np.bool_),
            target_partner=np.ones(len(target), dtype=np.bool_),
        )
    name, pose = known
    source_partner, target_partner = _partners(source, target, tuple(pose.ravel().tolist()), analysis.resolved.tau)
    return Scores(
        reference=name,
        forward=measured(source, target, analysis.matches, pose, source_partner),
        back=measured(target, source, analysis.back_matches, transforms.invert(pose), target_partner),
        source_partner=source_partner,
        target_partner=target_partner,
    )


def _unknown_errors(table: MatchTable) -> MatchErrors:
    return MatchErrors(np.full(len(table), np.nan), np.zeros(len(table), dtype=np.bool_))


def kept_rows(table: MatchTable, settings: ViewSettings) -> npt.NDArray[np.int64]:
    """Rows of `table` that pass the filters chosen in the page."""
    return filter_rows(table, mutual=settings.mutual, max_ratio=settings.max_ratio, surest=settings.surest)

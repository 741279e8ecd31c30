"""The state behind the page: what was asked for, what is known, and who wants to hear of changes."""

import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from app import snapshot as snapshots
from app.analysis import Analysis, Analyst, Scores, kept_rows, score
from app.columns import draw_columns
from app.diagnosing import Diagnosing
from app.explorer import NO_FINDINGS, Explorer, Findings, check_rows, stepped
from app.funnel import funnel_of, picked_of
from app.jobs import Job, Worker
from app.pair_source import PairSource, match_command, open_command
from app.picking import Camera, Floats, point_at_ray, points_in_box
from app.picture import Picture, Placed, draw, place
from app.plots import right_within
from app.point import PointDetails, point_details
from app.settings import MAX_SELECTED, Picked, Selected, ViewSettings
from app.shown import MAX_SHOWN
from app.snapshot import CloudInfo, Message, Snapshot, Status
from app.state_text import write_state
from app.wording import in_words_of_the_page, text_of
from app.workbench import Workbench
from cgf import pipeline
from cgf.checks import InputError
from cgf.evaluation.matches import export_matches
from cgf.types import Transform

Listener = Callable[[], None]


PROGRESS_INTERVAL_S = 0.25
"""Between two notices of one stage's progress: each has the browser paint the page, scene included, which without a
graphics card takes the time of the computation itself."""
PAINT_S = 0.25
"""Left to the browser after new matches, before the pose is estimated, which takes all processors: without a graphics
card, painting the points in their new colours needs them too."""


class Session:
    """One run of the viewer. Its methods may be called from any thread; listeners are called from several."""

    def __init__(
        self,
        pairs: Sequence[PairSource],
        settings: ViewSettings,
        *,
        given_estimate: Transform | None = None,
        disk: pipeline.DiskCache | None = None,
        max_shown: int = MAX_SHOWN,
    ) -> None:
        """Open `pairs` with the first settings; nothing runs before `start`.

        Args:
            pairs: At least one.
            settings: From the command line.
            given_estimate: A pose of the first pair to be diagnosed.
            disk: Where features and matches are kept from one run to the next; None keeps them nowhere.
            max_shown: Most points of one cloud that are drawn.
        """
        self._pairs = tuple(pairs)
        self._analyst = Analyst(
            lambda index: self._pairs[index].load(), given_estimate=given_estimate, disk=disk, max_shown=max_shown
        )
        self._lock = threading.RLock()
        self._listeners: list[Listener] = []
        self._settings = settings
        self._progress_told = 0.0
        self._revision = 0
        self._status = Status("working", "Starting", 0.0)
        self._error: str | None = None
        self._analysis: Analysis | None = None
        self._preview: Analysis | None = None
        self._work_done: tuple[object, ...] | None = None
        self._placed: tuple[Analysis, Placed] | None = None
        self._score = lru_cache(maxsize=2)(score)
        self._explorer = Explorer()
        self._picture: Picture | None = None
        self._snapshot: Snapshot | None = None
        # Estimating a pose holds up nothing: the next change is computed meanwhile.
        self._worker = Worker(on_progress=self._on_progress, on_idle=self._notify, on_error=self._on_error)
        self._estimator = Worker(on_progress=self._on_progress, on_idle=self._notify, on_error=self._on_error)
        self.workbench = Workbench(self, self._analyst)
        self.diagnosing = Diagnosing(self, self._analyst, self.workbench)

    def start(self) -> None:
        """Begin with the first pair."""
        self._submit()

    def close(self) -> None:
        """Stop working; does not wait."""
        self._worker.close()
        self._estimator.close()
        self.workbench.tasks.close()

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` after every change, until the function returned is called."""
        with self._lock:
            self._listeners.append(listener)

        def forget() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return forget

    def wait_until_idle(self, timeout_s: float | None = None) -> bool:
        """Wait until nothing is left to do; tells whether that came true."""
        return self.wait_for_main_work(timeout_s) and self.workbench.tasks.wait_until_idle(timeout_s)

    def wait_for_main_work(self, timeout_s: float | None = None) -> bool:
        """The same, but for what panels asked for beside it."""
        return self._worker.wait_until_idle(timeout_s) and self._estimator.wait_until_idle(timeout_s)

    @property
    def settings(self) -> ViewSettings:
        """What was asked for last."""
        with self._lock:
            return self._settings

    @property
    def status(self) -> Status:
        """What the worker does."""
        with self._lock:
            return self._status

    @property
    def revision(self) -> int:
        """Number of the current snapshot, but for its status."""
        with self._lock:
            return self._revision

    def picture(self) -> Picture | None:
        """What is to be drawn; the same object until it changes, None before there are clouds."""
        with self._lock:
            return self._picture

    def change(self, changes: Mapping[str, Any]) -> Snapshot:
        """Replace some settings; what needs no worker is shown at once.

        Raises:
            ValueError: A setting cannot be used; nothing has changed then.
        """
        with self._lock:
            settings = self._settings.changed(changes, pairs=len(self._pairs))
            analysis = self._analysis
            if analysis is not None and settings.work_key == self._work_done:
                # While clouds are still to be prepared their rows are not known; one they do not have picks nothing.
                check_rows(analysis, settings)
            needs_work = settings.work_key != self._settings.work_key
            if needs_work and analysis is not None and settings.pair == analysis.index:
                try:
                    wanted = settings.pair_settings()
                    # A cloud of another scale is not there yet; the worker will say what does not suit it.
                    if wanted.source_scale == analysis.resolved.corrections.source_scale:
                        pipeline.resolve(wanted, analysis.pair.source, analysis.pair.target)
                except ValueError as error:
                    raise InputError(in_words_of_the_page(str(error))) from error
            new_matches = settings.match_key != self._settings.match_key
            self._settings = settings
            self._error = None
            if not new_matches:
                self._redraw()
            if needs_work:
                self._status = Status("working", "Starting", 0.0)
                self._submit()
            self._touch()
        if "columns" in changes or needs_work:
            self.workbench.compare()
        self._notify()
        return self.snapshot()

    def point(self) -> PointDetails:
        """Everything about the picked point.

        Raises:
            InputError: Nothing is picked, or there are no matches yet.
        """
        with self._lock:
            analysis, scores, findings = self._analysis, self._scores(), self.findings()
            if analysis is None or scores is None:
                raise InputError("There are no matches yet; wait until they are computed.")
            if findings.picked is None:
                raise InputError("Nothing is picked; click a point in the scene.")
            near = right_within(analysis, self._settings)
            return point_details(self._revision, analysis, scores, findings, near=near)

    def pick_at(self, origin: Floats, direction: Floats, *, pixel: float) -> None:
        """Pick the point under a pointer; beside all points, pick nothing any more.

        Args:
            origin: Of the ray through the pointer, in the frame of the picture.
            direction: Of the ray.
            pixel: Size of a pixel at distance 1.
        """
        picture = self.picture()
        if picture is not None and not picture.columns:
            found = point_at_ray(picture, origin, direction, pixel=pixel)
            self.change({"picked": None if found is None else Picked(*found), "selected": None})

    def select_in(self, camera: Camera, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Pick the point in the middle of a box on the screen, and draw lines from the points in the box only.

        Args:
            camera: That sees the box.
            low: Its left upper corner, as shares of the window.
            high: Its right lower corner.
        """
        picture = self.picture()
        found = None if picture is None or picture.columns else points_in_box(picture, camera, low, high)
        if found is None:
            self.change({"picked": None, "selected": None})
            return
        side, rows = found
        # Evenly thinned from the middle outwards.
        some = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_SELECTED)).astype(np.int64))]
        self.change({"picked": Picked(side, int(rows[0])), "selected": Selected(side, tuple(some.tolist()))})

    def step(self, by: int) -> Snapshot:
        """Pick and isolate the match `by` places from the picked one, in the order chosen.

        Raises:
            InputError: There is no match to go to.
        """
        with self._lock:
            analysis, scores = self._analysis, self._scores()
            if analysis is None or scores is None:
                raise InputError("There are no matches yet; wait until they are computed.")
            picked = stepped(analysis, scores, self._settings, by=by)
            if picked is None:
                raise InputError("No match passes the filters; relax them.")
        return self.change({"picked": picked, "isolate": True})

    def open(self, pair: PairSource, settings: Mapping[str, Any]) -> Snapshot:
        """Offer another pair, read already, and show it.

        Args:
            pair: Becomes the last of the pairs.
            settings: For it; the others stay.

        Raises:
            ValueError: The pair cannot be shown; nothing has changed then.
        """
        loaded = pair.load()
        corrected = pipeline.correct(pipeline.PairSettings(), loaded.source, loaded.target)
        pipeline.resolve(pipeline.PairSettings(), *corrected)
        with self._lock:
            self._pairs = (*self._pairs, pair.holding(loaded))
            return self.change({**settings, "pair": len(self._pairs) - 1})

    def files(self) -> tuple[Path, Path] | None:
        """Source and target of the pair shown, where they are the user's own files."""
        with self._lock:
            return self._pairs[self._settings.pair].files

    def cancel(self) -> None:
        """Stop the running work; what is shown stays."""
        self._worker.cancel()
        self._estimator.cancel()
        with self._lock:
            if self._status.phase == "working":
                self._status = Status("failed", "Stopped", 0.0)
                self._error = "Stopped before the end; what is shown may belong to other settings."
                self._drop_preview()
        self._notify()

    def snapshot(self) -> Snapshot:
        """The state of the page now."""
        with self._lock:
            if self._snapshot is None or self._snapshot.revision != self._revision:
                self._snapshot = self._build_snapshot()
            settled = self._status.phase == "ready" and self._work_done == self._settings.work_key
            status = replace(self._status, tasks=self.workbench.tasks.running())
            return replace(self._snapshot, status=status, settled=settled)

    def shown(self) -> tuple[Analysis | None, Scores | None, ViewSettings, int]:
        """The analysis with its scores, the settings, and the number of the state."""
        with self._lock:
            return self._analysis, self._scores(), self._settings, self._revision

    def renewed(self) -> None:
        """Draw and tell everything anew, after a task has found something."""
        with self._lock:
            self._redraw()
            self._diagnose()
        self._notify()

    def told(self) -> None:
        """Tell of a task's progress."""
        self._notify()

    def failed(self, error: Exception) -> None:
        """Tell why a task has failed; what is shown stays right."""
        with self._lock:
            self._error = text_of(error)
            self._touch()
        self._notify()

    def picture_with(self, **changes: Any) -> Picture:
        """What would be drawn with other view settings; nothing changes.

        Raises:
            InputError: There are no clouds yet.
        """
        with self._lock:
            analysis, placed = self._analysis, self._placed
            if analysis is None:
                raise InputError("There are no clouds yet; wait until they are loaded.")
            # A preview may be drawn at the moment, whose points are others.
            fits = placed is not None and placed[0].source is analysis.source and placed[0].target is analysis.target
            return draw(
                analysis,
                self._scores(),
                replace(self._settings, **changes),
                placed[1] if placed is not None and fits else place(analysis),
                self.findings(),
            )

    def export(self, suffix: str) -> bytes:
        """The matches that pass the filters, as `cgf match` writes them.

        Args:
            suffix: `.csv` or `.npz`.

        Raises:
            InputError: There are no matches yet.
        """
        with self._lock:
            analysis, settings = self._analysis, self._settings
            scores = self._scores()
        if analysis is None or analysis.matches is None or scores is None:
            raise InputError("There are no matches yet; wait until they are computed.")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"matches{suffix}"
            rows = kept_rows(analysis.matches, settings)
            export_matches(path, analysis.source, analysis.target, analysis.matches, rows, scores.forward)
            return path.read_bytes()

    def _submit(self) -> None:
        settings, started = self._settings, time.perf_counter()
        self._estimator.cancel()
        self.diagnosing.stop()

        def work(job: Job) -> None:
            self._analyst.run(
                settings, job, lambda analysis: self._show(analysis, job), lambda found: self._show_preview(found, job)
            )
            with self._lock:
                job.check()
                analysis = self._analysis
                assert analysis is not None
                elapsed_s = time.perf_counter() - started
                if analysis.given_estimate is None:
                    self._status = Status("working", "Estimating the pose", 0.95)
                    self._estimator.submit(lambda job: estimate(job, analysis, elapsed_s))
                else:
                    self._finish(settings, elapsed_s)
            self._analyst.load_kernels(analysis)

        def estimate(job: Job, analysis: Analysis, elapsed_s: float) -> None:
            if self._is_watched():
                job.pause(PAINT_S)
            registration = self._analyst.register(analysis, job)
            with self._lock:
                job.check()
                self._analysis = replace(analysis, registration=registration)
                self._redraw()
                if analysis.truth is None:
                    elapsed_s = time.perf_counter() - started
                self._finish(settings, elapsed_s)

        self._worker.submit(work)

    def _finish(self, settings: ViewSettings, elapsed_s: float) -> None:
        """Everything shown belongs to `settings` from now on; called with the lock held."""
        self._work_done = settings.work_key
        self._status = Status("ready", "Ready", 1.0, elapsed_s)
        self._touch()
        self._diagnose()

    def _diagnose(self) -> None:
        """Have what is shown diagnosed, if it belongs to the settings; called with the lock held."""
        if self._analysis is not None and self._work_done == self._settings.work_key:
            self.diagnosing.update(self._analysis, self._settings)

    def _show(self, analysis: Analysis, job: Job) -> None:
        with self._lock:
            job.check()
            shown = self._analysis
            if shown is not None and shown.index == analysis.index and shown.matches is not None:
                if analysis.matches is None:
                    # The last good result stays until the matches of the new settings are there.
                    return
                # Until the new pose is estimated, the last one is a good judge of the new matches.
                analysis = replace(analysis, registration=shown.registration)
                if analysis.matches is shown.matches and self._preview is None:
                    # Only a filter has changed, and that is shown already.
                    self._analysis = analysis
                    return
            self._analysis, self._preview = analysis, None
            self._redraw()
        self._notify()

    def _show_preview(self, preview: Analysis, job: Job) -> None:
        """Draw a preview; the numbers stay those of the last good result."""
        with self._lock:
            job.check()
            self._preview = preview
            self._redraw()
        self._notify()

    def _drop_preview(self) -> None:
        """Draw the last good result again; called with the lock held."""
        self._preview = None
        self._redraw()

    def _redraw(self) -> None:
        """Draw what is known under the current settings; called with the lock held."""
        if self._analysis is not None:
            self._analysis = self.workbench.attach(self._analysis)
        analysis = self._analysis if self._preview is None else self.workbench.attach(self._preview)
        if analysis is not None:
            placed = self._placed
            if placed is None or placed[0].source is not analysis.source or placed[0].target is not analysis.target:
                self._placed = placed = (analysis, place(analysis, None if placed is None else placed[1]))
            scores, findings = self._score(analysis, self._settings.reference), self.findings()
            if self._preview is not None:
                # What is known of points belongs to the last good result, and most have no stage yet.
                same = self._analysis is not None and self._analysis.source is analysis.source
                findings = Findings(picked=findings.picked if same else None)
            self._picture = draw(analysis, scores, self._settings, placed[1], findings)
            if self._settings.highlight and self._preview is None:
                self._picture = self.diagnosing.highlight(self._picture, analysis, self._settings)
            if self._settings.columns:
                columns = self.workbench.columns(analysis, self._settings)
                self._picture = draw_columns(self._picture, columns, self._settings, placed[1])
        self._touch()

    def _scores(self) -> Scores | None:
        """Scores of the last good result; called with the lock held."""
        return None if self._analysis is None else self._score(self._analysis, self._settings.reference)

    def findings(self) -> Findings:
        """What is known of stages and of the picked point."""
        with self._lock:
            if self._analysis is None:
                return NO_FINDINGS
            return self._explorer.look(self._analysis, self._scores(), self._settings)

    def _touch(self) -> None:
        self._revision += 1

    def _is_watched(self) -> bool:
        with self._lock:
            return bool(self._listeners)

    def _notify(self) -> None:
        with self._lock:
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()

    def _on_progress(self, share: float, text: str) -> None:
        now = time.monotonic()
        with self._lock:
            news = text != self._status.text or now - self._progress_told >= PROGRESS_INTERVAL_S
            self._status = Status("working", text, share)
            if news:
                self._progress_told = now
        if news:
            self._notify()

    def _on_error(self, error: Exception) -> None:
        with self._lock:
            self._status = Status("failed", "Failed", 0.0)
            self._error = text_of(error)
            self._drop_preview()
            if isinstance(error, ValueError):
                self.diagnosing.explain(self._settings, error)
        self._notify()

    def _build_snapshot(self) -> Snapshot:
        analysis, settings = self._analysis, self._settings
        names = tuple(pair.name for pair in self._pairs)
        messages = [] if self._error is None else [Message("error", self._error)]
        if analysis is None:
            return Snapshot(
                revision=self._revision, status=self._status, settled=False, previewed=None, pairs=names,
                settings=settings, source=None, target=None, unit=None, model=None, controls=None, pose=None,
                reference=None, numbers=None, estimate=None, curve=None, funnel=(), picked=None, legend=None,
                messages=tuple(messages), diagnosis=self.diagnosing.info(), columns=(), command="",
                shared=write_state(settings), open_command="",
            )  # fmt: skip
        scores, findings = self._scores(), self.findings()
        numbers, curve = (None, None) if scores is None else snapshots.numbers_of(analysis, scores, settings)
        messages += [
            replace(message, text=in_words_of_the_page(message.text))
            for message in snapshots.messages_of(analysis, scores, numbers, settings)
        ]
        sides = (
            (analysis.pair.source, analysis.source_shown, analysis.source, analysis.source_features),
            (analysis.pair.target, analysis.target_shown, analysis.target, analysis.target_features),
        )
        source, target = (
            CloudInfo(
                loaded.name, len(loaded), len(shown.cloud), len(prepared), None if features is None else len(features)
            )
            for loaded, shown, prepared, features in sides
        )
        choice = analysis.resolved.choice
        return Snapshot(
            revision=self._revision,
            status=self._status,
            settled=False,
            previewed=None if self._preview is None else self._preview.described_points,
            pairs=names,
            settings=settings,
            source=source,
            target=target,
            unit=snapshots.unit_of(analysis),
            model=snapshots.Model(choice.name, choice.reason),
            controls=snapshots.controls_of(analysis),
            pose=snapshots.pose_of(analysis, settings),
            reference=None if scores is None else scores.reference,
            numbers=numbers,
            estimate=snapshots.estimate_of(analysis),
            curve=curve,
            funnel=funnel_of(analysis, scores, settings, findings),
            picked=picked_of(analysis, scores, settings, findings),
            legend=self.diagnosing.legend(snapshots.legend_of(analysis, scores, settings, findings), settings),
            messages=tuple(messages),
            diagnosis=self.diagnosing.info(),
            columns=tuple(column.info for column in self.workbench.columns(analysis, settings)),
            command=match_command(self._pairs[analysis.index], settings),
            shared=write_state(settings),
            open_command=open_command(self._pairs[analysis.index], settings),
        )

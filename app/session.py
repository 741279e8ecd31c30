"""The state behind the page: what was asked for, what is known, and who wants to hear of changes."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from app.analysis import Analysis, Analyst, Scores
from app.diagnosing import Diagnosing
from app.explorer import Findings, check_rows, stepped
from app.figures import STARTING, first_snapshot, snapshot_of
from app.jobs import Job, Worker
from app.listeners import Listener, Listeners
from app.look_ahead import LookAhead
from app.painter import Painter
from app.pair_source import PairSource
from app.picture import Picture
from app.plots import right_within
from app.point import PointDetails, point_details
from app.settings import ViewSettings
from app.shown import MAX_SHOWN
from app.snapshot import Snapshot, Status
from app.wording import in_words_of_the_page, text_of
from app.workbench import Workbench
from cgf import pipeline
from cgf.checks import InputError
from cgf.types import Transform


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
        patience_s: float = 0.0,
    ) -> None:
        """Open `pairs` with the first settings; nothing runs before `start`.

        Args:
            pairs: At least one.
            settings: From the command line.
            given_estimate: A pose of the first pair to be diagnosed.
            disk: Where features and matches are kept from one run to the next; None keeps them nowhere.
            max_shown: Most points of one cloud that are drawn.
            patience_s: Left to a browser that paints new colours, before the pose is estimated, which takes all
                processors; four times that before the diagnosis, half after a preview. Where it is not 0, other
                dimensions are matched ahead.
        """
        self._pairs = tuple(pairs)
        self._analyst = Analyst(
            lambda index: self._pairs[index].load(), given_estimate=given_estimate, disk=disk, max_shown=max_shown
        )
        self._lock = threading.RLock()
        self._listeners = Listeners()
        self._settings = settings
        self._revision = 0
        self._status = STARTING
        self._error: str | None = None
        self._analysis: Analysis | None = None
        self._preview: Analysis | None = None
        self._work_done: tuple[object, ...] | None = None
        self._picture: Picture | None = None
        self._snapshot: Snapshot | None = None
        # Estimating a pose holds up nothing: the next change is computed meanwhile.
        self._worker = Worker(on_progress=self._on_progress, on_idle=self._listeners.notify, on_error=self._on_error)
        self._estimator = Worker(on_progress=self._on_progress, on_idle=self._listeners.notify, on_error=self._on_error)
        self._patience_s = patience_s
        self.workbench = Workbench(self, self._analyst)
        self.diagnosing = Diagnosing(self, self._analyst, self.workbench, patience_s=4 * patience_s)
        self.ahead = LookAhead(self, self._analyst, patience_s=4 * patience_s)
        self._painter = Painter(self.workbench, self.diagnosing)

    def start(self) -> None:
        """Begin with the first pair."""
        self._submit()

    def close(self) -> None:
        """Stop working; does not wait."""
        self._worker.close()
        self._estimator.close()
        self.ahead.close()
        self.workbench.tasks.close()

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` after every change, until the function returned is called."""
        return self._listeners.add(listener)

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
                self._status = STARTING
                self._submit()
            self._revision += 1
        if "columns" in changes or needs_work:
            self.workbench.compare()
        self._listeners.notify()
        return self.snapshot()

    def point(self) -> PointDetails:
        """Everything about the picked point.

        Raises:
            InputError: Nothing is picked, or there are no matches yet.
        """
        with self._lock:
            (analysis, scores), findings = self._judged(), self.findings()
            if findings.picked is None:
                raise InputError("Nothing is picked; click a point in the scene.")
            near = right_within(analysis, self._settings)
            return point_details(self._revision, analysis, scores, findings, near=near)

    def step(self, by: int) -> Snapshot:
        """Pick and isolate the match `by` places from the picked one, in the order chosen.

        Raises:
            InputError: There is no match to go to.
        """
        with self._lock:
            picked = stepped(*self._judged(), self._settings, by=by)
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
        self._listeners.notify()

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
        self._listeners.notify()

    def told(self) -> None:
        """Tell of a task's progress."""
        self._listeners.notify()

    def failed(self, error: Exception) -> None:
        """Tell why a task has failed; what is shown stays right."""
        with self._lock:
            self._error = text_of(error)
            self._revision += 1
        self._listeners.notify()

    def picture_with(self, **changes: Any) -> Picture:
        """What would be drawn with other view settings; nothing changes.

        Raises:
            InputError: There are no clouds yet.
        """
        with self._lock:
            analysis, settings = self._analysis, self._settings
            if analysis is None:
                raise InputError("There are no clouds yet; wait until they are loaded.")
            return self._painter.paint_otherwise(analysis, settings, replace(settings, **changes))

    def _submit(self) -> None:
        settings, started = self._settings, time.perf_counter()
        self._estimator.cancel()
        self.ahead.cancel()
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

        def estimate(job: Job, analysis: Analysis, elapsed_s: float) -> None:
            # At first, the browser still loads the page; without the true pose, its colours wait for the estimate.
            is_first = self._work_done is None and analysis.truth is not None
            job.pause(4 * self._patience_s if is_first else self._patience_s)
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
        self._revision += 1
        self._diagnose()
        if self._patience_s and self._analysis is not None:
            self.ahead.look(self._analysis, settings)

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
        self._listeners.notify()

    def _show_preview(self, preview: Analysis, job: Job) -> None:
        """Draw a preview; the numbers stay those of the last good result."""
        with self._lock:
            job.check()
            self._preview = preview
            self._redraw()
        self._listeners.notify()
        # Else a preview is drawn hardly before what it is a preview of.
        job.pause(self._patience_s / 2)

    def _drop_preview(self) -> None:
        """Draw the last good result again; called with the lock held."""
        self._preview = None
        self._redraw()

    def _redraw(self) -> None:
        """Draw what is known under the current settings; called with the lock held."""
        if self._analysis is not None:
            self._analysis = self.workbench.attach(self._analysis)
        if self._preview is not None:
            preview = self.workbench.attach(self._preview)
            self._picture = self._painter.paint_preview(preview, self._analysis, self._settings)
        elif self._analysis is not None:
            self._picture = self._painter.paint(self._analysis, self._settings)
        self._revision += 1

    def _scores(self) -> Scores | None:
        """Scores of the last good result; called with the lock held."""
        return self._painter.scores(self._analysis, self._settings)

    def _judged(self) -> tuple[Analysis, Scores]:
        analysis, scores = self._analysis, self._scores()
        if analysis is None or scores is None:
            raise InputError("There are no matches yet; wait until they are computed.")
        return analysis, scores

    def findings(self) -> Findings:
        """What is known of stages and of the picked point."""
        with self._lock:
            return self._painter.findings(self._analysis, self._settings)

    def _on_progress(self, share: float, text: str) -> None:
        with self._lock:
            self._status = Status("working", text, share)
        self._listeners.notify()

    def _on_error(self, error: Exception) -> None:
        with self._lock:
            self._status = Status("failed", "Failed", 0.0)
            self._error = text_of(error)
            self._drop_preview()
            if isinstance(error, ValueError):
                self.diagnosing.explain(self._settings, error)
        self._listeners.notify()

    def _build_snapshot(self) -> Snapshot:
        analysis, settings = self._analysis, self._settings
        if analysis is None:
            told = first_snapshot(self._pairs, settings, error=self._error)
        else:
            told = snapshot_of(analysis, self._scores(), self.findings(), settings, self._pairs, error=self._error)
            columns = self.workbench.columns(analysis, settings)
            told = replace(
                told,
                previewed=None if self._preview is None else self._preview.described_points,
                legend=None if told.legend is None else self.diagnosing.legend(told.legend, settings),
                columns=tuple(column.info for column in columns),
            )
        return replace(told, revision=self._revision, status=self._status, diagnosis=self.diagnosing.info())

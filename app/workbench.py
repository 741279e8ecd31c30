"""What the panels for plots, poses and comparison have done beside the main work of a session."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, Protocol

from app.analysis import Analysis, Analyst, Scores
from app.compare import ComparedColumn, Comparison
from app.jobs import Job
from app.plots import Plots, SweepName, make_plots, run_sweep
from app.poses import PoseRow, PoseTable, known_poses, shown_pose
from app.runs import MAX_RUNS, Run
from app.settings import ViewSettings
from app.tasks import Tasks
from cgf import pipeline
from cgf.checks import InputError
from cgf.pipeline import RegistrationSettings
from cgf.types import RegistrationResult

WAIT_S = 0.5
"""Between two looks whether a task that waits for the main work is still wanted."""


class Host(Protocol):
    """The session, as far as the workbench knows it."""

    def shown(self) -> tuple[Analysis | None, Scores | None, ViewSettings, int]:
        """The analysis with its scores, the settings, and the number of the state."""

    def renewed(self) -> None:
        """Draw and tell everything anew; called without a lock held."""

    def told(self) -> None:
        """Tell of progress."""

    def failed(self, error: Exception) -> None:
        """Tell what went wrong with a task."""

    def wait_for_main_work(self, timeout_s: float) -> bool:
        """Wait until the main work is done; tells whether that came true."""


class Workbench:
    """Tasks that a person asks for from a panel, and their results. Methods may be called from any thread."""

    def __init__(self, host: Host, analyst: Analyst) -> None:
        """Nothing runs before a person asks for it."""
        self._host = host
        self._analyst = analyst
        self._runs: dict[int, tuple[Run, ...]] = {}
        self._chosen: dict[int, Run | None] = {}
        self._count = 0
        self._poses = PoseTable()
        self._comparison = Comparison(analyst)
        self.tasks = Tasks(on_progress=host.told, on_error=host.failed, on_idle=host.told)

    def attach(self, analysis: Analysis) -> Analysis:
        """The analysis with the runs of its pair."""
        runs, chosen = self._runs.get(analysis.index, ()), self._chosen.get(analysis.index)
        if analysis.runs == runs and analysis.chosen_run is chosen:
            return analysis
        return replace(analysis, runs=runs, chosen_run=chosen)

    # ------------------------------------------------------------------ poses

    def poses(self) -> tuple[PoseRow, ...]:
        """How good every known pose is.

        Raises:
            InputError: The clouds are not there yet.
        """
        analysis, _, settings, _ = self._host.shown()
        if analysis is None:
            raise InputError("There are no clouds yet; wait until they are read.")
        return self._poses.rows(analysis, settings)

    def run(self, wanted: RegistrationSettings, start: str | None) -> None:
        """Look for the pose in the background.

        Args:
            wanted: How.
            start: Name of the pose that ICP alone starts from; None is the one shown.

        Raises:
            InputError: There are no matches yet, or no such pose.
        """
        analysis, _, settings, _ = self._host.shown()
        if analysis is None or (analysis.matches is None and wanted.method != "icp"):
            raise InputError("There are no matches yet; wait until they are computed.")
        shown = shown_pose(analysis, settings)
        if start is not None and start not in known_poses(analysis):
            raise InputError(f"start must be one of {', '.join(known_poses(analysis))}, got {start}")
        initial = shown.matrix if start is None else known_poses(analysis)[start]
        start = start or shown.name or "between"
        # The filters are those of the page, which the matches may have been computed before.
        resolved = replace(
            analysis.resolved, mutual=settings.mutual, max_ratio=settings.max_ratio, surest=settings.surest
        )

        def work(job: Job) -> None:
            began = time.perf_counter()
            from cgf.matching import empty_correspondences

            correspondences = empty_correspondences()
            if analysis.matches is not None:
                rows = pipeline.filtered_rows(analysis.matches, resolved)
                correspondences = analysis.matches.correspondences.take(rows)
            found = pipeline.register_pair(
                analysis.source, analysis.target, correspondences, resolved, wanted,
                initial=initial, progress=job.progress, cancelled=job.is_cancelled,
            )  # fmt: skip
            job.check()
            self._keep(analysis.index, wanted, start, found, time.perf_counter() - began)

        self.tasks.submit("register", f"Running {wanted.method.upper()}", work)

    def _keep(
        self, index: int, wanted: RegistrationSettings, start: str, found: RegistrationResult, elapsed_s: float
    ) -> None:
        self._count += 1
        run = Run(self._count, wanted, start if wanted.method == "icp" else None, found, elapsed_s)
        chosen = self._chosen.get(index)
        runs = (*self._runs.get(index, ()), run)
        while len(runs) > MAX_RUNS:
            # The one that errors are measured against stays.
            oldest = next(kept for kept in runs if kept is not chosen)
            runs = tuple(kept for kept in runs if kept is not oldest)
        self._runs[index] = runs
        self._host.renewed()

    def choose_estimate(self, name: str) -> None:
        """Let the pose of that name be the estimate, which errors can be measured against.

        Args:
            name: Of a run that found a pose, or `automatic` for the one that nobody asked for.

        Raises:
            InputError: There is no such run, or it found nothing.
        """
        analysis, _, _, _ = self._host.shown()
        runs = () if analysis is None else analysis.runs
        run = next((run for run in runs if run.name == name and run.result.target_from_source is not None), None)
        if analysis is None or (run is None and name != "automatic"):
            raise InputError(f"The estimate must be automatic or a run that found a pose, got {name}")
        self._chosen[analysis.index] = run
        self._host.renewed()

    # ------------------------------------------------------------------ plots

    def plots(self) -> Plots:
        """What the plots draw.

        Raises:
            InputError: There are no matches yet.
        """
        analysis, scores, settings, revision = self._host.shown()
        if analysis is None or scores is None:
            raise InputError("There are no matches yet; wait until they are computed.")
        return make_plots(revision, analysis, scores, settings, self._analyst)

    def sweep(self, name: SweepName) -> None:
        """Compute the precision over dimension or radius in the background, value by value."""
        text = "Precision over dimension" if name == "dim" else "Precision over radius"
        self._repeat(
            name, text, lambda analysis, settings, job: run_sweep(name, analysis, settings, self._analyst, job)
        )

    # ------------------------------------------------------------------ comparison

    def compare(self) -> None:
        """Compute the columns that the settings ask for, in the background, one after another."""
        _, _, settings, _ = self._host.shown()
        if settings.columns:
            self._repeat("compare", "Comparing", self._comparison.run)
        elif self.tasks.is_running("compare"):
            self.tasks.cancel("compare")

    def columns(self, analysis: Analysis, settings: ViewSettings) -> tuple[ComparedColumn, ...]:
        """The columns to draw."""
        return self._comparison.columns(analysis, settings)

    def _repeat(
        self, kind: SweepName | Literal["compare"], text: str, step: Callable[[Analysis, ViewSettings, Job], bool]
    ) -> None:
        """Take steps, of which each shows its result, until none is left or another pair is opened."""
        opened, _, _, _ = self._host.shown()

        def work(job: Job) -> None:
            while True:
                # The main work comes first: two at a time would both be slow.
                while not self._host.wait_for_main_work(WAIT_S):
                    job.check()
                analysis, _, settings, _ = self._host.shown()
                if analysis is None or opened is None or analysis.index != opened.index:
                    return
                if not step(analysis, settings, job):
                    return
                job.check()
                self._host.renewed()

        self.tasks.submit(kind, text, work)

"""Work beside the main one, asked for by a panel: one worker a kind, each told of and stopped by itself."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from app.jobs import Job, Work, Worker

TaskKind = Literal["diagnose", "register", "dim", "radius", "compare"]


@dataclass(frozen=True)
class Task:
    """Work that is under way."""

    kind: TaskKind
    text: str
    progress: float
    """Share done, from 0 to 1."""


class Tasks:
    """Runs tasks in threads of their own; the latest of a kind takes the place of the one before."""

    def __init__(
        self, *, on_progress: Callable[[], None], on_error: Callable[[Exception], None], on_idle: Callable[[], None]
    ) -> None:
        """No thread is started before there is something to do.

        Args:
            on_progress: Called when `running` has changed.
            on_error: Called with what a task raised.
            on_idle: Called when a kind has nothing left to do.
        """
        self._on_progress = on_progress
        self._on_error = on_error
        self._on_idle = on_idle
        self._lock = threading.Lock()
        self._workers: dict[TaskKind, Worker] = {}
        self._running: dict[TaskKind, Task] = {}
        self._closed = False

    def submit(self, kind: TaskKind, text: str, work: Work) -> None:
        """Run `work`, which `text` describes until it says more itself."""
        with self._lock:
            if self._closed:
                return
            if kind not in self._workers:
                self._workers[kind] = Worker(
                    on_progress=lambda share, text: self._progress(kind, share, text),
                    on_idle=lambda: self._idle(kind),
                    on_error=self._on_error,
                )
            self._running[kind] = Task(kind, text, 0.0)
            worker = self._workers[kind]

        def run(job: Job) -> None:
            # The one before may have been told idle since.
            job.progress(0.0, text)
            work(job)

        worker.submit(run)

    def running(self) -> tuple[Task, ...]:
        """What is under way."""
        with self._lock:
            return tuple(self._running.values())

    def is_running(self, kind: TaskKind) -> bool:
        """Whether there is work of that kind under way."""
        with self._lock:
            return kind in self._running

    def cancel(self, kind: TaskKind) -> None:
        """Stop the work of that kind, if there is any."""
        with self._lock:
            worker = self._workers.get(kind)
            self._running.pop(kind, None)
        if worker is not None:
            worker.cancel()
        self._on_idle()

    def wait_until_idle(self, timeout_s: float | None = None) -> bool:
        """Wait for all tasks to end; tells whether they did."""
        with self._lock:
            workers = tuple(self._workers.values())
        return all(worker.wait_until_idle(timeout_s) for worker in workers)

    def close(self) -> None:
        """Cancel everything and take no more tasks; does not wait."""
        with self._lock:
            self._closed = True
            workers = tuple(self._workers.values())
        for worker in workers:
            worker.close()

    def _progress(self, kind: TaskKind, share: float, text: str) -> None:
        with self._lock:
            self._running[kind] = Task(kind, text, share)
        self._on_progress()

    def _idle(self, kind: TaskKind) -> None:
        with self._lock:
            self._running.pop(kind, None)
        self._on_idle()

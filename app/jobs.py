"""One worker for everything that takes long: the latest request wins and the one before it is told to stop."""

import threading
from collections.abc import Callable

from cgf.types import Cancelled

_WORTH_TELLING = 0.02
"""Smallest step of progress; whoever listens takes the interpreter from the threads that compute."""


class Job:
    """One request, as the code that works on it sees it."""

    def __init__(self, on_progress: Callable[[float, str], None]) -> None:
        self._cancelled = threading.Event()
        self._on_progress = on_progress
        self._told = ("", -1.0)

    def cancel(self) -> None:
        """Ask the work to stop at its next chance."""
        self._cancelled.set()

    def is_cancelled(self) -> bool:
        """Whether nobody wants the result any more."""
        return self._cancelled.is_set()

    def check(self) -> None:
        """Stop here if nobody wants the result any more.

        Raises:
            Cancelled: A later request has taken this one's place.
        """
        if self._cancelled.is_set():
            raise Cancelled

    def pause(self, seconds: float) -> None:
        """Wait, but not for longer than somebody wants the result.

        Raises:
            Cancelled: A later request has taken this one's place.
        """
        if self._cancelled.wait(seconds):
            raise Cancelled

    def progress(self, share: float, text: str) -> None:
        """Tell how far the work is, if that is worth telling; stops it if nobody wants the result any more."""
        self.check()
        share = min(max(share, 0.0), 1.0)
        text_before, share_before = self._told
        if text != text_before or abs(share - share_before) >= _WORTH_TELLING:
            self._told = (text, share)
            self._on_progress(share, text)

    def part(self, start: float, end: float, text: str | None = None) -> "Job":
        """This job for a piece of its work, from share `start` to `end`, which says `text` or what it says itself."""
        piece = Job(
            lambda share, said: self._on_progress(start + (end - start) * share, said if text is None else text)
        )
        piece._cancelled = self._cancelled
        return piece


Work = Callable[[Job], None]


class Worker:
    """Runs one job at a time in a thread of its own, which never keeps the program from ending."""

    def __init__(
        self,
        *,
        on_progress: Callable[[float, str], None],
        on_idle: Callable[[], None],
        on_error: Callable[[Exception], None],
    ) -> None:
        self._on_progress = on_progress
        self._on_idle = on_idle
        self._on_error = on_error
        self._changed = threading.Condition()
        self._waiting: Work | None = None
        self._running: Job | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._loop, name="cgf-worker", daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """Whether a job runs or waits."""
        with self._changed:
            return self._running is not None or self._waiting is not None

    def submit(self, work: Work) -> None:
        """Run `work` as soon as the running job has stopped; one that still waited is forgotten."""
        with self._changed:
            self._waiting = work
            if self._running is not None:
                self._running.cancel()
            self._changed.notify_all()

    def cancel(self) -> None:
        """Stop the running job and forget the waiting one."""
        with self._changed:
            self._waiting = None
            if self._running is not None:
                self._running.cancel()

    def wait_until_idle(self, timeout_s: float | None = None) -> bool:
        """Wait for the last job to end; tells whether it did."""
        with self._changed:
            return self._changed.wait_for(lambda: self._running is None and self._waiting is None, timeout_s)

    def close(self) -> None:
        """Cancel everything and take no more work; does not wait."""
        with self._changed:
            self._closed = True
        self.cancel()
        with self._changed:
            self._changed.notify_all()

    def _loop(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting is not None)
                if self._closed:
                    return
                work, self._waiting = self._waiting, None
                job = self._running = Job(self._on_progress)
            assert work is not None
            try:
                work(job)
            except Cancelled:
                pass
            except Exception as error:  # noqa: BLE001 - the edge of the worker: shown on the page, the worker lives on
                if not job.is_cancelled():
                    self._on_error(error)
            with self._changed:
                self._running = None
                idle = self._waiting is None
            if idle:
                self._on_idle()
            with self._changed:
                self._changed.notify_all()

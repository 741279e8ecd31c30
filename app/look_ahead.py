"""Work that nobody has asked for yet, so that the next change is only drawn."""

from typing import Protocol

from app.analysis import Analysis, Analyst
from app.jobs import Job, Worker
from app.plots import run_sweep
from app.settings import ViewSettings
from app.workbench import WAIT_S


class Host(Protocol):
    """The session, as far as it matters here."""

    def wait_until_idle(self, timeout_s: float | None = None) -> bool:
        """Wait until nothing is left to do; tells whether that came true."""


class LookAhead:
    """Loads kernels and matches in all dimensions, while nothing else is to be done."""

    def __init__(self, host: Host, analyst: Analyst, *, patience_s: float) -> None:
        """Nothing is done before `look`.

        Args:
            host: Its work goes first.
            analyst: Does the work and keeps the results.
            patience_s: Left to a browser that paints what has changed.
        """
        self._host = host
        self._analyst = analyst
        self._patience_s = patience_s
        # What fails here will fail, and be told of, when it is asked for.
        self._worker = Worker(on_progress=lambda *_: None, on_idle=lambda: None, on_error=lambda _: None)

    def look(self, analysis: Analysis, settings: ViewSettings) -> None:
        """Look ahead from what is shown."""

        def work(job: Job) -> None:
            job.pause(self._patience_s)
            while not self._host.wait_until_idle(WAIT_S):
                job.check()
            self._analyst.load_kernels(analysis)
            while run_sweep("dim", analysis, settings, self._analyst, job):
                pass

        self._worker.submit(work)

    def cancel(self) -> None:
        """Leave it, since something has changed."""
        self._worker.cancel()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until everything is known; tells whether that came true."""
        return self._worker.wait_until_idle(timeout_s)

    def close(self) -> None:
        """Stop working; does not wait."""
        self._worker.close()

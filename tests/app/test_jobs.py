import threading

import pytest

from app.jobs import Job, Worker
from cgf.types import Cancelled

LONG_S = 10.0


class Recorder:
    def __init__(self) -> None:
        self.progress: list[tuple[float, str]] = []
        self.errors: list[Exception] = []
        self.idle = 0
        self.worker = Worker(
            on_progress=lambda share, text: self.progress.append((share, text)),
            on_idle=self._count_idle,
            on_error=self.errors.append,
        )

    def _count_idle(self) -> None:
        self.idle += 1


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


def test_a_job_runs_and_reports_its_progress(recorder: Recorder) -> None:
    recorder.worker.submit(lambda job: job.progress(0.5, "half"))
    assert recorder.worker.wait_until_idle(LONG_S)
    assert recorder.progress == [(0.5, "half")]
    assert recorder.idle == 1


def test_the_latest_request_wins_and_the_one_before_is_cancelled(recorder: Recorder) -> None:
    started, cancelled, done = threading.Event(), threading.Event(), []

    def endless(job: Job) -> None:
        started.set()
        while not job.is_cancelled():
            pass
        cancelled.set()
        job.check()
        done.append("never")

    recorder.worker.submit(endless)
    assert started.wait(LONG_S)
    recorder.worker.submit(lambda _: done.append("skipped"))
    recorder.worker.submit(lambda _: done.append("last"))
    assert recorder.worker.wait_until_idle(LONG_S)
    assert cancelled.is_set()
    assert done == ["last"]
    assert not recorder.errors


def test_progress_stops_a_job_that_nobody_wants(recorder: Recorder) -> None:
    started = threading.Event()
    stopped: list[bool] = []

    def work(job: Job) -> None:
        started.set()
        try:
            while True:
                job.progress(0.1, "on and on")
        except Cancelled:
            stopped.append(True)
            raise

    recorder.worker.submit(work)
    assert started.wait(LONG_S)
    recorder.worker.cancel()
    assert recorder.worker.wait_until_idle(LONG_S)
    assert stopped == [True]


def test_an_error_is_reported_and_the_worker_lives_on(recorder: Recorder) -> None:
    def fail(_: Job) -> None:
        raise ValueError("voxel_size must be positive, got -1")

    done: list[int] = []
    recorder.worker.submit(fail)
    assert recorder.worker.wait_until_idle(LONG_S)
    recorder.worker.submit(lambda _: done.append(1))
    assert recorder.worker.wait_until_idle(LONG_S)
    assert [str(error) for error in recorder.errors] == ["voxel_size must be positive, got -1"]
    assert done == [1]


def test_a_closed_worker_ends_its_thread(recorder: Recorder) -> None:
    thread = next(thread for thread in threading.enumerate() if thread is recorder.worker._thread)
    recorder.worker.close()
    thread.join(LONG_S)
    assert not thread.is_alive()


def test_progress_is_kept_between_0_and_1(recorder: Recorder) -> None:
    recorder.worker.submit(lambda job: job.progress(1.7, "over"))
    assert recorder.worker.wait_until_idle(LONG_S)
    assert recorder.progress == [(1.0, "over")]


def test_a_pause_ends_early_where_nobody_wants_the_result_any_more(recorder: Recorder) -> None:
    started, outcomes = threading.Event(), []

    def work(job: Job) -> None:
        started.set()
        try:
            job.pause(LONG_S)
        except Cancelled:
            outcomes.append("cancelled")
            raise

    recorder.worker.submit(work)
    assert started.wait(LONG_S)
    recorder.worker.cancel()
    assert recorder.worker.wait_until_idle(LONG_S / 2)
    assert outcomes == ["cancelled"]

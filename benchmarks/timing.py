"""Timings, and work in processes of its own, whose threads are counted and whose memory is measured."""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
_THREADS = ("CGF_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Timing:
    """Seconds of some runs of the same work, each divided by how much of it there was."""

    cpu: tuple[float, ...]
    """Of the processor, over all threads: hardly changed by what else the machine does."""
    wall: tuple[float, ...]
    """By the clock."""

    @property
    def best(self) -> float:
        return min(self.cpu)

    @property
    def median(self) -> float:
        return median(self.cpu)

    def per(self, count: float) -> "Timing":
        return Timing(tuple(value / count for value in self.cpu), tuple(value / count for value in self.wall))


def measure(work: Callable[[], object], repeats: int) -> Timing:
    """Do the work once to warm up, then time it."""
    work()
    return measure_cold(work, repeats)


def measure_cold(work: Callable[[], object], repeats: int) -> Timing:
    cpu, wall = [], []
    for _ in range(repeats):
        start, start_cpu = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - start_cpu)
    return Timing(tuple(cpu), tuple(wall))


def peak_bytes() -> int:
    """The most memory that this process has had resident."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def run_alone(case: str, *, threads: int, **options: object) -> dict[str, Any]:
    """What `cases.CASES[case]` returns, in a fresh process of so many threads.

    A library that is not installed gives `{"absent": what Python says of it}`.

    Raises:
        RuntimeError: The process fails.
    """
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, **dict.fromkeys(_THREADS, str(threads)), "PYTHONPATH": path}
    command = [sys.executable, "-m", "benchmarks.cases", case]
    request = json.dumps(options, default=str)
    done = subprocess.run(command, input=request, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"benchmark {case} failed:\n{done.stderr}")
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def timing_of(result: dict[str, Any], key: str) -> Timing:
    """A timing that has come from another process."""
    return Timing(tuple(result[key]["cpu"]), tuple(result[key]["wall"]))

"""Loops that release the interpreter lock, spread over threads."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

_inside = threading.local()
_SHORT_BLOCKS, _SHORTER = 4, 4
"""So many blocks at the end are cut into so many parts each."""


def thread_count() -> int:
    """Threads that compute at a time: `CGF_THREADS`, or else the processors this process may use."""
    wanted = os.environ.get("CGF_THREADS", "")
    if wanted.isdigit():
        return max(int(wanted), 1)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def for_each_block(
    function: Callable[[slice], None], count: int, *, block: int, finished: Callable[[int], None] | None = None
) -> None:
    """Call `function` on consecutive slices of `range(count)`, in as many threads as there are processors.

    Slices are the same whatever the number of threads, so results written per slice do not depend on it. A loop within
    such a loop runs in its caller's thread.

    Args:
        function: Is given the slice; what it raises is raised here, after the slices under way.
        count: End of the range.
        block: Length of the slices but the last ones, which are shorter, so that no thread waits long for another.
        finished: Told, in this thread, how much of the range is done.
    """
    blocks = _slices(count, block)
    threads = min(thread_count(), len(blocks))
    if threads < 2 or getattr(_inside, "loop", False):
        for item in blocks:
            function(item)
            if finished is not None:
                finished(item.stop)
        return
    with ThreadPoolExecutor(threads, initializer=_enter) as pool:
        futures = [pool.submit(function, item) for item in blocks]
        try:
            for item, future in zip(blocks, futures, strict=True):
                future.result()
                if finished is not None:
                    finished(item.stop)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _slices(count: int, block: int) -> list[slice]:
    whole = max(count // block - _SHORT_BLOCKS, 0) * block
    starts = [*range(0, whole, block), *range(whole, count, max(block // _SHORTER, 1)), count]
    return [slice(start, stop) for start, stop in pairwise(starts)]


def _enter() -> None:
    _inside.loop = True

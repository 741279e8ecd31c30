"""Compiled loops that release the interpreter lock, spread over threads."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def thread_count() -> int:
    """Threads that compute at a time: `CGF_THREADS`, or else the processors this process may use."""
    wanted = os.environ.get("CGF_THREADS", "")
    return max(int(wanted), 1) if wanted.isdigit() else len(os.sched_getaffinity(0))


def for_each_block(function: Callable[[slice], None], count: int, *, block: int) -> None:
    """Call `function` on consecutive slices of `range(count)`, in as many threads as there are processors.

    Slices are `block` long whatever the number of threads, so results written per slice do not depend on it.
    """
    blocks = [slice(start, min(start + block, count)) for start in range(0, count, block)]
    if len(blocks) < 2 or thread_count() == 1:
        for item in blocks:
            function(item)
        return
    with ThreadPoolExecutor(thread_count()) as pool:
        for _ in pool.map(function, blocks):
            pass

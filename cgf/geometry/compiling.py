"""Telling when Numba compiles, which takes seconds the first time and none after that."""

import contextlib
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def told_of_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` whenever a kernel begins to be compiled while the block runs, in the thread that waits for it.

    A kernel that is read from Numba's own cache on disk is not compiled.
    """
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: object) -> None:  # noqa: ARG002 - which kernel it is does not matter
            tell()

        def on_end(self, event: object) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield

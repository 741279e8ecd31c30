import threading

import numpy as np
import pytest

from cgf.geometry.parallel import for_each_block


def slices_of(count, block):
    seen, lock = [], threading.Lock()

    def note(part):
        with lock:
            seen.append((part.start, part.stop))

    for_each_block(note, count, block=block)
    return sorted(seen)


@pytest.mark.parametrize(("count", "block"), [(0, 8), (1, 1), (5, 1), (7, 8), (8, 8), (33, 8), (1000, 64), (1001, 3)])
def test_every_number_is_in_one_slice_whatever_the_number_of_threads(count, block, monkeypatch):
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("CGF_THREADS", threads)
        found.append(slices_of(count, block))
    assert found[0] == found[1] == found[2]
    assert [k for start, stop in found[0] for k in range(start, stop)] == list(range(count))


def test_slices_are_as_long_as_asked_for_but_the_last_ones():
    lengths = np.diff(slices_of(1000, 64)).ravel()
    assert (lengths[:11] == 64).all()
    assert (lengths[11:-1] == 16).all()
    assert 0 < lengths[-1] <= 16


@pytest.mark.parametrize("threads", ["1", "3"])
def test_what_a_slice_raises_is_raised_and_the_rest_is_left(threads, monkeypatch):
    monkeypatch.setenv("CGF_THREADS", threads)
    done = []

    def fail(part):
        raise OSError(f"no block {part.start}")

    with pytest.raises(OSError, match="no block 0"):
        for_each_block(fail, 100, block=10, finished=done.append)
    assert done == []


@pytest.mark.parametrize("threads", ["1", "2"])
def test_what_is_done_is_told_in_order(threads, monkeypatch):
    monkeypatch.setenv("CGF_THREADS", threads)
    done = []
    for_each_block(lambda _: None, 100, block=10, finished=done.append)
    assert done == sorted(done)
    assert done[-1] == 100

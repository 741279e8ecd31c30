import numpy as np
import pytest

from cgf.diagnosis.consensus import find_consensus, motion_difference
from cgf.diagnosis.measures import scale_of
from cgf.diagnosis.surfaces import stability
from cgf.geometry import transforms
from cgf.types import Cancelled

MOTION = transforms.rigid(transforms.rotation_about([1, 2, -1], 0.8), [0.5, -1.0, 2.0])
OTHER = transforms.rigid(transforms.rotation_about([0, 1, 1], -1.1), [-0.5, 1.0, 0.0])


def matches(counts: list[int], outliers: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Matches that agree with `MOTION`, with `OTHER`, and with none."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(-1, 1, (sum(counts) + outliers, 3))
    target = rng.uniform(-1, 1, source.shape)
    start = 0
    for count, motion in zip(counts, (MOTION, OTHER), strict=False):
        rows = slice(start, start + count)
        target[rows] = transforms.apply(motion, source[rows]) + rng.normal(scale=0.005, size=(count, 3))
        start += count
    return source, target


def test_few_right_matches_among_many_are_found() -> None:
    source, target = matches([25], 475)
    (found, *others) = find_consensus(source, target, distance=0.03)
    assert len(np.intersect1d(found.rows, np.arange(25))) >= 23
    assert motion_difference(found.target_from_source, MOTION, source) < 0.03
    assert all(len(other.rows) < 12 for other in others)


def test_a_second_motion_is_another_one() -> None:
    source, target = matches([60, 40], 200)
    first, second = find_consensus(source, target, distance=0.03)
    assert motion_difference(first.target_from_source, MOTION, source) < 0.03
    assert motion_difference(second.target_from_source, OTHER, source) < 0.03


def test_one_motion_is_not_found_twice() -> None:
    source, target = matches([300], 0)
    assert len(find_consensus(source, target, distance=0.03)) == 1


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_is_found_among_too_few_matches(count: int) -> None:
    source, target = matches([count], 0)
    assert find_consensus(source, target, distance=0.03) == []


def test_the_search_can_be_given_up() -> None:
    with pytest.raises(Cancelled):
        find_consensus(*matches([60], 40), distance=0.03, cancelled=lambda: True)


@pytest.mark.parametrize("scale", [1.0, 0.8, 1.2])
def test_the_scale_is_read_off_distances_between_matches(scale: float) -> None:
    source, target = matches([100], 100)
    found, gain = scale_of(source / scale, target, shortest=0.2)
    assert found == pytest.approx(scale, rel=0.005)
    assert (gain > 2) == (scale != 1)


def test_no_scale_is_read_off_chance() -> None:
    source, target = matches([], 200)
    assert scale_of(source, target, shortest=0.2) == (1.0, 1.0)


def test_a_corner_is_stable_and_a_plane_slides() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (900, 2)), np.zeros(900)])
    normals = np.tile([0.0, 0.0, 1.0], (900, 1))
    turns = [transforms.rotation_about(axis, np.pi / 2) for axis in ([1, 0, 0], [0, 1, 0])]
    corner = np.concatenate([flat + 1, *((flat + 1) @ turn.T for turn in turns)])
    directions = np.concatenate([normals, *(normals @ turn.T for turn in turns)])
    assert stability(flat, normals) < 1e-12
    assert stability(corner, directions) > 0.05

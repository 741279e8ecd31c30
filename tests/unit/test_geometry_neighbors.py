import numpy as np
import pytest

from cgf.geometry import neighbors
from cgf.geometry.neighbors import median_spacing, nearest, overlap_mask


def lattice(side, step):
    return np.stack(np.mgrid[0:side, 0:side, 0:2], axis=-1).reshape(-1, 3) * step


def test_spacing_of_a_lattice_is_its_step():
    assert median_spacing(lattice(10, 0.25)) == 0.25


def test_spacing_of_a_large_cloud_asks_only_some_points():
    np.testing.assert_allclose(median_spacing(lattice(80, 0.5)), 0.5)


def test_spacing_to_a_later_neighbour():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert median_spacing(points, neighbor=2) == 3
    # Of fewer points than that, the farthest.
    assert median_spacing(points, neighbor=9) == 3
    # A square grid has four neighbours at its step, and evenly spread points have their fourth about as far.
    flat = lattice(60, 0.25) * [1, 1, 0]
    assert median_spacing(np.unique(flat, axis=0), neighbor=4) == 0.25
    spread = np.random.default_rng(1).uniform(0, 15, size=(3_600, 3)) * [1, 1, 0]
    assert 0.25 < median_spacing(spread, neighbor=4) < 0.3


@pytest.mark.parametrize("flat", [0, 1], ids=["surface", "volume"])
def test_spacing_of_a_huge_cloud_asks_only_some_places(flat, monkeypatch):
    points = np.random.default_rng(5).uniform(0, 40, size=(200_000, 3)) * [1, 1, flat]
    exact = median_spacing(points)
    monkeypatch.setattr(neighbors, "_SPACING_LARGE", 100_000)
    np.testing.assert_allclose(median_spacing(points), exact, rtol=0.05)


def test_spacing_of_a_huge_cloud_of_one_point_is_zero(monkeypatch):
    monkeypatch.setattr(neighbors, "_SPACING_LARGE", 3)
    assert median_spacing(np.ones((7, 3))) == 0


def test_spacing_counts_repeated_points_once():
    assert median_spacing(np.repeat(lattice(5, 0.25), 3, axis=0)) == 0.25


def test_spacing_of_too_few_distinct_points_is_zero():
    assert median_spacing(np.zeros((0, 3))) == 0
    assert median_spacing(np.ones((7, 3))) == 0


def test_nothing_can_be_nearest_among_no_points():
    with pytest.raises(ValueError, match=r"^points must have 1 point or more, got 0$"):
        nearest(np.zeros((0, 3)), np.zeros((2, 3)))


def test_no_queries_have_no_neighbours():
    rows, distances = nearest(np.zeros((2, 3)), np.zeros((0, 3)))
    assert rows.shape == distances.shape == (0,)


def test_overlap_includes_points_at_exactly_tau():
    source = np.array([[0.0, 0, 0], [0, 0, 0.25], [0, 0, 0.5]])
    np.testing.assert_array_equal(overlap_mask(source, np.zeros((1, 3)), 0.25), [True, True, False])


def test_nothing_overlaps_an_empty_cloud():
    assert not overlap_mask(np.zeros((4, 3)), np.zeros((0, 3)), 1.0).any()
    with pytest.raises(ValueError, match=r"^tau must be positive, got 0$"):
        overlap_mask(np.zeros((4, 3)), np.zeros((4, 3)), 0.0)

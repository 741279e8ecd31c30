import numpy as np
import pytest

from cgf.geometry.neighbors import build_tree
from cgf.geometry.normals import estimate_normals, orient
from cgf.types import PointCloud


@pytest.fixture
def sphere():
    directions = np.random.default_rng(8).normal(size=(3000, 3))
    return PointCloud(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def test_normals_of_a_sphere_point_to_its_middle_when_seen_from_there(sphere):
    found = estimate_normals(sphere, radius=0.15)
    assert np.einsum("ij,ij->i", found.normals, -sphere.points).min() > 0.97
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, rtol=1e-12)


def test_normals_follow_a_given_viewpoint_which_the_cloud_then_has(sphere):
    above = np.array([0.0, 0, 50])
    found = estimate_normals(sphere, radius=0.15, viewpoint=above)
    assert (np.einsum("ij,ij->i", found.normals, above - sphere.points) >= 0).all()
    np.testing.assert_array_equal(found.viewpoint, above)


@pytest.mark.parametrize("max_neighbors", [None, 12])
def test_normals_are_those_of_the_plane_through_the_neighbours(sphere, max_neighbors):
    found = estimate_normals(sphere, radius=0.2, max_neighbors=max_neighbors)
    tree = build_tree(sphere.points)
    for row in range(0, 3000, 500):
        near = tree.query_ball_point(sphere.points[row], 0.2)
        near = sorted(near, key=lambda other: np.linalg.norm(sphere.points[other] - sphere.points[row]))
        chosen = sphere.points[near[:max_neighbors]]
        plane = np.linalg.svd(chosen - chosen.mean(axis=0))[2][2]
        assert abs(plane @ found.normals[row]) > 1 - 1e-9


def test_lonely_points_take_their_ten_nearest():
    flat = np.stack([*np.mgrid[0:10, 0:10].reshape(2, -1), np.zeros(100)], axis=1)
    found = estimate_normals(PointCloud(flat, viewpoint=np.array([0.0, 0, 9])), radius=0.1)
    np.testing.assert_allclose(found.normals, np.tile([0.0, 0, 1], (100, 1)), atol=1e-12)


def test_normals_survive_map_coordinates(sphere):
    far = np.array([500_000.0, 5_000_000.0, 300.0])
    here = estimate_normals(sphere, radius=0.15)
    there = estimate_normals(PointCloud(sphere.points + far, viewpoint=far), radius=0.15)
    np.testing.assert_allclose(there.normals, here.normals, atol=1e-5)


def test_clouds_too_large_for_one_piece_give_the_same_normals(sphere, monkeypatch):
    whole = estimate_normals(sphere, radius=0.15)
    monkeypatch.setattr("cgf.geometry.normals._ENTRIES_PER_CHUNK", 1000)
    np.testing.assert_allclose(estimate_normals(sphere, radius=0.15).normals, whole.normals, atol=1e-9)


def test_orienting_turns_only_what_points_away(sphere):
    outward = PointCloud(sphere.points, normals=sphere.points)
    seen = orient(outward, np.array([0.0, 0, 50]))
    upper = sphere.points[:, 2] > 0.05
    np.testing.assert_array_equal(seen.normals[upper], sphere.points[upper])
    lower = sphere.points[:, 2] < -0.05
    np.testing.assert_array_equal(seen.normals[lower], -sphere.points[lower])
    np.testing.assert_array_equal(outward.normals, sphere.points)


def test_settings_that_give_no_normals_are_refused(sphere):
    with pytest.raises(ValueError, match=r"^radius must be positive, got 0$"):
        estimate_normals(sphere, radius=0.0)
    with pytest.raises(ValueError, match=r"^max_neighbors must be 3 or more, got 2$"):
        estimate_normals(sphere, radius=0.1, max_neighbors=2)
    with pytest.raises(ValueError, match=r"^cloud must have 3 points or more, got 2$"):
        estimate_normals(sphere.take(np.array([0, 1])), radius=0.1)
    with pytest.raises(ValueError, match=r"^cloud must have normals, got none; estimate them first$"):
        orient(sphere)

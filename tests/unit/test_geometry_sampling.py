import numpy as np
import pytest

from cgf.geometry import sampling
from cgf.geometry.sampling import bounds, voxel_downsample, voxel_rows
from cgf.types import PointCloud


def test_points_of_a_voxel_become_their_centroid_with_mean_normal_and_colour():
    cloud = PointCloud(
        points=np.array([[1.2, 0.1, 0.1], [0.1, 0.1, 0.1], [0.3, 0.3, 0.1]]),
        normals=np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
        colors=np.array([[9, 9, 9], [10, 0, 255], [21, 0, 255]], dtype=np.uint8),
        name="three",
        viewpoint=np.ones(3),
    )
    reduced = voxel_downsample(cloud, 1.0)
    np.testing.assert_allclose(reduced.points, [[0.2, 0.2, 0.1], [1.2, 0.1, 0.1]])
    np.testing.assert_allclose(reduced.normals, [[0, np.sqrt(0.5), np.sqrt(0.5)], [1, 0, 0]])
    np.testing.assert_array_equal(reduced.colors, [[16, 0, 255], [9, 9, 9]])
    assert reduced.name == "three"
    np.testing.assert_array_equal(reduced.viewpoint, np.ones(3))


def test_voxels_lie_at_multiples_of_their_size_on_both_sides_of_the_origin():
    points = np.array([[-0.1, 0, 0], [0.1, 0, 0], [0.9, 0, 0]])
    np.testing.assert_allclose(voxel_downsample(PointCloud(points), 1.0).points, [[-0.1, 0, 0], [0.5, 0, 0]])


def test_normals_that_cancel_take_the_one_nearest_to_the_centroid():
    points = np.array([[0.1, 0.1, 0.1], [0.4, 0.1, 0.1], [0.2, 0.1, 0.1], [0.3, 0.1, 0.1]])
    normals = np.array([[0.0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]])
    # The centroid lies at 0.25, with 0.2 and 0.3 equally near but for rounding.
    reduced = voxel_downsample(PointCloud(points, normals=normals), 1.0)
    assert abs(reduced.normals[0, 1]) == 1


def test_precision_survives_map_coordinates():
    rng = np.random.default_rng(7)
    points = rng.uniform(0, 3, size=(500, 3))
    far = np.array([500_000.0, 5_000_000.0, 300.0])
    here = voxel_downsample(PointCloud(points), 0.25)
    there = voxel_downsample(PointCloud(points + far), 0.25)
    np.testing.assert_allclose(there.points - far, here.points, atol=2e-9)


@pytest.mark.parametrize("block", [1, 7, 1 << 17])
def test_centroids_are_the_same_to_the_last_bit_in_any_order_and_in_any_blocks(block, monkeypatch):
    rng = np.random.default_rng(3)
    points, normals = rng.normal(size=(400, 3)), rng.normal(size=(400, 3))
    order = rng.permutation(400)
    whole = voxel_downsample(PointCloud(points, normals=normals), 0.8)
    monkeypatch.setattr(sampling, "_BLOCK", block)
    shuffled = voxel_downsample(PointCloud(points[order], normals=normals[order]), 0.8)
    np.testing.assert_array_equal(shuffled.points, whole.points)
    np.testing.assert_array_equal(shuffled.normals, whole.normals)


def test_a_point_alone_in_its_voxel_stays_where_it_is():
    points = np.random.default_rng(3).uniform(0, 1, size=(20, 3))
    reduced = voxel_downsample(PointCloud(points), 1e-3)
    np.testing.assert_array_equal(reduced.points, points[np.lexsort(np.floor(points / 1e-3).T[::-1])])


def test_more_voxels_than_an_integer_can_number_are_told_apart():
    points = np.array([[1e5, 1e5, 1e5], [-1e5, 0, 0], [1e5, 1e5, 1e5 + 4e-4], [-1e5, 0, 4e-5]])
    reduced = voxel_downsample(PointCloud(points), 1e-4)
    np.testing.assert_allclose(reduced.points, [[-1e5, 0, 2e-5], [1e5, 1e5, 1e5], [1e5, 1e5, 1e5 + 4e-4]])


def test_the_first_row_of_each_voxel():
    points = np.array([[2.5, 0, 0], [0.5, 0, 0], [2.1, 0, 0], [-0.5, 0, 0], [0.1, 0, 0]])
    np.testing.assert_array_equal(voxel_rows(points, 1.0), [0, 1, 3])
    assert voxel_rows(np.zeros((0, 3)), 1.0).shape == (0,)


def test_empty_clouds_stay_empty():
    assert len(voxel_downsample(PointCloud(np.zeros((0, 3))), 1.0)) == 0


def test_voxels_that_cannot_be_numbered_are_refused():
    cloud = PointCloud(np.full((1, 3), 1e6))
    with pytest.raises(
        ValueError, match=r"^voxel_size must be 2\.22e-10 or more for coordinates up to 1e\+06, got 1e-12$"
    ):
        voxel_downsample(cloud, 1e-12)
    with pytest.raises(ValueError, match=r"^voxel_size must be positive, got -1$"):
        voxel_downsample(cloud, -1.0)


@pytest.mark.parametrize("count", [1, 63, 64, 1000])
def test_bounds_are_the_least_and_largest_coordinates(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3))
    lowest, highest = bounds(points)
    np.testing.assert_array_equal(lowest, points.min(axis=0))
    np.testing.assert_array_equal(highest, points.max(axis=0))

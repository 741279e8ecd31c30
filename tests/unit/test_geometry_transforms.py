import numpy as np
import pytest

from cgf.geometry.transforms import (
    apply,
    compose,
    invert,
    move,
    random_rigid,
    rigid,
    rotate,
    rotation_about,
    rotation_error_deg,
    rotation_of_quaternion,
    translation_error,
)
from cgf.types import PointCloud

QUARTER_ABOUT_Z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def test_quarter_turn_about_z_takes_x_to_y():
    np.testing.assert_allclose(rotation_about((0, 0, 3), np.pi / 2), QUARTER_ABOUT_Z, atol=1e-15)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(rotation_of_quaternion((half, 0, 0, half)), QUARTER_ABOUT_Z, atol=1e-15)


def test_points_are_moved_and_directions_only_turned():
    motion = rigid(QUARTER_ABOUT_Z, (10, 0, 0))
    np.testing.assert_allclose(apply(motion, np.array([[1.0, 0, 5]])), [[10, 1, 5]])
    np.testing.assert_allclose(rotate(motion, np.array([[1.0, 0, 0]])), [[0, 1, 0]])


def test_moving_a_cloud_moves_its_viewpoint():
    cloud = PointCloud(np.eye(3), normals=np.eye(3), viewpoint=np.array([1.0, 0, 0]))
    moved = move(rigid(QUARTER_ABOUT_Z, (0, 0, 2)), cloud)
    np.testing.assert_allclose(moved.viewpoint, [0, 1, 2])
    np.testing.assert_allclose(moved.points[0], [0, 1, 2])
    np.testing.assert_allclose(moved.normals[0], [0, 1, 0])
    assert move(np.eye(4), PointCloud(np.eye(3))).normals is None


def test_composing_nothing_is_the_identity():
    np.testing.assert_array_equal(compose(), np.eye(4))


def test_random_motions_are_rigid_and_repeat_with_the_seed():
    one, same = (random_rigid(np.random.default_rng(4), max_translation=2.0) for _ in range(2))
    np.testing.assert_array_equal(one, same)
    np.testing.assert_allclose(compose(one, invert(one)), np.eye(4), atol=1e-15)
    assert np.abs(one[:3, 3]).max() <= 2


def test_random_rotations_are_uniform():
    rng = np.random.default_rng(5)
    images = np.array([random_rigid(rng)[:3, 0] for _ in range(4000)])
    # The mean of uniform unit vectors has a standard deviation of 0.009 in each coordinate, of squares 0.005.
    assert np.abs(images.mean(axis=0)).max() < 0.05
    assert np.abs((images**2).mean(axis=0) - 1 / 3).max() < 0.025


def test_errors_of_a_known_difference():
    truth = random_rigid(np.random.default_rng(6))
    estimate = compose(rigid(np.eye(3), (3.0, 0, 4)), truth)
    estimate[:3, :3] = rotation_about((1, 2, 3), np.radians(1e-7)) @ truth[:3, :3]
    np.testing.assert_allclose(rotation_error_deg(estimate, truth), 1e-7, rtol=1e-6)
    np.testing.assert_allclose(translation_error(estimate, truth), 5.0, rtol=1e-12)
    assert rotation_error_deg(rigid(np.diag([1.0, -1, -1])), np.eye(4)) == 180


def test_axes_and_quaternions_without_length_are_refused():
    with pytest.raises(ValueError, match=r"^axis must be 3 numbers that are not all zero, got \[0\. 0\. 0\.\]$"):
        rotation_about((0, 0, 0), 1.0)
    with pytest.raises(ValueError, match=r"^quaternion must be 4 numbers that are not all zero, got \[1\. 0\. 0\.\]$"):
        rotation_of_quaternion((1, 0, 0))

"""Geometry turns with the cloud and does not depend on the order of its points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cgf.geometry import transforms
from cgf.geometry.neighbors import median_spacing, nearest, overlap_mask
from cgf.geometry.normals import estimate_normals
from cgf.geometry.sampling import voxel_downsample
from tests.strategies import permutations_of, rigid_motions, rotations, surfaces


@given(rigid_motions(), surfaces())
def test_inverse_takes_points_back(motion, cloud):
    moved = transforms.apply(motion, cloud.points)
    np.testing.assert_allclose(transforms.apply(transforms.invert(motion), moved), cloud.points, atol=1e-12)


@given(rigid_motions(), rigid_motions(), surfaces())
def test_compose_applies_the_right_one_first(c_from_b, b_from_a, cloud):
    chained = transforms.apply(transforms.compose(c_from_b, b_from_a), cloud.points)
    one_by_one = transforms.apply(c_from_b, transforms.apply(b_from_a, cloud.points))
    np.testing.assert_allclose(chained, one_by_one, atol=1e-12)


@given(rigid_motions(), rigid_motions(), st.floats(0, 1))
def test_interpolation_turns_at_even_speed_while_the_centre_goes_straight(start, end, share):
    center = np.array([1.0, -2.0, 0.5])
    between = transforms.interpolate(start, end, share, center)
    np.testing.assert_allclose(between[:3, :3] @ between[:3, :3].T, np.eye(3), atol=1e-12)
    first, last = (transforms.apply(motion, center[None])[0] for motion in (start, end))
    np.testing.assert_allclose(
        transforms.apply(between, center[None])[0], (1 - share) * first + share * last, atol=1e-12
    )
    whole = transforms.rotation_error_deg(start, end)
    np.testing.assert_allclose(transforms.rotation_error_deg(start, between), share * whole, atol=1e-4)
    np.testing.assert_allclose(transforms.rotation_error_deg(between, end), (1 - share) * whole, atol=1e-4)


@given(rotations())
def test_drawn_rotations_are_rotations(rotation):
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0


@given(rotations(), st.lists(st.integers(-8, 8), min_size=3, max_size=3).filter(any), st.floats(1e-9, np.pi))
def test_rotation_error_is_the_angle_between(rotation, axis, angle):
    turned = transforms.rotation_about(axis, angle) @ rotation
    error = transforms.rotation_error_deg(transforms.rigid(turned), transforms.rigid(rotation))
    # Near a half turn the chord hardly changes with the angle.
    np.testing.assert_allclose(error, np.degrees(angle), rtol=1e-6, atol=1e-6 if angle > 3.1 else 1e-13)


@given(surfaces(), rigid_motions())
def test_spacing_and_neighbours_do_not_change_under_motion(cloud, motion):
    moved = transforms.move(motion, cloud)
    np.testing.assert_allclose(median_spacing(moved.points), median_spacing(cloud.points), rtol=1e-9)
    rows, distances = nearest(moved.points, moved.points[::3])
    np.testing.assert_array_equal(rows, np.arange(len(cloud))[::3])
    np.testing.assert_array_equal(distances, 0)


@given(surfaces(), surfaces(), st.sampled_from([0.05, 0.1, 0.4]))
def test_nearest_and_overlap_agree_with_brute_force(source, target, tau):
    table = np.linalg.norm(source.points[:, None] - target.points[None], axis=2)
    rows, distances = nearest(target.points, source.points)
    np.testing.assert_allclose(distances, table.min(axis=1), rtol=1e-12)
    np.testing.assert_allclose(table[np.arange(len(source)), rows], distances, rtol=1e-12)
    clear = np.abs(table.min(axis=1) - tau) > 1e-12
    np.testing.assert_array_equal(overlap_mask(source.points, target.points, tau)[clear], (distances <= tau)[clear])


@given(surfaces(), rigid_motions(), st.sampled_from([None, 8]))
def test_normals_turn_with_the_cloud(cloud, motion, max_neighbors):
    here = estimate_normals(cloud, radius=0.6, max_neighbors=max_neighbors)
    there = estimate_normals(transforms.move(motion, cloud), radius=0.6, max_neighbors=max_neighbors)
    expected = transforms.rotate(motion, here.normals)
    agreement = np.einsum("ij,ij->i", expected, there.normals)
    # Where a neighbourhood is nearly as thick as wide its normal is not determined; the side may be open as well.
    assert np.mean(np.abs(agreement) > 1 - 1e-6) > 0.9
    side = np.einsum("ij,ij->i", here.normals, cloud.viewpoint - cloud.points)
    sure = (np.abs(agreement) > 1 - 1e-6) & (side > 1e-6)
    assert (agreement[sure] > 0).all()


@given(surfaces(), st.data())
def test_normals_do_not_depend_on_the_order_of_points(cloud, data):
    order = data.draw(permutations_of(len(cloud)))
    here = estimate_normals(cloud, radius=0.6).normals
    there = estimate_normals(cloud.take(order), radius=0.6).normals
    agreement = np.abs(np.einsum("ij,ij->i", here[order], there))
    assert np.mean(agreement > 1 - 1e-6) > 0.9


@given(surfaces(colors=True), st.data(), st.sampled_from([0.1, 0.3, 5.0]))
def test_downsampling_does_not_depend_on_the_order_of_points(cloud, data, voxel_size):
    order = data.draw(permutations_of(len(cloud)))
    here, there = voxel_downsample(cloud, voxel_size), voxel_downsample(cloud.take(order), voxel_size)
    np.testing.assert_array_equal(here.points, there.points)
    np.testing.assert_array_equal(here.normals, there.normals)
    np.testing.assert_array_equal(here.colors, there.colors)


@given(surfaces(colors=True), st.sampled_from([0.1, 0.3, 5.0]))
def test_downsampling_agrees_with_brute_force(cloud, voxel_size):
    reduced = voxel_downsample(cloud, voxel_size)
    keys = [tuple(key) for key in np.floor(cloud.points / voxel_size).astype(int)]
    distinct = sorted(set(keys))
    assert len(reduced) == len(distinct)
    for row, key in enumerate(distinct):
        members = [index for index, other in enumerate(keys) if other == key]
        np.testing.assert_allclose(reduced.points[row], cloud.points[members].mean(axis=0), atol=1e-12)
        mean = cloud.normals[members].mean(axis=0)
        np.testing.assert_allclose(reduced.normals[row], mean / np.linalg.norm(mean), atol=1e-12)
        assert np.abs(reduced.colors[row] - cloud.colors[members].mean(axis=0)).max() <= 0.5

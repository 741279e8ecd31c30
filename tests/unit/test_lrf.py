import numpy as np
import pytest

from cgf.geometry.lrf import _extreme_axes, estimate_lrf


def plane(seed=1, count=400):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.normal(0, 0.01, count)])
    return points, np.tile([0.0, 0.0, 1.0], (count, 1))


def covariance_frame(points, center, radius):
    """SHOT's axes but for their signs, straight from the definition."""
    offsets = points - center
    distances = np.linalg.norm(offsets, axis=1)
    near = (distances > 0) & (distances <= radius)
    weights = radius - distances[near]
    covariance = np.einsum("n,ni,nj->ij", weights, offsets[near], offsets[near]) / weights.sum()
    return np.linalg.eigh(covariance)[1].T[::-1]


def test_axes_are_those_of_the_weighted_covariance():
    points, normals = plane()
    rows = np.arange(50)
    frames, defined = estimate_lrf(points, normals, rows, radius=0.4, kind="paper")
    assert defined.all()
    for row, frame in zip(rows, frames, strict=True):
        expected = covariance_frame(points, points[row], 0.4)
        np.testing.assert_allclose(np.abs(np.sum(frame[[0, 2]] * expected[[0, 2]], axis=1)), 1, atol=1e-4)


@pytest.mark.parametrize("variances", [(3, 2, 1), (1, 1e-6, 1e-12), (1, 1, 0), (1, 0, 0), (2, 2, 2), (0, 0, 0)])
def test_extreme_axes_are_eigenvectors_to_rounding(variances):
    for seed in range(20):
        turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0] if seed else np.eye(3)
        covariance = turn @ np.diag(variances) @ turn.T
        values = np.linalg.eigvalsh(covariance)
        axes = np.array(_extreme_axes(tuple(covariance[np.triu_indices(3)])))
        np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-14)
        np.testing.assert_allclose(axes @ covariance, values[[0, 2], None] * axes, atol=1e-14)


def test_x_points_to_where_most_neighbours_are():
    points, normals = plane()
    frames, _ = estimate_lrf(points, normals, np.arange(100), radius=0.4, kind="paper")
    # Right-handed frames have not been negated for the normal.
    for row in np.flatnonzero(np.linalg.det(frames) > 0):
        offsets = points - points[row]
        distances = np.linalg.norm(offsets, axis=1)
        near = (distances > 0) & (distances <= 0.4)
        assert 2 * np.count_nonzero(offsets[near] @ frames[row, 0] >= 0) + 1 >= np.count_nonzero(near)


def test_normal_frames_are_right_handed_with_the_normal_as_z():
    points, normals = plane()
    frames, defined = estimate_lrf(points, normals, np.arange(400), radius=0.3, kind="normal")
    np.testing.assert_allclose(np.linalg.det(frames[defined]), 1)
    np.testing.assert_allclose(frames[defined][:, 2], normals[defined])


def test_paper_frames_are_left_handed_where_z_opposed_the_normal():
    points, normals = plane()
    up, _ = estimate_lrf(points, normals, np.arange(400), radius=0.3, kind="paper")
    down, _ = estimate_lrf(points, -normals, np.arange(400), radius=0.3, kind="paper")
    np.testing.assert_allclose(up, -down)
    np.testing.assert_allclose(np.sort(np.linalg.det(np.stack([up, down])), axis=0), [[-1] * 400, [1] * 400])


def test_fewer_than_five_neighbours_leave_no_frame():
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0.01], [0.05, 0.02, 0], [9, 9, 9]], dtype=float)
    normals = np.tile([0.0, 0.0, 1.0], (6, 1))
    frames, defined = estimate_lrf(points, normals, np.arange(6), radius=1.0)
    assert not defined.any()
    assert not frames.any()
    more = np.vstack([points, [0.02, 0.07, 0.0]])
    _, defined = estimate_lrf(more, np.tile([0.0, 0.0, 1.0], (7, 1)), np.arange(7), radius=1.0)
    assert defined.tolist() == [True] * 5 + [False, True]


def test_radius_must_be_positive():
    with pytest.raises(ValueError, match="radius must be positive, got 0"):
        estimate_lrf(*plane(), np.arange(3), radius=0.0)


def test_no_indices_give_no_frames():
    frames, defined = estimate_lrf(*plane(), np.zeros(0, dtype=np.int64), radius=0.3)
    assert frames.shape == (0, 3, 3)
    assert defined.shape == (0,)

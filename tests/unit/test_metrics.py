import math

import numpy as np
import pytest

from cgf.evaluation import metrics
from cgf.geometry import transforms

SHIFT = transforms.rigid(np.eye(3), (1.0, 0.0, 0.0))


def test_errors_are_distances_after_the_true_motion() -> None:
    source = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    target = np.array([[3.0, 0, 0], [1, 4, 0]])
    indices = np.array([[2, 0], [0, 1]])
    np.testing.assert_allclose(metrics.correspondence_errors(source, target, indices, SHIFT), [0, 4])


def test_no_correspondences_have_no_errors() -> None:
    points = np.zeros((3, 3))
    assert metrics.correspondence_errors(points, points, np.zeros((0, 2), dtype=np.int64), SHIFT).shape == (0,)


def test_a_partner_within_tau_counts_and_one_beyond_does_not() -> None:
    source = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    target = np.array([[1.5, 0, 0]])
    np.testing.assert_array_equal(metrics.has_partner(source, target, SHIFT, tau=0.5), [True, True, False])


def test_precision_counts_errors_up_to_the_threshold() -> None:
    errors = np.array([0.3, 0.1, 0.2, 0.4])
    assert metrics.precision(errors, threshold=0.2) == 0.5
    np.testing.assert_array_equal(metrics.precision_curve(errors, [0.0, 0.1, 0.35, 1.0]), [0, 0.25, 0.75, 1])


def test_precision_of_nothing_is_not_a_number() -> None:
    assert math.isnan(metrics.precision(np.zeros(0), threshold=1.0))
    assert np.isnan(metrics.precision_curve(np.zeros(0), [0.1, 0.2])).all()


def test_feature_matching_recall_counts_pairs_above_the_threshold() -> None:
    assert metrics.feature_matching_recall([0.05, 0.06, math.nan, 0.5]) == 0.5
    assert metrics.feature_matching_recall([0.05, 0.06], threshold=0.01) == 1
    assert math.isnan(metrics.feature_matching_recall([]))


def test_registration_recall_counts_pairs_below_the_threshold() -> None:
    assert metrics.registration_recall([0.1, 0.2, math.nan, 0.3]) == 0.25
    assert metrics.registration_recall([0.25], threshold=0.3) == 1
    assert math.isnan(metrics.registration_recall([]))


def information_of(points: np.ndarray) -> np.ndarray:
    """The matrix of `gt.info` for correspondences at `points` of the source's frame."""
    total = np.zeros((6, 6))
    for x, y, z in points:
        # A small rotation with quaternion vector v moves p by 2 v x p.
        jacobian = np.hstack([np.eye(3), 2 * np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])])
        total += jacobian.T @ jacobian
    return total


def test_rmse_is_that_of_the_correspondences_for_small_motions() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    truth = transforms.random_rigid(rng)
    slip = transforms.rigid(transforms.rotation_about([1, 2, 3], 1e-4), [2e-4, -1e-4, 3e-4])
    estimate = truth @ slip
    moved = transforms.apply(estimate, points) - transforms.apply(truth, points)
    expected = np.sqrt(np.square(moved).sum(axis=1).mean())
    assert metrics.registration_rmse(estimate, truth, information_of(points)) == pytest.approx(expected, rel=1e-4)


def test_rmse_of_a_shift_is_its_length_and_of_the_truth_nothing() -> None:
    information = information_of(np.random.default_rng(1).normal(size=(20, 3)))
    assert metrics.registration_rmse(SHIFT, np.eye(4), information) == pytest.approx(1)
    assert metrics.registration_rmse(SHIFT, SHIFT, information) == pytest.approx(0, abs=1e-12)


def test_rmse_of_half_a_turn_is_finite_and_symmetric() -> None:
    information = information_of(np.random.default_rng(2).normal(size=(20, 3)))
    turns = [transforms.rigid(transforms.rotation_about([0, 1, 0], angle)) for angle in (np.pi - 1e-9, 1e-9 - np.pi)]
    there, back = (metrics.registration_rmse(turn, np.eye(4), information) for turn in turns)
    assert there == pytest.approx(back)


def test_an_information_matrix_without_correspondences_is_refused() -> None:
    with pytest.raises(ValueError, match=r"information\[0, 0\] must be positive, got 0"):
        metrics.registration_rmse(SHIFT, SHIFT, np.zeros((6, 6)))

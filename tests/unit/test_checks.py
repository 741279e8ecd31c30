import numpy as np
import pytest

from cgf.checks import (
    InputError,
    check_count,
    check_finite_rows,
    check_fraction,
    check_points,
    check_positive,
    check_transform,
)
from cgf.geometry.transforms import random_rigid


@pytest.fixture
def points():
    return np.random.default_rng(1).normal(size=(20, 3))


def with_row(points, row, value):
    changed = points.copy()
    changed[row] = value
    return changed


def test_points_are_copied_as_float64(points):
    checked = check_points(points)
    assert checked is not points
    assert not np.shares_memory(checked, points)
    np.testing.assert_array_equal(checked, points)
    assert check_points(points.astype(np.float32)).dtype == np.float64
    np.testing.assert_array_equal(check_points(points.tolist()), points)


def test_points_in_a_plane_far_from_the_origin_pass():
    plane = np.stack([*np.mgrid[0:5, 0:5].reshape(2, -1) * 0.01, np.zeros(25)], axis=1)
    check_points(plane + np.array([500_000.0, 5_000_000.0, 300.0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p[:, :2], r"^cloud must have shape \(N, 3\), got \(20, 2\)$"),
        (lambda p: p.ravel(), r"^cloud must have shape \(N, 3\), got \(60,\)$"),
        (lambda p: p.astype(complex), r"^cloud must be an array of real numbers, got ndarray$"),
        (lambda _: [[1.0, 2.0], [3.0]], r"^cloud must be an array of real numbers, got list$"),
        (
            lambda p: with_row(with_row(p, 7, np.nan), 9, (0, np.inf, 0)),
            r"^cloud must be finite, got 2 of 20 rows with NaN or inf \(first at row 7\); drop them first$",
        ),
        (lambda p: p[:9], r"^cloud must have 10 points or more, got 9$"),
        (lambda p: p[:0], r"^cloud must have 10 points or more, got 0$"),
        (
            lambda p: with_row(p, 3, 1e300),
            r"^cloud must stay below 1e\+100, got 1e\+300 at row 3; the file may be damaged or in another byte order$",
        ),
        (lambda p: p * 0 + 1.5, r"^cloud must spread in space, got 20 points that are all equal to 1\.5 1\.5 1\.5$"),
        (
            lambda p: p[:, :1] * [1, 2, 3] + 7,
            r"^cloud must spread in space, got 20 points on one line, or one far from all others$",
        ),
        (
            lambda p: p[:, :1] * [0, 2, 0],
            r"^cloud must spread in space, got 20 points on one line, or one far from all others$",
        ),
    ],
)
def test_points_that_show_no_surface_are_refused(points, change, message):
    with pytest.raises(ValueError, match=message):
        check_points(change(points), "cloud")


def test_least_number_of_points_can_be_chosen(points):
    assert len(check_points(points[:2], minimum=2)) == 2
    assert len(check_points(points[:0], minimum=0)) == 0


def test_finite_rows_pass_and_others_name_the_remedy(points):
    check_finite_rows(points, "points")
    with pytest.raises(ValueError, match=r"^rows must be finite, got 1 of 20 .* row 0.; try again$"):
        check_finite_rows(with_row(points, 0, np.inf), "rows", remedy="try again")


def test_rigid_motions_pass_and_are_copied():
    motion = random_rigid(np.random.default_rng(2))
    checked = check_transform(motion)
    assert not np.shares_memory(checked, motion)
    np.testing.assert_array_equal(checked, motion)


def test_matrices_printed_with_few_digits_pass():
    check_transform(np.round(random_rigid(np.random.default_rng(3)), 4))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"^pose must have shape \(4, 4\), got \(3, 3\)$"),
        (np.full((4, 4), np.nan), r"^pose must be finite, got 4 of 4 rows with NaN or inf \(first at row 0\); give "),
        (
            np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 6, 7, 1.0]]),
            r"^pose must have the last row 0 0 0 1, got 5 6 7 1; give the matrix that acts on columns, "
            r"transposed if need be$",
        ),
        (
            np.diag([2, 2, 2, 1.0]),
            r"^pose must be rigid, got a 3x3 part that deviates from "
            r"a rotation by 3 \(scale 2\); remove scale and shear$",
        ),
        (
            np.array([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
            r"^pose must be rigid, got a 3x3 part that deviates from "
            r"a rotation by 0\.5 \(scale 1\); remove scale and shear$",
        ),
        (
            np.diag([1, 1, -1, 1.0]),
            r"^pose must be a rotation and a translation, got a reflection; flip the sign of one axis$",
        ),
        (np.zeros((4, 4)) + np.diag([0, 0, 0, 1.0]), r"^pose must be rigid, got .* by 1 \(scale 0\)"),
        ([["a"] * 4] * 4, r"^pose must be an array of real numbers, got list$"),
    ],
)
def test_matrices_that_are_not_rigid_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        check_transform(matrix, "pose")


def test_positive_numbers_pass():
    assert check_positive(np.float32(0.5), "radius") == 0.5
    assert isinstance(check_positive(2, "radius"), float)


@pytest.mark.parametrize(("value", "shown"), [(0, "0"), (-1.5, "-1.5"), (np.nan, "nan"), (np.inf, "inf")])
def test_numbers_that_are_not_positive_are_refused(value, shown):
    with pytest.raises(ValueError, match=rf"^radius must be positive, got {shown}$"):
        check_positive(value, "radius")


def test_counts_below_their_minimum_are_refused():
    check_count(3, "seed", minimum=3)
    with pytest.raises(ValueError, match=r"^seed must be 3 or more, got 2$"):
        check_count(2, "seed", minimum=3)


@pytest.mark.parametrize(("value", "shown"), [(0, "0"), (1, "1"), (-0.5, "-0.5"), (np.nan, "nan")])
def test_fractions_are_above_0_and_below_1(value, shown):
    check_fraction(0.5, "confidence")
    with pytest.raises(ValueError, match=rf"^confidence must be between 0 and 1, got {shown}$"):
        check_fraction(value, "confidence")


def test_input_errors_are_value_errors():
    assert issubclass(InputError, ValueError)

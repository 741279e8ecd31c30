import math
import re

import numpy as np
import pytest

from cgf.geometry import transforms
from cgf.registration import available, make_estimator
from cgf.registration.alignment import fit_rigid
from cgf.registration.fgr import Fgr, FgrConfig
from cgf.registration.icp import Icp, IcpConfig
from cgf.registration.ransac import Ransac, RansacConfig
from cgf.types import Cancelled, Correspondences, Estimator, PointCloud, RegistrationResult

MOTION = transforms.rigid(transforms.rotation_about([1, 2, -1], 2.0), [0.5, -3.0, 2.0])
NO_CORRESPONDENCES = np.zeros((0, 2), dtype=np.int64)


def correspondences(indices: np.ndarray) -> Correspondences:
    return Correspondences(indices, np.zeros(len(indices), dtype=np.float32), np.ones(len(indices), dtype=np.float32))


def scattered(
    *, right: int = 60, wrong: int = 240, noise: float = 0.0, motion: np.ndarray = MOTION
) -> tuple[PointCloud, PointCloud, Correspondences]:
    """Clouds of which the first `right` points correspond and the other matches are random."""
    rng = np.random.default_rng(8)
    points = rng.uniform(-2, 2, size=(right + wrong, 3))
    moved = transforms.apply(motion, points) + noise * rng.normal(size=points.shape)
    rows = np.arange(right + wrong)
    partners = np.concatenate(
        [rows[:right], np.roll(rows[right:], 1)]
    )  # points are random, so their neighbours in rows are too
    return PointCloud(points), PointCloud(moved), correspondences(np.column_stack([rows, partners]))


def surface(count: int = 2000, seed: int = 0) -> PointCloud:
    """A hilly surface with its normals, of about 2 by 2 units."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, size=(2, count))
    z = 0.2 * np.sin(3 * x) + 0.3 * np.cos(2 * y) * x
    normals = np.column_stack([-0.6 * np.cos(3 * x) - 0.3 * np.cos(2 * y), 0.6 * np.sin(2 * y) * x, np.ones(count)])
    return PointCloud(np.column_stack([x, y, z]), normals / np.linalg.norm(normals, axis=1, keepdims=True))


def assert_nothing_found(result: RegistrationResult) -> None:
    assert result.target_from_source is None
    assert result.inliers.shape == (0,)
    assert result.fitness == 0
    assert math.isnan(result.inlier_rmse)


def test_least_squares_recovers_a_motion_and_never_mirrors() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20, 3))
    np.testing.assert_allclose(fit_rigid(points, transforms.apply(MOTION, points)), MOTION, atol=1e-12)
    mirrored = fit_rigid(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1)


def test_ransac_recovers_an_exact_motion_among_wrong_matches() -> None:
    source, target, matches = scattered()
    result = Ransac(RansacConfig(0.01)).estimate(source, target, matches)
    assert result.target_from_source is not None
    np.testing.assert_allclose(result.target_from_source, MOTION, atol=1e-12)
    np.testing.assert_array_equal(result.inliers, np.arange(60))
    assert result.fitness == 1
    assert result.inlier_rmse == pytest.approx(0, abs=1e-12)
    assert result.method == "ransac"


def test_ransac_averages_noise_over_its_inliers() -> None:
    source, target, matches = scattered(right=200, wrong=200, noise=0.01)
    result = Ransac(RansacConfig(0.05)).estimate(source, target, matches)
    assert result.target_from_source is not None
    assert transforms.rotation_error_deg(result.target_from_source, MOTION) < 0.1
    assert np.abs(transforms.apply(result.target_from_source @ transforms.invert(MOTION), target.points)
                  - target.points).max() < 0.01  # fmt: skip
    assert result.inlier_rmse < 0.02


def test_ransac_finds_two_percent_of_right_matches() -> None:
    source, target, matches = scattered(right=40, wrong=1960)
    result = Ransac(RansacConfig(0.01)).estimate(source, target, matches)
    assert result.target_from_source is not None
    np.testing.assert_allclose(result.target_from_source, MOTION, atol=1e-9)


def test_ransac_is_as_precise_far_from_the_origin() -> None:
    far = transforms.rigid(np.eye(3), [500_000.0, 4_000_000.0, 100.0])
    motion = transforms.compose(far, MOTION, transforms.invert(far))
    source, target, matches = scattered()
    source = PointCloud(transforms.apply(far, source.points))
    target = PointCloud(transforms.apply(far, target.points))
    result = Ransac(RansacConfig(0.01)).estimate(source, target, matches)
    assert result.target_from_source is not None
    moved = transforms.apply(result.target_from_source, source.points)
    np.testing.assert_allclose(moved, transforms.apply(motion, source.points), atol=1e-6)


def test_the_same_seed_gives_the_same_motion() -> None:
    source, target, matches = scattered(right=40, noise=0.02)
    results = [Ransac(RansacConfig(0.05, seed=3)).estimate(source, target, matches) for _ in range(2)]
    np.testing.assert_array_equal(results[0].target_from_source, results[1].target_from_source)


def test_ransac_finds_nothing_without_enough_correspondences() -> None:
    source, target, matches = scattered()
    for rows in (NO_CORRESPONDENCES, matches.indices[:2], matches.indices[:5]):
        assert_nothing_found(Ransac(RansacConfig(0.01)).estimate(source, target, correspondences(rows)))


def test_ransac_finds_nothing_where_nothing_agrees() -> None:
    source, target, matches = scattered(right=0, wrong=50)
    assert_nothing_found(Ransac(RansacConfig(1e-4, iterations=20_000)).estimate(source, target, matches))


def test_ransac_finds_nothing_in_one_repeated_correspondence() -> None:
    source, target, _ = scattered()
    matches = correspondences(np.zeros((100, 2), dtype=np.int64))
    assert_nothing_found(Ransac(RansacConfig(0.1, iterations=20_000)).estimate(source, target, matches))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"inlier_distance": 0.0}, "inlier_distance must be positive, got 0"),
        ({"inlier_distance": 1.0, "iterations": 0}, "iterations must be 1 or more, got 0"),
        ({"inlier_distance": 1.0, "confidence": 1.0}, "confidence must be between 0 and 1, got 1"),
        ({"inlier_distance": 1.0, "edge_ratio": 0.0}, "edge_ratio must be between 0 and 1, got 0"),
        ({"inlier_distance": 1.0, "min_inliers": 2}, "min_inliers must be 3 or more, got 2"),
        ({"inlier_distance": 1.0, "seed": -1}, "seed must be 0 or more, got -1"),
    ],
)
def test_ransac_refuses_settings_that_make_no_sense(values: dict[str, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        RansacConfig(**values)  # type: ignore[arg-type]


def test_weighted_least_squares_counts_a_weight_as_copies() -> None:
    rng = np.random.default_rng(2)
    points, goals = rng.normal(size=(2, 8, 3))
    weights = np.array([0.0, 1.0, 2.0, 3.0, 1.0, 1.0, 1.0, 4.0])
    copies = np.repeat(np.arange(8), weights.astype(int))
    np.testing.assert_allclose(fit_rigid(points, goals, weights), fit_rigid(points[copies], goals[copies]), atol=1e-12)


def test_fgr_recovers_an_exact_motion_among_wrong_matches() -> None:
    source, target, matches = scattered()
    result = Fgr(FgrConfig(0.01)).estimate(source, target, matches)
    assert result.target_from_source is not None
    # A wrong match keeps a little weight, so that the motion is no better than a small share of the inlier distance.
    np.testing.assert_allclose(result.target_from_source, MOTION, atol=1e-4)
    np.testing.assert_array_equal(result.inliers, np.arange(60))
    assert result.fitness == 1
    assert result.method == "fgr"


@pytest.mark.parametrize("offset", [0.0, 4_000_000.0])
def test_fgr_agrees_with_open3d_without_the_random_triples(offset: float) -> None:
    from cgf.io import import_open3d

    open3d = import_open3d()
    registration = open3d.pipelines.registration
    source, target, matches = scattered(right=200, wrong=200, noise=0.01)
    first, second = source.points[matches.indices[:, 0]], target.points[matches.indices[:, 1]]
    size = np.sqrt(max(np.square(cloud - cloud.mean(axis=0)).sum(axis=1).max() for cloud in (first, second)))
    options = registration.FastGlobalRegistrationOption(
        decrease_mu=True, maximum_correspondence_distance=(0.05 / size) ** 2, iteration_number=400, tuple_test=False
    )
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud)) for cloud in (first, second)]
    rows = np.repeat(np.arange(len(matches), dtype=np.int32)[:, None], 2, axis=1)
    theirs = registration.registration_fgr_based_on_correspondence(
        *clouds, open3d.utility.Vector2iVector(rows), options
    )
    far = transforms.rigid(np.eye(3), [offset, 0.0, offset])
    moved = PointCloud(transforms.apply(far, target.points))
    ours = Fgr(FgrConfig(0.05, iterations=400, tuples=0)).estimate(source, moved, matches)
    assert ours.target_from_source is not None
    back = transforms.compose(transforms.invert(far), ours.target_from_source)
    # Open3D linearises the rotation, and both stop near the minimum: a five-hundredth of the inlier distance apart.
    np.testing.assert_allclose(back, theirs.transformation, atol=1e-4)


def test_fgr_finds_nothing_without_enough_correspondences_or_agreement() -> None:
    source, target, matches = scattered()
    for rows in (NO_CORRESPONDENCES, matches.indices[:2], matches.indices[:5], np.zeros((100, 2), dtype=np.int64)):
        assert_nothing_found(Fgr(FgrConfig(0.01)).estimate(source, target, correspondences(rows)))
    source, target, matches = scattered(right=0, wrong=50)
    assert_nothing_found(Fgr(FgrConfig(1e-4)).estimate(source, target, matches))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"inlier_distance": 0.0}, "inlier_distance must be positive, got 0"),
        ({"inlier_distance": 1.0, "iterations": 0}, "iterations must be 1 or more, got 0"),
        ({"inlier_distance": 1.0, "tuples": -1}, "tuples must be 0 or more, got -1"),
        ({"inlier_distance": 1.0, "edge_ratio": 1.0}, "edge_ratio must be between 0 and 1, got 1"),
        ({"inlier_distance": 1.0, "min_inliers": 2}, "min_inliers must be 3 or more, got 2"),
        ({"inlier_distance": 1.0, "seed": -1}, "seed must be 0 or more, got -1"),
    ],
)
def test_fgr_refuses_settings_that_make_no_sense(values: dict[str, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        FgrConfig(**values)  # type: ignore[arg-type]


def nearly() -> np.ndarray:
    return MOTION @ transforms.rigid(transforms.rotation_about([0, 1, 1], 0.03), [0.02, -0.01, 0.03])


def test_icp_refines_a_motion_that_is_nearly_right() -> None:
    source, target = surface(), transforms.move(MOTION, surface(6000, seed=1))
    matches = correspondences(np.column_stack([np.arange(10), np.arange(10)]))
    result = Icp(IcpConfig(0.1), nearly()).estimate(source, target, matches)
    assert result.target_from_source is not None
    before = transforms.rotation_error_deg(nearly(), MOTION)
    assert transforms.rotation_error_deg(result.target_from_source, MOTION) < before / 20
    assert transforms.translation_error(result.target_from_source, MOTION) < 0.003
    assert result.fitness > 0.99
    assert result.method == "icp"


def test_icp_finds_the_very_motion_between_copies() -> None:
    source = surface()
    target = transforms.move(MOTION, source)
    rows = np.column_stack([np.arange(5), [0, 1, 2, 1000, 4]])
    result = Icp(IcpConfig(0.1), nearly()).estimate(source, target, correspondences(rows))
    assert result.target_from_source is not None
    np.testing.assert_allclose(result.target_from_source, MOTION, atol=1e-9)
    np.testing.assert_array_equal(result.inliers, [0, 1, 2, 4])


def test_icp_does_not_slide_where_the_surface_lets_it() -> None:
    x, y = np.random.default_rng(3).uniform(-1, 1, size=(2, 500))
    plane = PointCloud(np.column_stack([x, y, np.zeros(500)]), np.tile([0.0, 0.0, 1.0], (500, 1)))
    lifted = transforms.move(transforms.rigid(np.eye(3), [0, 0, 0.05]), plane)
    result = Icp(IcpConfig(0.2)).estimate(lifted, plane, correspondences(NO_CORRESPONDENCES))
    assert result.target_from_source is not None
    np.testing.assert_allclose(result.target_from_source, transforms.rigid(np.eye(3), [0, 0, -0.05]), atol=1e-9)


def test_icp_agrees_with_open3d() -> None:
    from cgf.io import import_open3d

    open3d = import_open3d()
    registration = open3d.pipelines.registration
    source, target = surface(), transforms.move(MOTION, surface(3000, seed=1))
    clouds = []
    for cloud in (source, target):
        clouds.append(open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points)))
        clouds[-1].normals = open3d.utility.Vector3dVector(cloud.normals)
    method = registration.TransformationEstimationPointToPlane()
    criteria = registration.ICPConvergenceCriteria(1e-12, 1e-12, 200)
    theirs = registration.registration_icp(*clouds, 0.1, nearly(), method, criteria)
    ours = Icp(IcpConfig(0.1, iterations=200), nearly()).estimate(source, target, correspondences(NO_CORRESPONDENCES))
    np.testing.assert_allclose(ours.target_from_source, theirs.transformation, atol=1e-5)
    assert ours.fitness == pytest.approx(theirs.fitness)
    assert ours.inlier_rmse == pytest.approx(theirs.inlier_rmse, rel=1e-4)


def test_icp_finds_nothing_where_the_clouds_are_apart() -> None:
    far = transforms.rigid(np.eye(3), [100.0, 0, 0])
    assert_nothing_found(Icp(IcpConfig(0.1), far).estimate(surface(), surface(), correspondences(NO_CORRESPONDENCES)))


def test_icp_refuses_a_target_without_normals() -> None:
    with pytest.raises(ValueError, match="target must have normals, got none; estimate them first"):
        Icp(IcpConfig(0.1)).estimate(surface(), PointCloud(surface().points), correspondences(NO_CORRESPONDENCES))


def test_icp_to_points_needs_no_normals() -> None:
    source = surface()
    target = PointCloud(transforms.apply(MOTION, source.points))
    near = MOTION @ transforms.rigid(transforms.rotation_about([0, 1, 1], 0.005), [0.004, -0.002, 0.003])
    result = Icp(IcpConfig(0.1, metric="point"), near).estimate(source, target, correspondences(NO_CORRESPONDENCES))
    assert result.target_from_source is not None
    np.testing.assert_allclose(result.target_from_source, MOTION, atol=1e-9)


def test_icp_refuses_a_start_that_is_not_rigid() -> None:
    with pytest.raises(ValueError, match="initial must"):
        Icp(IcpConfig(0.1), 2 * np.eye(4))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"max_distance": -1.0}, "max_distance must be positive, got -1"),
        ({"max_distance": 1.0, "iterations": 0}, "iterations must be 1 or more, got 0"),
    ],
)
def test_icp_refuses_settings_that_make_no_sense(values: dict[str, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        IcpConfig(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", available())
def test_every_registered_estimator_keeps_the_protocol(name: str) -> None:
    estimator = make_estimator(name, inlier_distance=0.1)
    assert isinstance(estimator, Estimator)
    assert estimator.name == name


@pytest.mark.parametrize("name", available())
def test_every_registered_estimator_tells_how_far_it_is_and_can_be_stopped(name: str) -> None:
    source, target, matches = scattered()
    estimator = make_estimator(name, inlier_distance=1.0, metric="point", iterations=3)
    told: list[float] = []
    estimator.estimate(source, target, matches, progress=lambda share, _: told.append(share))
    assert told
    assert told == sorted(told)
    assert told[0] >= 0
    assert told[-1] <= 1
    with pytest.raises(Cancelled):
        estimator.estimate(source, target, matches, cancelled=lambda: True)


def test_an_unknown_estimator_is_refused() -> None:
    with pytest.raises(ValueError, match="name must be one of fgr, icp, ransac, got magic"):
        make_estimator("magic", inlier_distance=1.0)

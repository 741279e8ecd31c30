"""Diagnoses of pairs whose fault is known, because it was made."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cgf import pipeline
from cgf.checks import InputError
from cgf.datasets.demo import load_demo
from cgf.datasets.fgr import load_fgr
from cgf.datasets.match3d import find_scene
from cgf.diagnosis import Case, Diagnosis, diagnose, diagnose_loaded, diagnose_result
from cgf.diagnosis.remedies import scale_changes
from cgf.diagnosis.rules.common import command_options
from cgf.geometry import transforms
from cgf.pipeline import PairSettings, run_pair
from cgf.types import Cancelled, Pair, PointCloud

MOTION = transforms.rigid(transforms.rotation_about([1, 2, -1], 0.6), [0.4, -0.3, 0.5])
USUAL = PairSettings()


def diagnosed(pair: Pair, wanted: PairSettings = USUAL, *, with_truth: bool = True) -> Diagnosis:
    result = run_pair(pair.source, pair.target, wanted, register=True)
    return diagnose_result(pair if with_truth else replace(pair, target_from_source=None), wanted, result)


def kinds(diagnosis: Diagnosis, *severities: str) -> list[str]:
    return [finding.kind for finding in diagnosis.findings if finding.severity in severities]


def scaled(cloud: PointCloud, factor: float) -> PointCloud:
    return replace(cloud, points=cloud.points * factor, viewpoint=cloud.viewpoint * factor)


@pytest.fixture(scope="module")
def demo() -> Pair:
    return load_demo()


@pytest.fixture(scope="module")
def demo_case(demo: Pair) -> Case:
    return Case.of_result(demo, USUAL, run_pair(demo.source, demo.target, USUAL, register=True))


@pytest.mark.parametrize("with_truth", [True, False])
def test_nothing_is_wrong_with_a_good_pair(demo_case: Case, *, with_truth: bool) -> None:
    diagnosis = diagnose(demo_case if with_truth else replace(demo_case, truth=None))
    assert diagnosis.outcome == "registered"
    assert kinds(diagnosis, "problem", "caution") == []
    assert {"scale", "normals", "overlap", "features", "shape", "agreement"} <= set(kinds(diagnosis, "fine"))
    assert all(item.holds for finding in diagnosis.findings for item in finding.evidence)
    assert diagnosis.verdict.startswith("Nothing wrong found")
    assert diagnosis.is_judged_by_truth == with_truth
    assert diagnosis.pose is not None
    assert transforms.rotation_error_deg(diagnosis.pose, demo_case.truth) < 2


def test_the_plain_form_is_json(demo_case: Case) -> None:
    diagnosis = diagnose(demo_case)
    plain = json.loads(json.dumps(diagnosis.as_plain(), allow_nan=False))
    assert plain["verdict"] == diagnosis.verdict
    overlap = next(finding for finding in plain["findings"] if finding["kind"] == "overlap")
    assert overlap["has_place"]
    assert overlap["evidence"][0]["holds"]
    assert overlap["evidence"][0]["value"] == pytest.approx(
        len(diagnosis.places["overlap"].source) / len(demo_case.source)
    )


def test_a_cancelled_diagnosis_gives_up(demo_case: Case) -> None:
    with pytest.raises(Cancelled):
        diagnose(demo_case, cancelled=lambda: True)


def test_an_estimate_that_misses_good_matches_is_the_estimators_fault(demo_case: Case) -> None:
    wrong = transforms.compose(MOTION, demo_case.truth)
    for truth in (demo_case.truth, None):
        diagnosis = diagnose(replace(demo_case, estimate=wrong, truth=truth))
        assert diagnosis.outcome == "failed"
        assert kinds(diagnosis, "problem") == ["estimator"]
        assert "the estimator missed the pose" in diagnosis.verdict
    assert "found no pose" in diagnose(replace(demo_case, estimate=None)).verdict


def test_a_true_pose_that_maps_the_other_way_is_recognised(demo_case: Case) -> None:
    moved = replace(demo_case, truth=transforms.invert(demo_case.truth))
    diagnosis = diagnose(moved)
    assert kinds(diagnosis, "problem") == ["truth"]
    assert "maps the wrong way" in diagnosis.verdict


def test_a_strict_filter_is_found(demo_case: Case) -> None:
    few = replace(demo_case, rows=demo_case.rows[:5], estimate=None, truth=None)
    assert "filters" in kinds(diagnose(few), "problem")


@pytest.mark.parametrize("side", ["source", "target"])
def test_normals_of_one_cloud_that_are_turned_round(demo: Pair, side: str) -> None:
    cloud = getattr(demo, side)
    diagnosis = diagnosed(replace(demo, **{side: replace(cloud, normals=-cloud.normals)}), with_truth=False)
    assert kinds(diagnosis, "problem") == ["normals"]
    found = diagnosis.finding("normals")
    assert found is not None
    assert found.changes == {"flip_normals": side}
    assert found.options == f"--flip-normals {side}"


def test_normals_at_random_are_found_but_do_not_pass_for_turned_round(demo: Pair) -> None:
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(demo.source), 1))
    diagnosis = diagnosed(replace(demo, source=replace(demo.source, normals=demo.source.normals * signs)))
    found = diagnosis.finding("normals")
    assert found is not None
    assert found.severity in ("problem", "caution")
    assert found.changes == {"normals": "estimated"}
    assert len(diagnosis.places["normals"].source) > 10 * len(diagnosis.places["normals"].target)


def test_one_cloud_in_millimetres(demo: Pair) -> None:
    pair = replace(demo, source=scaled(demo.source, 1000.0))
    with pytest.raises(InputError) as error:
        run_pair(pair.source, pair.target, USUAL)
    diagnosis = diagnose_loaded(USUAL, pair.source, pair.target, str(error.value))
    assert kinds(diagnosis, "problem", "caution") == ["scale"]
    assert diagnosis.findings[0].changes == {"source_scale": 0.001}
    assert "as between metres and millimetres" in diagnosis.verdict


def test_an_error_that_has_another_reason_is_repeated(demo: Pair) -> None:
    diagnosis = diagnose_loaded(USUAL, demo.source, demo.target, "--voxel must be smaller")
    assert kinds(diagnosis, "problem") == ["settings"]
    assert "--voxel must be smaller" in diagnosis.verdict


def test_one_cloud_in_inches(demo: Pair) -> None:
    diagnosis = diagnosed(replace(demo, source=scaled(demo.source, 1 / 2.54)), with_truth=False)
    assert kinds(diagnosis, "problem") == ["scale"]
    assert diagnosis.findings[0].changes == {"source_scale": 2.54}


def test_a_slight_difference_in_scale(demo: Pair) -> None:
    diagnosis = diagnosed(replace(demo, source=scaled(demo.source, 1.15)), with_truth=False)
    assert kinds(diagnosis, "problem") == ["scale"]
    assert diagnosis.findings[0].changes["source_scale"] == pytest.approx(1 / 1.15, rel=0.04)


def test_a_room_in_millimetres(demo: Pair) -> None:
    both = replace(demo, source=scaled(demo.source, 1000.0), target=scaled(demo.target, 1000.0))
    found = diagnosed(both, with_truth=False).finding("unit")
    assert found is not None
    assert found.changes == {"unit": "mm"}
    assert diagnosed(both, PairSettings(unit="mm"), with_truth=False).finding("unit") is None


def test_a_radius_that_is_too_small(demo: Pair) -> None:
    diagnosis = diagnosed(demo, PairSettings(support_radius=0.04), with_truth=False)
    assert kinds(diagnosis, "problem") == ["radius"]
    assert diagnosis.findings[0].changes == {"support_radius": None}
    assert diagnosis.outcome == "doubtful"


@pytest.mark.parametrize("with_truth", [True, False])
def test_clouds_that_do_not_overlap(demo: Pair, *, with_truth: bool) -> None:
    moved = transforms.apply(demo.target_from_source, demo.source.points)
    axis = np.linalg.svd(demo.target.points - demo.target.points.mean(axis=0), full_matrices=False)[2][0]
    middle = np.median(np.concatenate([moved, demo.target.points]) @ axis)
    halves = replace(
        demo,
        source=demo.source.take(np.flatnonzero(moved @ axis < middle - 0.07)),
        target=demo.target.take(np.flatnonzero(demo.target.points @ axis > middle + 0.07)),
    )
    diagnosis = diagnosed(halves, with_truth=with_truth)
    assert kinds(diagnosis, "problem") == ["overlap", "agreement"]
    assert diagnosis.outcome == ("failed" if with_truth else "doubtful")
    assert diagnosis.pose is None


def test_a_cloud_of_few_points(demo: Pair) -> None:
    few = demo.source.take(np.arange(0, len(demo.source), 80))
    diagnosis = diagnosed(replace(demo, source=few), with_truth=False)
    assert kinds(diagnosis, "problem")[0] == "points"
    assert not {"scale", "normals", "overlap", "shape"} & set(kinds(diagnosis, "problem"))


def two_views(points: np.ndarray, normals: np.ndarray, *, seed: int = 0) -> Pair:
    """Two halves of the points, with a little noise each, of which the source was moved."""
    rng = np.random.default_rng(seed)
    noisy = points + rng.normal(scale=0.003, size=points.shape)
    order = rng.permutation(len(points))
    first, second = order[: len(order) // 2], order[len(order) // 2 :]
    source = transforms.move(transforms.invert(MOTION), PointCloud(noisy[first], normals[first]))
    return Pair("made", source, PointCloud(noisy[second], normals[second]), MOTION)


def plane(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return np.column_stack([rng.uniform(-1, 1, (8000, 2)), np.zeros(8000)]), np.tile([0.0, 0.0, 1.0], (8000, 1))


def sphere(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    normals = rng.normal(size=(8000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals.copy(), normals


def cylinder(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    angles = rng.uniform(0, 2 * np.pi, 8000)
    normals = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8000)])
    return normals + np.outer(rng.uniform(-1.2, 1.2, 8000), [0, 0, 1]), normals


@pytest.mark.parametrize(("shape", "named"), [(plane, "a plane"), (sphere, "a sphere"), (cylinder, "a cylinder")])
def test_shapes_that_fix_no_pose(shape, named: str) -> None:
    diagnosis = diagnosed(two_views(*shape(np.random.default_rng(0))), PairSettings(voxel_size=0.07), with_truth=False)
    assert kinds(diagnosis, "problem")[0] == "shape"
    assert named in diagnosis.verdict
    assert not {"scale", "normals", "radius", "overlap", "repetition"} & set(kinds(diagnosis, "problem"))


def boxes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A grid of equal boxes on a floor."""
    count = 900
    points, normals = [], []
    for x, y in np.ndindex(4, 4):
        face = rng.integers(0, 6, count)
        normal = np.zeros((count, 3))
        normal[np.arange(count), face // 2] = np.where(face % 2, 1.0, -1.0)
        place = rng.uniform(-1, 1, (count, 3))
        place[np.arange(count), face // 2] = np.where(face % 2, 1.0, -1.0)
        kept = normal[:, 2] >= 0
        points.append((place * [0.3, 0.3, 0.2] + [x, y, 0.2])[kept])
        normals.append(normal[kept])
    floor = np.column_stack([rng.uniform(-0.5, 3.5, (9000, 2)), np.zeros(9000)])
    floor = floor[(np.abs(floor[:, :2] - np.rint(floor[:, :2])) > 0.3).any(axis=1)]
    return np.concatenate([*points, floor]), np.concatenate([*normals, np.tile([0.0, 0.0, 1.0], (len(floor), 1))])


def test_a_scene_that_repeats_itself() -> None:
    pair = two_views(*boxes(np.random.default_rng(0)))
    diagnosis = diagnosed(pair, PairSettings(voxel_size=0.06), with_truth=False)
    assert kinds(diagnosis, "problem")[0] == "repetition"
    assert not {"scale", "normals", "radius", "overlap", "shape"} & set(kinds(diagnosis, "problem"))


def test_units_are_guessed_from_extents(demo: Pair) -> None:
    assert scale_changes(USUAL, demo.source, demo.target) == []
    assert {"source_scale": 0.001} in scale_changes(USUAL, scaled(demo.source, 1000.0), demo.target)
    # The source's metres become the target's millimetres, of which the model is then told.
    assert {"source_scale": 1000.0, "unit": "mm"} in scale_changes(USUAL, demo.source, scaled(demo.target, 1000.0))


def test_changes_read_as_options() -> None:
    assert (
        command_options({"source_scale": 0.001, "unit": "mm", "mutual": True})
        == "--source-scale 0.001 --unit mm --mutual"
    )
    assert command_options({"support_radius": None}).strip() == "(without --radius)"


def test_applying_the_remedy_mends_the_pair(demo: Pair) -> None:
    pair = replace(demo, source=scaled(demo.source, 1000.0))
    wanted = PairSettings(source_scale=0.001)
    source, _ = pipeline.correct(wanted, pair.source, pair.target)
    np.testing.assert_allclose(source.points, demo.source.points)
    diagnosis = diagnosed(pair, wanted)
    assert kinds(diagnosis, "problem", "caution") == []


def test_nothing_is_wrong_with_range_images_of_objects(shared) -> None:
    diagnosis = diagnosed(next(load_fgr(shared / "data/objects/fgr_level_01", [3])), with_truth=False)
    assert (diagnosis.outcome, kinds(diagnosis, "problem")) == ("registered", [])


@pytest.mark.parametrize(
    ("log", "pair", "problem"), [("gt.log", 0, None), ("gt_lomatch.log", 262, "overlap")], ids=["good", "low overlap"]
)
def test_rooms_are_judged_alike_with_the_truth_and_without(shared, log: str, pair: int, problem: str | None) -> None:
    scene = shared / "data/indoor/3dmatch/7-scenes-redkitchen"
    found = find_scene(scene, log=log)[pair].read()
    result = run_pair(found.source, found.target, USUAL, register=True)
    for known in (found, replace(found, target_from_source=None)):
        diagnosis = diagnose_result(known, USUAL, result)
        assert (diagnosis.outcome == "registered") == (problem is None)
        assert kinds(diagnosis, "problem")[:1] == ([] if problem is None else [problem])

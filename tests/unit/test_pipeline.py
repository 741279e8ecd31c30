import gc
import re
import weakref
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cgf import descriptors, pipeline
from cgf.checks import InputError
from cgf.datasets.demo import load_demo
from cgf.descriptors.settings import MODEL_DEFAULTS, DescriptorSettings
from cgf.geometry import transforms
from cgf.io import write_cloud, write_transform
from cgf.pipeline import PairSettings, ResolvedSettings, choose_model, prepare, resolve, run_pair
from cgf.types import Cancelled, Correspondences, Features, PointCloud, RegistrationResult
from tests.surfaces import surface

MOTION = transforms.rigid(transforms.rotation_about([1, 2, -1], 1.0), [0.5, -1.0, 2.0])


@dataclass(frozen=True)
class Coordinates:
    """Stands in for a learned descriptor: nested, quick, and right for points at the same place."""

    settings: DescriptorSettings

    @property
    def name(self) -> str:
        return "cgf"

    @property
    def dim(self) -> int:
        return self.settings.dim

    def describe(self, cloud, indices, *, progress=None, cancelled=None) -> Features:
        if cancelled is not None and cancelled():
            raise Cancelled
        if progress is not None:
            progress(1.0, "Describing")
        near = indices[np.linalg.norm(cloud.points[indices], axis=1) < 100 * self.settings.lrf_radius]
        waves = np.arange(1, self.dim + 1)[:, None] * np.array([0.3, 0.5, 0.7])
        vectors = np.sin(cloud.points[near] @ waves.T)
        if cloud.name == "blob":
            vectors = np.random.default_rng(0).normal(size=vectors.shape)
        return Features(near, vectors.astype(np.float32), self.name)


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descriptors, "dimensions", lambda *_, **__: (8, 16, 32, 64))
    monkeypatch.setattr(descriptors, "make_descriptor", lambda _, settings: Coordinates(settings))


def settings_for(size: float = 4.0, **chosen: object) -> ResolvedSettings:
    cloud = surface(size)
    return resolve(PairSettings(**{"descriptor": "fpfh", **chosen}), cloud, cloud)  # type: ignore[arg-type]


def test_indoor_defaults_are_the_models() -> None:
    settings, defaults = settings_for(4.0, voxel_size=0.01), MODEL_DEFAULTS["indoor"]
    for name in ("support_radius", "min_radius", "normal_radius", "tau", "precision_radius", "error_scale"):
        assert getattr(settings, name) == pytest.approx(getattr(defaults, name))


def test_object_defaults_scale_with_the_diameter() -> None:
    small, large = settings_for(1.0), settings_for(1000.0)
    for name in ("voxel_size", "support_radius", "min_radius", "lrf_radius", "tau", "error_scale", "inlier_distance"):
        assert getattr(large, name) == pytest.approx(1000 * getattr(small, name))
    assert small.support_radius == pytest.approx(0.2)


def test_the_innermost_shell_keeps_its_share_of_the_radius() -> None:
    assert settings_for(support_radius=0.6).min_radius == pytest.approx(0.05)
    assert settings_for(support_radius=0.6, min_radius=0.02).min_radius == 0.02


def test_frames_are_large_enough_for_sparse_clouds() -> None:
    settings = settings_for(1.0)
    assert settings.lrf_radius == pytest.approx(3 * settings.spacing)
    assert settings_for(1.0, lrf_radius=1.5 * settings.spacing).lrf_radius == 1.5 * settings.spacing


@pytest.mark.parametrize(
    ("chosen", "sentence"),
    [
        (
            {"support_radius": 0.01},
            r"--radius must be above the point spacing \(0\.0\d+\), got 0\.01; try 1\.1",
        ),
        ({"support_radius": -1.0}, r"--radius must be above the point spacing \(0\.0\d+\), got -1; try 1\.1"),
        ({"support_radius": float("nan")}, r"--radius must be above the point spacing \(0\.0\d+\), got nan; try 1\.1"),
        ({"support_radius": 50.0}, r"--radius must be at most the diameter of the clouds \(4\), got 50; try 1\.1"),
        ({"voxel_size": -0.1}, r"--voxel must be 0 \(keep every point\) or more, got -0\.1; try 0\.03"),
        ({"voxel_size": float("inf")}, r"--voxel must be 0 \(keep every point\) or more, got inf; try 0\.03"),
        ({"voxel_size": 1.2}, r"--voxel must be below the radius \(1\.08\), got 1\.2; try 0\.03"),
        ({"voxel_size": 2.0}, r"--voxel must be below the radius \(1\.08\), got 2; try 0\.03"),
        ({"min_radius": 1.2}, r"--min-radius must be above 0 and below the radius \(1\.08\), got 1\.2; try 0\.09"),
        ({"min_radius": 0.0}, r"--min-radius must be above 0 and below the radius \(1\.08\), got 0; try 0\.09"),
        (
            {"lrf_radius": 0.01},
            r"--lrf-radius must be above the point spacing \(0\.0\d+\) and at most the diameter \(4\), got 0\.01; "
            r"try 0\.25",
        ),
        ({"lrf_radius": 9.0}, r"--lrf-radius must be .* got 9; try 0\.25"),
        ({"max_ratio": 0.0}, r"--ratio must be above 0 and at most 1, got 0; try 0\.9"),
        ({"max_ratio": 1.1}, r"--ratio must be above 0 and at most 1, got 1\.1; try 0\.9"),
        ({"surest": 0.0}, r"--surest must be above 0 and at most 1, got 0; try 0\.5"),
        ({"seed": -1}, r"--seed must be 0 or more, got -1"),
        ({"descriptor": "sift"}, r"--descriptor must be one of cgf, fpfh, pca, got sift"),
        ({"dim": 7}, r"--dim must be one of 33 with --descriptor fpfh, got 7"),
        ({"model": "room"}, r"--model must be auto, object or indoor, got room"),
    ],
)
def test_a_setting_that_cannot_be_used_is_refused_with_its_option(chosen: dict[str, object], sentence: str) -> None:
    settings = PairSettings(descriptor="fpfh")
    settings = replace(settings, **{key: value for key, value in chosen.items() if key != "model"})
    if "model" in chosen:
        object.__setattr__(settings, "model", chosen["model"])
    with pytest.raises(InputError, match=sentence):
        resolve(settings, surface(), surface())


def test_a_radius_below_the_spacing_of_very_sparse_clouds_is_refused() -> None:
    cloud = surface(4.0, count=10)
    with pytest.raises(InputError, match=r"--radius must be above the point spacing .*, got 0\.1; try 1\.1"):
        resolve(PairSettings(descriptor="fpfh", support_radius=0.1), cloud, cloud)


def test_a_model_whose_radius_does_not_fit_is_refused() -> None:
    sentence = r"--radius must be at most the diameter of the clouds \(0\.5\), got 1\.08; choose --model object or give"
    with pytest.raises(InputError, match=sentence):
        settings_for(0.5, model="indoor")


def test_a_nested_descriptor_is_computed_in_full(learned: None) -> None:
    settings = settings_for(descriptor="cgf", dim=16)
    assert (settings.dim, settings.computed_dim) == (16, 64)
    assert settings_for(descriptor="cgf").dim == 32


def test_keys_name_what_each_stage_depends_on(learned: None) -> None:
    base = settings_for(descriptor="cgf")
    filters = settings_for(descriptor="cgf", mutual=True, max_ratio=0.9, seed=4)
    assert filters.match_key == base.match_key
    dims = settings_for(descriptor="cgf", dim=8)
    assert dims.description_key == base.description_key
    assert dims.match_key != base.match_key
    radius = settings_for(descriptor="cgf", support_radius=0.7)
    assert radius.preparation_key == base.preparation_key
    assert radius.description_key != base.description_key
    assert settings_for(descriptor="cgf", voxel_size=0.05).preparation_key != base.preparation_key


def test_preparing_thins_the_cloud_and_gives_normals_to_the_viewpoint() -> None:
    settings = settings_for(voxel_size=0.2)
    prepared = prepare(surface(), settings)
    assert 10 < len(prepared) < 1500
    assert prepared.normals is not None
    assert (prepared.normals[:, 2] > 0).all()


def test_preparing_keeps_normals_that_are_there() -> None:
    cloud = surface()
    cloud = replace(cloud, normals=np.tile([1.0, 0.0, 0.0], (len(cloud), 1)))
    np.testing.assert_allclose(prepare(cloud, settings_for(voxel_size=0.2)).normals[:, 0], 1)


def test_voxel_zero_keeps_every_point() -> None:
    cloud = surface()
    np.testing.assert_array_equal(prepare(cloud, settings_for(voxel_size=0.0)).points, cloud.points)


def test_a_voxel_that_leaves_too_few_points_is_refused() -> None:
    settings = replace(settings_for(), voxel_size=3.0)
    sentence = r"--voxel must leave 10 points or more, got \d of the 1,500 of sheet with 3; try 0\.08"
    with pytest.raises(InputError, match=sentence):
        prepare(surface(), settings)


def test_a_voxel_too_small_to_number_is_refused() -> None:
    with pytest.raises(InputError, match="--voxel: voxel_size must be"):
        prepare(surface(), replace(settings_for(), voxel_size=1e-30))


def test_a_cloud_that_cannot_be_described_is_refused(learned: None) -> None:
    settings = settings_for(descriptor="cgf", voxel_size=0.1)
    prepared = prepare(surface(), settings)
    sentence = (
        f"--radius and --lrf-radius must hold neighbours, but none of the {len(prepared):,} points of sheet can be "
        "described with 1.08 and 1e-09; try 2.2 and 2e-09"
    )
    with pytest.raises(InputError, match=re.escape(sentence)):
        pipeline.describe(prepared, replace(settings, lrf_radius=1e-9))


def test_every_stage_together_finds_the_motion(learned: None) -> None:
    source = surface()
    target = surface()
    result = run_pair(source, target, PairSettings(dim=16, mutual=True), register=True)
    assert result.source_features.dim == 16
    assert len(result.rows) == len(result.table)  # of equal clouds, every match is mutual
    np.testing.assert_array_equal(result.correspondences.indices[:, 0], result.correspondences.indices[:, 1])
    assert result.registration is not None
    np.testing.assert_allclose(result.registration.target_from_source, np.eye(4), atol=1e-9)
    assert result.registration.method == "ransac+icp"
    assert result.warnings == ()


def test_nothing_is_registered_unless_asked_for(learned: None) -> None:
    assert run_pair(surface(), surface(), PairSettings()).registration is None


def test_run_pair_is_its_stages_one_by_one(learned: None) -> None:
    source, target, chosen = surface(seed=1), surface(seed=2), PairSettings(dim=8, max_ratio=0.9)
    settings = resolve(chosen, source, target)
    prepared = [prepare(cloud, settings) for cloud in (source, target)]
    described = [pipeline.describe(cloud, settings) for cloud in prepared]
    table = pipeline.match_features(described[0], described[1], settings)
    result = run_pair(source, target, chosen)
    rows = pipeline.filtered_rows(table, settings)
    np.testing.assert_array_equal(result.rows, rows)
    np.testing.assert_array_equal(result.correspondences.indices, table.correspondences.take(rows).indices)
    np.testing.assert_array_equal(result.source_features.vectors, pipeline.at_dim(described[0], settings).vectors)


def test_real_features_find_the_motion_of_a_moved_copy() -> None:
    source, target = surface(count=4000), surface(count=4000)
    moved = transforms.move(transforms.invert(MOTION), source)
    result = run_pair(moved, target, PairSettings(descriptor="fpfh", voxel_size=0.1), register=True)
    assert result.registration is not None
    assert result.registration.target_from_source is not None
    assert transforms.rotation_error_deg(result.registration.target_from_source, MOTION) < 1


@pytest.mark.parametrize("descriptor", ["cgf", "fpfh"])
def test_the_demo_pair_is_registered(descriptor: str) -> None:
    demo = load_demo()
    result = run_pair(demo.source, demo.target, PairSettings(descriptor=descriptor), register=True)
    assert result.settings.model == "indoor"
    assert result.warnings == ()
    assert result.registration is not None
    assert result.registration.target_from_source is not None
    assert demo.target_from_source is not None
    assert transforms.rotation_error_deg(result.registration.target_from_source, demo.target_from_source) < 1
    assert transforms.translation_error(result.registration.target_from_source, demo.target_from_source) < 0.05
    assert result.registration.fitness > 0.8


def test_progress_rises_to_one_and_names_the_stages(learned: None) -> None:
    told: list[tuple[float, str]] = []
    run_pair(surface(), surface(), PairSettings(), register=True, progress=lambda *news: told.append(news))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert [text for _, text in told if text != "Describing"][:2] == ["Preparing the clouds", "Describing the source"]


@pytest.mark.parametrize("calls", range(6))
def test_cancelling_stops_at_the_next_stage(learned: None, calls: int) -> None:
    asked = iter([False] * calls + [True] * 20)
    with pytest.raises(Cancelled):
        run_pair(surface(), surface(), PairSettings(), register=True, cancelled=lambda: next(asked))


def some_result(*, inliers: int, fitness: float, found: bool = True) -> RegistrationResult:
    return RegistrationResult(np.eye(4) if found else None, np.arange(inliers), fitness, 0.01, "icp")


@pytest.mark.parametrize(
    ("result", "sentence"),
    [
        (
            some_result(inliers=0, fitness=0.0, found=False),
            "No motion was found that enough of the 1,000 correspondences agree with; do the clouds overlap?",
        ),
        (
            some_result(inliers=9, fitness=0.5),
            "Only 9 of 1,000 correspondences agree with the motion found (within 0.075), as many as chance gives; "
            "do the clouds overlap?",
        ),
        (
            some_result(inliers=50, fitness=0.04),
            "Only 4% of the source's points come within 0.075 of the target after moving; do the clouds overlap?",
        ),
        (some_result(inliers=50, fitness=0.5), None),
    ],
)
def test_a_doubtful_registration_is_warned_of(result: RegistrationResult, sentence: str | None) -> None:
    indices = np.zeros((1000, 2), dtype=np.int64)
    values = np.zeros(1000, dtype=np.float32)
    settings = replace(settings_for(), inlier_distance=0.075)
    assert pipeline.registration_warning(result, Correspondences(indices, values, values), settings) == sentence


def test_clouds_without_overlap_are_warned_of(learned: None) -> None:
    blob = PointCloud(np.random.default_rng(5).normal(size=(1500, 3)), name="blob")
    result = run_pair(surface(), blob, PairSettings(voxel_size=0.01, model="indoor"), register=True)
    assert any("do the clouds overlap?" in warning for warning in result.warnings)


def test_a_pair_is_read_with_its_pose_and_viewpoint(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", surface())
    write_cloud(tmp_path / "b.ply", surface(seed=1))
    write_transform(tmp_path / "pose.txt", MOTION)
    pair = pipeline.load_pair(
        tmp_path / "a.ply", tmp_path / "b.ply", gt=tmp_path / "pose.txt", viewpoint=(1.0, 2.0, 3.0)
    )
    assert pair.target_from_source is not None
    np.testing.assert_allclose(pair.target_from_source, MOTION)
    np.testing.assert_array_equal(pair.source.viewpoint, [1, 2, 3])
    assert len(pair.target) == 1500
    assert pipeline.load_pair(tmp_path / "a.ply", tmp_path / "b.ply").target_from_source is None


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.ply"):
        pipeline.load_pair(tmp_path / "a.ply", tmp_path / "b.ply")


def test_resolving_keeps_no_cloud_alive(learned: None) -> None:
    cloud = surface()
    resolve(PairSettings(), cloud, cloud)
    watched = weakref.ref(cloud)
    del cloud
    gc.collect()
    assert watched() is None


def test_a_room_in_millimetres_resolves_as_in_metres() -> None:
    metres = resolve(PairSettings(), surface(4.0), surface(4.0))
    millimetres = resolve(PairSettings(unit="mm"), surface(4000.0), surface(4000.0))
    assert millimetres.model == metres.model == "indoor"
    for name in ("support_radius", "min_radius", "lrf_radius", "voxel_size", "tau", "normal_radius"):
        assert getattr(millimetres, name) == pytest.approx(1000 * getattr(metres, name))
    assert choose_model(surface(4000.0), surface(3000.0), unit="mm").warning is None


def test_the_source_is_scaled_with_its_viewpoint() -> None:
    source, target = pipeline.correct(PairSettings(source_scale=0.5), surface(4.0), surface(4.0))
    np.testing.assert_allclose(source.points, surface(2.0).points)
    np.testing.assert_allclose(source.viewpoint, 0.5 * surface(4.0).viewpoint)
    np.testing.assert_array_equal(target.points, surface(4.0).points)
    with pytest.raises(InputError, match="--source-scale must be positive, got 0"):
        pipeline.correct(PairSettings(source_scale=0.0), source, target)


@pytest.mark.parametrize(
    ("flip", "signs"), [("none", (1, 1)), ("source", (-1, 1)), ("target", (1, -1)), ("both", (-1, -1))]
)
def test_normals_are_turned_round_where_asked(flip: str, signs: tuple[int, int]) -> None:
    usual, turned = settings_for(), settings_for(flip_normals=flip)
    for side, sign in zip(("source", "target"), signs, strict=True):
        np.testing.assert_array_equal(
            prepare(surface(), turned, side).normals, sign * prepare(surface(), usual, side).normals
        )
    assert (usual.preparation_key == turned.preparation_key) == (flip == "none")


def test_stored_normals_can_be_ignored() -> None:
    wrong = replace(surface(), normals=np.tile([1.0, 0.0, 0.0], (1500, 1)))
    wanted = PairSettings(descriptor="fpfh", normals="estimated")
    source, target = pipeline.correct(wanted, wrong, wrong)
    prepared = prepare(source, resolve(wanted, source, target))
    assert prepared.normals is not None
    assert np.median(prepared.normals[:, 2]) > 0.7

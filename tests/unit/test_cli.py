import argparse
import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cgf import cli, pipeline
from cgf.evaluation.matches import match_errors
from cgf.geometry import transforms
from cgf.io import read_transform, write_cloud, write_transform
from cgf.pipeline import PairSettings
from cgf.types import PointCloud

MOTION = transforms.rigid(transforms.rotation_about([1, 2, -1], 1.0), [0.5, -1.0, 2.0])
OPTIONS = ["--descriptor", "fpfh", "--voxel", "0.1"]


def sheet(count: int = 4000, seed: int = 0) -> PointCloud:
    x, y = np.random.default_rng(seed).uniform(-1.5, 1.5, size=(2, count))
    z = 0.3 * np.sin(3 * x) + 0.4 * np.cos(2 * y) * x
    return PointCloud(np.column_stack([x, y, z]), viewpoint=np.array([0.0, 0.0, 30.0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clouds of one surface, and the motion between them."""
    path = tmp_path_factory.mktemp("clouds")
    write_cloud(path / "target.npz", sheet())
    write_cloud(path / "source.npz", transforms.move(transforms.invert(MOTION), sheet(seed=1)))
    write_transform(path / "pose.txt", MOTION)
    return path


@pytest.fixture
def clouds(folder: Path) -> list[str]:
    return [str(folder / "source.npz"), str(folder / "target.npz")]


def test_describe_writes_points_with_their_features(folder: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "features.npz"
    assert cli.main(["describe", str(folder / "target.npz"), "-o", str(output), *OPTIONS]) == 0
    with np.load(output) as arrays:
        assert arrays["features"].shape == (len(arrays["points"]), 33)
        assert arrays["features"].dtype == np.float32
        assert arrays["normals"].shape == arrays["points"].shape
        assert len(arrays["indices"]) == len(arrays["points"])
        assert json.loads(str(arrays["settings"]))["voxel_size"] == 0.1
    said = capsys.readouterr()
    assert said.out == ""
    assert "Model indoor: the larger cloud spans" in said.err
    assert "by 33 values." in said.err


def test_describe_writes_every_point_of_the_file_where_asked_to(folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "features.npz"
    assert cli.main(["describe", str(folder / "target.npz"), "-o", str(output), "--all-points", *OPTIONS]) == 0
    with np.load(output) as arrays, np.load(folder / "target.npz") as cloud:
        np.testing.assert_array_equal(arrays["points"], cloud["points"][arrays["indices"]])
        assert arrays["features"].shape == (len(arrays["points"]), 33)
        assert len(arrays["points"]) > 0.95 * len(cloud["points"])
        assert arrays["normals"].shape == arrays["points"].shape


def test_match_writes_what_the_pipeline_computes_to_the_last_digit(
    folder: Path, clouds: list[str], tmp_path: Path
) -> None:
    pose = str(folder / "pose.txt")
    for suffix in ("csv", "npz"):
        assert (
            cli.main(["match", *clouds, "--gt", pose, "-o", str(tmp_path / f"m.{suffix}"), "--mutual", *OPTIONS]) == 0
        )
    pair = pipeline.load_pair(folder / "source.npz", folder / "target.npz", gt=folder / "pose.txt")
    result = pipeline.run_pair(pair.source, pair.target, PairSettings(descriptor="fpfh", voxel_size=0.1, mutual=True))
    measured = match_errors(
        result.source, result.target, result.table,
        target_from_source=pair.target_from_source, tau=result.settings.tau,
    )  # fmt: skip
    chosen = result.correspondences
    expected = {
        "source_index": chosen.indices[:, 0],
        "target_index": chosen.indices[:, 1],
        "source_x": result.source.points[chosen.indices[:, 0], 0],
        "target_z": result.target.points[chosen.indices[:, 1], 2],
        "feature_distance": chosen.distances,
        "ratio": chosen.ratios,
        "mutual": np.ones(len(chosen)),
        "error": measured.errors[result.rows],
        "has_partner": measured.has_partner[result.rows],
    }
    with (tmp_path / "m.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 100
    with np.load(tmp_path / "m.npz") as arrays:
        assert list(arrays) == list(rows[0])
        for name, values in expected.items():
            np.testing.assert_array_equal(arrays[name], values)
            np.testing.assert_array_equal([float(row[name]) for row in rows], values.astype(np.float64))


def test_match_reports_precision_under_the_pose(folder: Path, clouds: list[str], tmp_path: Path, capsys) -> None:
    arguments = ["match", *clouds, "--gt", str(folder / "pose.txt"), "-o", str(tmp_path / "m.csv"), *OPTIONS]
    assert cli.main(arguments) == 0
    said = capsys.readouterr().err
    assert "Precision within 0.1: " in said
    assert "has a partner within 0.075; inlier ratio " in said


def test_match_without_a_pose_has_no_errors(clouds: list[str], tmp_path: Path, capsys) -> None:
    assert cli.main(["match", *clouds, "-o", str(tmp_path / "m.npz"), *OPTIONS]) == 0
    assert "Precision" not in capsys.readouterr().err
    with np.load(tmp_path / "m.npz") as arrays:
        assert np.isnan(arrays["error"]).all()
        assert not arrays["has_partner"].any()


def test_register_prints_and_writes_the_pose(folder: Path, clouds: list[str], tmp_path: Path, capsys) -> None:
    output, pose = tmp_path / "pose.txt", str(folder / "pose.txt")
    assert cli.main(["register", *clouds, "--gt", pose, "-o", str(output), *OPTIONS]) == 0
    lines = capsys.readouterr().out.splitlines()
    found = read_transform(output)
    np.testing.assert_allclose(np.array([line.split() for line in lines[:4]], dtype=float), found, rtol=1e-8, atol=1e-8)
    assert transforms.rotation_error_deg(found, MOTION) < 2
    assert lines[4].startswith("fitness 1.0000, ")
    assert ", rmse 0.0" in lines[4]
    assert lines[4].endswith("correspondences agree")
    assert lines[5].startswith("rotation error ")
    assert "degrees, translation error 0.0" in lines[5]


def test_register_by_another_method(clouds: list[str], tmp_path: Path) -> None:
    output = tmp_path / "pose.txt"
    assert cli.main(["register", *clouds, "--method", "fgr", "--no-refine", "-o", str(output), *OPTIONS]) == 0
    assert transforms.rotation_error_deg(read_transform(output), MOTION) < 2


def test_register_by_icp_alone_starts_where_it_is_told_and_computes_no_features(
    clouds: list[str], tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr(pipeline, "describe", None)
    start, output = tmp_path / "start.txt", tmp_path / "pose.txt"
    write_transform(start, MOTION @ transforms.rigid(transforms.rotation_about([0, 0, 1], 0.02), [0.01, 0.0, 0.0]))
    arguments = ["register", *clouds, "--method", "icp", "--initial", str(start), "--iterations", "30"]
    assert cli.main([*arguments, "--metric", "point", "-o", str(output), *OPTIONS]) == 0
    assert transforms.rotation_error_deg(read_transform(output), MOTION) < 0.5
    assert "correspondences" not in capsys.readouterr().out


def test_icp_from_a_start_that_is_too_far_says_so(clouds: list[str], tmp_path: Path, capsys) -> None:
    start = tmp_path / "start.txt"
    write_transform(start, transforms.rigid(np.eye(3), [1000.0, 0.0, 0.0]))
    assert cli.main(["register", *clouds, "--method", "icp", "--initial", str(start), *OPTIONS]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "come within 0.15 of the target from this start; give a better --initial or a larger" in said.err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--method", "magic"], "--method must be one of fgr, icp, ransac, got magic"),
        (["--iterations", "0"], "--iterations must be at least 1, got 0"),
        (["--inlier-distance", "-1"], "--inlier-distance must be positive, got -1"),
        (["--initial", "x.txt"], "--initial must come with --method icp, got ransac, which needs no start"),
    ],
)
def test_register_refuses_settings_that_make_no_sense(
    clouds: list[str], capsys, options: list[str], sentence: str
) -> None:
    assert cli.main(["register", *clouds, *options]) == 2
    assert capsys.readouterr().err.strip() == f"cgf register: {sentence}"


def test_register_fails_with_a_line_where_nothing_agrees(tmp_path: Path, capsys) -> None:
    points = np.random.default_rng(0).normal(size=(12, 3))
    write_cloud(tmp_path / "a.npz", PointCloud(points))
    write_cloud(tmp_path / "b.npz", PointCloud(-(points[::-1] ** 3)))
    output = tmp_path / "pose.txt"
    clouds = [str(tmp_path / "a.npz"), str(tmp_path / "b.npz")]
    arguments = [*clouds, "--descriptor", "fpfh", "--model", "object", "--radius", "5", "--voxel", "0", "--mutual"]
    assert cli.main(["register", *arguments, "-o", str(output)]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "Warning: No motion was found that enough of the" in said.err
    assert not output.exists()


def test_quiet_leaves_results_only(clouds: list[str], capsys) -> None:
    assert cli.main(["register", *clouds, "--quiet", *OPTIONS]) == 0
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 5
    assert said.err == ""


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--radius", "0.001"], "cgf match: --radius must be above the point spacing (0.1), got 0.001; try 1.1"),
        (["--voxel", "1.5"], "cgf match: --voxel must be below the radius (1.08), got 1.5; try 0.036"),
        (["--dim", "32"], "cgf match: --dim must be one of 33 with --descriptor fpfh, got 32"),
        (["--ratio", "2"], "cgf match: --ratio must be above 0 and at most 1, got 2; try 0.9"),
        (["-o", "matches.txt"], "cgf match: output must end in .csv or .npz, got matches.txt"),
        (
            ["-o", "no/folder/matches.csv"],
            "cgf match: no/folder/matches.csv cannot be written: there is no folder no/folder; create it first",
        ),
    ],
)
def test_bad_settings_are_one_line_and_status_two(
    clouds: list[str], tmp_path: Path, capsys, arguments: list[str], sentence: str
) -> None:
    output = tmp_path / "m.csv"
    assert cli.main(["match", *clouds, "-o", str(output), *OPTIONS, *arguments]) == 2
    assert capsys.readouterr().err == sentence + "\n"
    assert not list(tmp_path.iterdir())


def test_a_missing_cloud_is_one_line_that_names_it(tmp_path: Path, capsys) -> None:
    assert cli.main(["register", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("cgf register: ")
    assert "a.ply" in said


def test_a_pose_that_is_not_rigid_is_one_line(clouds: list[str], tmp_path: Path, capsys) -> None:
    (tmp_path / "pose.txt").write_text("2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n")
    assert cli.main(["register", *clouds, "--gt", str(tmp_path / "pose.txt")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "pose.txt" in said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "cgf: the following arguments are required: COMMAND; see cgf --help"),
        (
            ["match", "a.ply", "b.ply"],
            "cgf match: the following arguments are required: -o/--output; see cgf match --help",
        ),
        (
            ["register", "a", "b", "--dim", "many"],
            "cgf register: argument --dim: invalid int value: 'many'; see cgf register --help",
        ),
    ],
)
def test_bad_arguments_are_one_line_and_status_two(arguments: list[str], sentence: str, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert capsys.readouterr().err == sentence + "\n"


def test_what_is_not_given_keeps_the_default() -> None:
    parser = argparse.ArgumentParser()
    cli.add_feature_options(parser)
    assert cli.feature_settings(parser.parse_args([])) == PairSettings()
    given = cli.feature_settings(
        parser.parse_args(["--radius", "2", "--voxel", "0", "--model", "indoor", "--dim", "8"])
    )
    assert given == PairSettings(support_radius=2.0, voxel_size=0.0, model="indoor", dim=8)


def test_diagnose_says_what_is_wrong_and_what_to_try(folder: Path, clouds: list[str], tmp_path: Path, capsys) -> None:
    assert cli.main(["diagnose", *clouds, "--gt", str(folder / "pose.txt"), *OPTIONS, "--all"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("Nothing wrong found: the clouds register")
    assert "Fine (overlap):" in said
    source = transforms.move(transforms.invert(MOTION), sheet(seed=1))
    write_cloud(tmp_path / "millimetres.npz", replace(source, points=1000 * source.points))
    assert cli.main(["diagnose", str(tmp_path / "millimetres.npz"), clouds[1], "--descriptor", "fpfh"]) == 0
    said = capsys.readouterr()
    assert "Problem (input): " in said.out
    assert "--source-scale 0.001" in said.out
    assert "--all shows them" in said.err


def test_diagnose_prints_json(clouds: list[str], capsys) -> None:
    assert cli.main(["diagnose", *clouds, *OPTIONS, "--json", "--quiet"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["outcome"] == "registered"
    assert {finding["kind"] for finding in told["findings"]} >= {"scale", "normals", "overlap"}

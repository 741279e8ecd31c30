"""Weights of one's own, from the command line; and the commands evaluate and train."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cgf import cli
from cgf.datasets.demo import load_demo
from cgf.descriptors.network import Network, read_network, shipped_weights, write_network
from cgf.io import write_cloud
from tests.judging import write_judging


@pytest.fixture
def clouds(tmp_path):
    rng = np.random.default_rng(0)
    pair = load_demo()
    write_cloud(tmp_path / "a.npz", pair.source.take(np.sort(rng.permutation(len(pair.source))[:800])))
    return [str(tmp_path / "a.npz")]


def test_own_weights_are_used_with_the_lengths_of_their_card(clouds, tmp_path):
    network = read_network(shipped_weights("cgf-object"))
    own = Network(replace(network.card, support_radius=0.3, min_radius=0.02), network.weights)
    write_network(tmp_path / "own.safetensors", own)
    output = tmp_path / "f.npz"
    arguments = ["--weights", str(tmp_path / "own.safetensors"), "--dim", "16", "--voxel", "0"]
    assert cli.main(["describe", clouds[0], "-o", str(output), *arguments]) == 0
    stored = np.load(output)
    settings = json.loads(str(stored["settings"]))
    assert stored["features"].shape[1] == 16
    assert settings["support_radius"] == pytest.approx(0.3 * settings["diameter"])


def test_match_writes_the_quality_of_both_features_of_the_surest_matches(tmp_path):
    pair = load_demo()
    paths = [str(tmp_path / name) for name in ("a.npz", "b.npz")]
    for path, cloud in zip(paths, (pair.source, pair.target), strict=True):
        write_cloud(path, cloud)
    weights = ["--weights", str(write_judging(tmp_path / "judging.safetensors")), "--voxel", "0.1"]
    for name, more in (("all", []), ("some", ["--surest", "0.2"])):
        assert cli.main(["match", *paths, "-o", str(tmp_path / f"{name}.npz"), *weights, *more]) == 0
    every, kept = (dict(np.load(tmp_path / f"{name}.npz")) for name in ("all", "some"))
    trust = every["source_quality"] * every["target_quality"] * np.exp(-4 * every["feature_distance"])
    rows = np.sort(np.argsort(-trust, kind="stable")[: round(0.2 * len(trust))])
    for name, values in kept.items():
        np.testing.assert_array_equal(values, every[name][rows])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--descriptor", "fpfh"], "--weights must go with --descriptor cgf, got fpfh"),
        (["--model", "indoor"], "--model must fit --weights, which are for object, got indoor"),
        (["--dim", "7"], "--dim must be one of 8, 16"),
    ],
)
def test_own_weights_that_do_not_fit_are_refused(clouds, tmp_path, capsys, arguments, message):
    weights = str(shipped_weights("cgf-object"))
    assert cli.main(["describe", clouds[0], "-o", str(tmp_path / "f.npz"), "--weights", weights, *arguments]) == 2
    assert message in capsys.readouterr().err


def test_missing_weights_are_named(clouds, tmp_path, capsys):
    path = str(tmp_path / "none.safetensors")
    assert cli.main(["describe", clouds[0], "-o", str(tmp_path / "f.npz"), "--weights", path]) == 2
    assert f"got no file {path}" in capsys.readouterr().err


def test_evaluate_prints_a_row_for_every_descriptor_and_writes_every_pair(tmp_path, capsys):
    output = tmp_path / "scores.json"
    assert cli.main(["evaluate", "demo", "--descriptors", "cgf-8", "cgf-32", "-o", str(output)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "demo, 1 pair"
    assert [line.split()[0] for line in printed[2:4]] == ["cgf-8", "cgf-32"]
    scores = json.loads(output.read_text())["demo"]
    assert [score["dim"] for score in scores] == [8, 32]
    assert f"{100 * scores[1]['precision']:.1f} %" in printed[3]
    # More dimensions tell more points apart.
    assert scores[1]["precision_in_tau"] > scores[0]["precision_in_tau"] + 0.05


def test_evaluate_finds_out_what_a_folder_holds(shared, capsys):
    data = shared / "data"
    folders = [
        data / "objects/fgr_level_01",
        data / "indoor/3dmatch/sun3d-mit_lab_hj-lab_hj_tea_nov_2_2012_scan1_erika",
    ]
    assert cli.main(["evaluate", *map(str, folders), "--descriptors", "fpfh", "--pairs", "1"]) == 0
    titles = [line for line in capsys.readouterr().out.splitlines() if line.endswith("1 pair")]
    assert titles == [f"{folder.name}, 1 pair" for folder in folders]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["evaluate", "demo", "--descriptors", "cgf-x"],
            "must be names such as cgf-32 or fpfh, got cgf-x",
        ),
        (["evaluate", "demo", "--descriptors", "shot-9"], "--descriptor must be one of cgf, fpfh, pca, got shot"),
        (["evaluate", "demo", "--pairs", "0"], "--pairs must be 1 or more, got 0"),
        (["evaluate", "nowhere"], "nowhere must be a folder, got no such folder"),
        (["train", "-o", "a.safetensors"], "one of --meshes and --scenes must be given, got neither"),
        (["train", "-o", "no/a.safetensors", "--meshes", "m"], "there is no folder no; create it"),
        (["train", "-o", "a.safetensors", "--meshes", "nowhere"], "--meshes must be a folder of meshes"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, message):
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1

"""`cgf evaluate --suite paper`: what it measures, keeps, and writes."""

import json
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cgf import cli
from cgf.checks import InputError
from cgf.datasets.demo import find_demo
from cgf.descriptors.network import NetworkCard, read_network, shipped_weights, write_network
from cgf.evaluation.suite import curves, report
from cgf.evaluation.suite.perturbation import Perturbation, perturb, perturbations
from cgf.evaluation.suite.rows import Row, applies, find_rows, fingerprint, measured_dims
from cgf.evaluation.suite.running import run_suite
from cgf.evaluation.suite.scoring import THRESHOLDS, Scorer, sample_rows
from cgf.evaluation.suite.sets import SETS, TEST_SCENES, PairGroup, find_groups
from cgf.evaluation.suite.summary import TEST_PAIRS, measures_of, summarise
from cgf.geometry.transforms import rigid
from cgf.pipeline import PairSettings
from cgf.types import PointCloud

ROOT = Path(__file__).resolve().parents[2]
PCA = Row("pca", "indoor", PairSettings(model="indoor", descriptor="pca", dim=32), (8, 32), title="PCA")
LENGTHS = {"voxel_size": 0.1, "normal_radius": 0.2, "hole_radius": 0.3}


def plane(count: int = 4000) -> PointCloud:
    points = np.random.default_rng(0).uniform(-1, 1, size=(count, 3)) * (1, 1, 0)
    return PointCloud(points, normals=np.tile((0.0, 0.0, -1.0), (count, 1)))


def changed(change: str, amount: float = 0.0) -> PointCloud:
    return perturb(plane(), Perturbation(change, amount), **LENGTHS, rng=np.random.default_rng(1))


def test_noise_is_in_voxels_and_normals_keep_their_side() -> None:
    noisy = changed("noise", 0.5)
    np.testing.assert_allclose(np.std(noisy.points[:, 2]), 0.05, rtol=0.05)
    assert noisy.normals is not None
    assert np.median(noisy.normals[:, 2]) < -0.9
    assert not np.array_equal(noisy.normals, plane().normals)


@pytest.mark.parametrize(("change", "amount", "left"), [("density", 0.1, 400), ("holes", 0.25, 3000)])
def test_points_are_lost_in_the_share_asked_for(change: str, amount: float, left: int) -> None:
    assert len(changed(change, amount)) == left


def test_holes_are_whole_balls() -> None:
    cloud, left = plane(), changed("holes", 0.25)
    lost = np.setdiff1d(
        np.arange(len(cloud)), [np.flatnonzero((cloud.points == p).all(axis=1))[0] for p in left.points]
    )
    apart = np.linalg.norm(cloud.points[lost, None] - left.points[None], axis=2).min(axis=1)
    # Random points of a plane as dense as this have a neighbour within 0.05.
    assert np.quantile(apart, 0.5) > 0.05


@pytest.mark.parametrize("change", ["none", "radius"])
def test_other_changes_leave_the_points_alone(change: str) -> None:
    np.testing.assert_array_equal(changed(change, 0.7).points, plane().points)


def test_labels_of_changes_are_different() -> None:
    labels = [change.label for change in perturbations()]
    assert len(set(labels)) == len(labels)
    assert Perturbation("density", 0.25).label == "points kept 25 %"


def itself(pose: np.ndarray | None = None, name: str = "rooms") -> PairGroup:
    """The demo's target with itself."""
    files = find_demo()
    pose = np.eye(4) if pose is None else pose
    return PairGroup(name, "demo", "indoor", (replace(files, source=files.target, target_from_source=pose),))


def test_a_cloud_matches_itself() -> None:
    (pair,) = itself().pairs
    scores = Scorer().score(pair, itself(), PCA)
    wide = scores["dims"]["32"]
    assert wide["partners"] > 3000
    assert wide["curve"] == wide["near"] == [1.0] * len(THRESHOLDS["indoor"])
    assert wide["inlier_ratio"] == 1.0
    assert wide["sure"] == {"distance": [1.0, 1.0], "ratio": [1.0, 1.0]}


def test_under_a_wrong_pose_no_match_is_right() -> None:
    group = itself(rigid(np.eye(3), (20.0, 0.0, 0.0)))
    wide = Scorer().score(group.pairs[0], group, PCA)["dims"]["32"]
    assert wide["inlier_ratio"] == 0.0
    assert wide["partners"] == 0
    assert wide["curve"] == [None] * len(THRESHOLDS["indoor"])


def test_recall_sets_measure_no_precision() -> None:
    group = itself(name="lomatch")
    assert set(Scorer().score(group.pairs[0], group, PCA)["dims"]["32"]) == {"inlier_ratio"}


def test_samples_depend_on_the_cloud_alone() -> None:
    cloud = plane(6000)
    rows = sample_rows(cloud, Path("a/b.ply"))
    np.testing.assert_array_equal(rows, sample_rows(cloud, Path("elsewhere/a/b.ply")))
    assert len(rows) == len(np.unique(rows)) == 5000
    assert not np.array_equal(rows, sample_rows(cloud, Path("a/c.ply")))
    np.testing.assert_array_equal(sample_rows(plane(30), Path("a/b.ply")), np.arange(30))


def test_recall_counts_pairs_above_the_inlier_ratio() -> None:
    measures = measures_of([{"inlier_ratio": value} for value in (0.04, 0.05, 0.1, 0.3)], "indoor")
    assert (measures["recall_5"], measures["recall_20"]) == (0.5, 0.25)
    assert measures["inlier_ratio"] == pytest.approx(0.1225)


def result(
    key: str, group: str, scores: dict[str, dict], *, row: str = "cgf", model: str = "indoor", dims: tuple = (32,)
) -> dict:
    labels = {str(dim): f"{row}-{dim}" if row != "fpfh" else row for dim in dims}
    pairs = [{"pair": name, "dims": dict.fromkeys(labels, score)} for name, score in scores.items()]
    common = {"variant": "", "labels": labels, "described": 2000, "describe_s": 0.5}
    return {"set": key, "group": group, "model": model, "row": row, "pairs": pairs, **common}


def curve(value: float, count: int, **more: object) -> dict:
    return {"curve": [value] * count, "near": [value] * count, "sure": {"ratio": [value, value / 2]}, **more}


def test_scenes_count_the_same_whatever_their_number_of_pairs() -> None:
    first, second = TEST_SCENES
    low, high = curve(0.2, 8, inlier_ratio=0.1), curve(0.8, 8, inlier_ratio=0.3)
    results = [result("rooms", first, dict.fromkeys("abc", low)), result("rooms", second, {"d": high})]
    (summary,) = summarise(results)
    assert summary.mean["precision"] == pytest.approx(0.5)
    assert (summary.mean["recall_5"], summary.mean["recall_20"]) == (1.0, 0.5)
    assert summary.mean["pairs"] == 4
    assert summary.parts[first]["precision"] == pytest.approx(0.2)
    assert summary.describe_ms == pytest.approx(250)


def test_validation_pairs_are_left_out_of_the_test_pairs() -> None:
    scores = {"pair_05": curve(0.2, 9), "pair_06": curve(0.8, 9), "pair_10": curve(0.8, 9), "pair_11": curve(0.4, 9)}
    (summary,) = summarise([result("fgr", "fgr", scores, model="object")])
    assert summary.mean["precision"] == pytest.approx(0.55)
    assert summary.parts[TEST_PAIRS]["precision"] == pytest.approx(0.3)
    assert summary.parts[TEST_PAIRS]["pairs"] == 2


def test_pairs_without_a_partner_do_not_count_in_precision() -> None:
    nothing = {"curve": [None] * 9, "near": [None] * 9, "sure": {}}
    measures = measures_of([nothing, {**curve(0.4, 9), "sure": {}}], "object")
    assert measures["precision"] == pytest.approx(0.4)
    assert math.isnan(measures_of([nothing], "object")["precision"])


def some_summaries() -> list:
    first, second = TEST_SCENES
    results = []
    for row, dims, level in (
        ("cgf", (8, 32), 0.6),
        ("paper-32", (32,), 0.4),
        ("own", (32,), 0.3),
        ("fpfh", (33,), 0.2),
    ):
        scores = {"pair_01": curve(level, 9), "pair_02": curve(level, 9)}
        results.append(result("fgr", "fgr", scores, row=row, model="object", dims=dims))
        for key in ("rooms", "lomatch"):
            for scene in (first, second):
                indoor = curve(level, 8, inlier_ratio=level) if key == "rooms" else {"inlier_ratio": level}
                results.append(result(key, scene, {"a": indoor}, row=row, dims=dims))
    for model, count in (("object", 9), ("indoor", 8)):
        for row, dim in (("cgf", 32), ("fpfh", 33)):
            for change in perturbations():
                scores = {"a": curve(0.5, count)}
                results.append(
                    result("robustness", f"{model}: {change.label}", scores, row=row, model=model, dims=(dim,))
                )
    results.append(result("cross", "one", {"a": {"inlier_ratio": 0.3}}, row="cross-a"))
    results.append(result("cross", "two", {"a": {"inlier_ratio": 0.01}}, row="cross-b"))
    return summarise(results)


TITLES = {"cgf": "CGF", "fpfh": "FPFH", "paper-32": "The paper's"}


def test_the_table_of_the_readme_has_the_best_in_bold() -> None:
    head, _, *lines = report.readme_table(some_summaries(), TITLES)
    assert head.count("|") == 7
    cells = {line.split(" | ")[0].strip("| "): line.strip("| ").split(" | ")[1:] for line in lines}
    assert list(cells) == [
        "CGF, 32 dimensions",
        "CGF, 8 dimensions",
        "The paper's, 32 dimensions",
        "FPFH, 33 dimensions",
    ]
    assert cells["CGF, 32 dimensions"] == ["**60.0**", "**60.0**", "**100.0**", "**100.0**", "**100.0**"]
    assert cells["FPFH, 33 dimensions"][0] == "20.0"


def test_the_document_has_all_rows_and_sections() -> None:
    text = report.document(some_summaries(), TITLES)
    assert "own, 32 dimensions" in text
    for section in ("All sets", "Objects", "Surest matches", "Robustness", "Cross-validation", "Time"):
        assert f"### {section}\n" in text
    assert "| mean over 2 scenes | 50.0 |" in text
    assert "| two (1 pair, cross-b) | 0.0 |" in text
    # Every line of a table has as many cells as its head.
    for table in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        assert len({line.count("|") for line in table.splitlines()}) == 1


@pytest.mark.parametrize("draw", [curves.threshold_plot, curves.dimension_plot, curves.robustness_plot])
def test_plots_are_svg_with_a_line_for_each_row(draw) -> None:
    root = ET.fromstring(draw(some_summaries()))
    assert root.tag.endswith("svg")
    texts = ["".join(node.itertext()) for node in root.iter() if node.tag.endswith("text")]
    assert any(text.startswith("CGF") for text in texts)
    assert "FPFH" in texts
    assert not any("own" in text for text in texts)
    lines = [node for node in root.iter() if node.tag.endswith("polyline")]
    assert all("nan" not in node.get("points", "") for node in lines)
    assert len(lines) >= 4


def test_documents_and_cards_are_updated(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    for name in ("README.md", "docs/results.md"):
        (tmp_path / name).write_text((ROOT / name).read_text("utf-8"), "utf-8")
    weights = tmp_path / "own.safetensors"
    write_network(weights, read_network(shipped_weights("cgf-object")))
    row = Row("own", "object", PairSettings(model="object"), (32,), weights=weights)
    written = report.update_documents(tmp_path, some_summaries(), [row])
    assert "| cgf, 32 dimensions | **60.0** |" in (tmp_path / "README.md").read_text("utf-8")
    assert "### Robustness" in (tmp_path / "docs/results.md").read_text("utf-8")
    card = NetworkCard.from_json(weights.with_suffix(".json").read_text("utf-8"), source="card")
    assert card.scores == {"FGR level 1, within 1 % of the diameter, 32 dimensions": 30.0}
    assert set(written) >= {tmp_path / "README.md", tmp_path / "docs/results-robustness.svg", tmp_path / "own.json"}
    assert "At most" not in (tmp_path / "README.md").read_text("utf-8")
    report.update_documents(tmp_path, some_summaries(), [row], limit=24)
    for name in ("README.md", "docs/results.md"):
        assert "At most 24 pairs of each set and scene, evenly spread.\n" in (tmp_path / name).read_text("utf-8")
    (tmp_path / "README.md").write_text("text", "utf-8")
    with pytest.raises(
        InputError, match=r"README\.md must have the lines <!-- made by: cgf evaluate .* got no such lines"
    ):
        report.update_documents(tmp_path, some_summaries(), [row])


def test_rows_are_measured_only_where_they_were_not_trained() -> None:
    seen, unseen = (PairGroup("cross", scene, "indoor", ()) for scene in ("sun3d-a", "sun3d-b"))
    cross = replace(PCA, name="cross-a", trained_on="sun3d-a, sun3d-c")
    assert not applies(cross, seen)
    assert applies(cross, unseen)
    assert not applies(PCA, unseen)
    assert not applies(cross, PairGroup("rooms", "sun3d-b", "indoor", ()))
    assert not applies(PCA, PairGroup("fgr", "fgr", "object", ()))
    radius = next(row for row in find_rows() if row.name == "fpfh" and not row.is_default)
    assert applies(radius, PairGroup("radii", "any", radius.model, ()))
    assert not applies(radius, PairGroup("fgr", "fgr", radius.model, ()))


def test_weights_in_a_folder_are_rows_of_both_models(tmp_path: Path) -> None:
    for model in ("object", "indoor"):
        network = read_network(shipped_weights(f"cgf-{model}"))
        card = replace(network.card, training={"label": "With frame", "place": 2})
        write_network(tmp_path / f"frame-{model}.safetensors", replace(network, card=card))
    write_network(
        tmp_path / "first-object.safetensors", replace(network, card=replace(card, model="object", training={}))
    )
    found = find_rows(tmp_path)
    assert [row.name for row in found if row.weights and row.weights.parent == tmp_path] == ["first", "frame", "frame"]
    rows = [row for row in found if row.name == "frame"]
    assert {row.model for row in rows} == {"object", "indoor"}
    assert {row.title for row in rows} == {"With frame"}
    assert rows[0].dims == (8, 16, 32)
    assert measured_dims(rows[0], PairGroup("rooms", "a", "indoor", ())) == (32,)
    own = next(row for row in find_rows() if row.name == "cgf" and row.model == rows[0].model)
    # The same weights give the same features, in other dimensions.
    assert fingerprint(replace(rows[0], dims=own.dims)) == fingerprint(own)


def test_missing_data_and_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--data must be the folder of the benchmark data, got nowhere"):
        find_groups(Path("nowhere"))
    with pytest.raises(InputError, match=r"indoor/3dmatch must have scenes with a gt\.log, got none; check --data"):
        find_groups(tmp_path, ["rooms"])
    with pytest.raises(InputError, match="--weights-folder must be a folder of weights, got nowhere"):
        find_rows(Path("nowhere"))


def test_a_stopped_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    groups, told = [itself(name="lomatch")], []
    first = run_suite(groups, [PCA], tmp_path, told=told.append)
    assert re.fullmatch(r"lomatch, demo, 1 pair: pca-32: recall at 5 % 100.0 %, recall at 20 % 100.0 %", told[0])

    def fail(*_: object) -> None:
        raise AssertionError("scored again")

    monkeypatch.setattr(Scorer, "score", fail)
    assert run_suite(groups, [PCA], tmp_path) == first
    with pytest.raises(AssertionError, match="scored again"):
        run_suite([itself(rigid(np.eye(3), (0.1, 0, 0)), "lomatch")], [PCA], tmp_path)


def test_the_command_measures_pairs_of_both_models(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "evaluate",
        "--suite",
        "paper",
        "--data",
        str(shared / "data"),
        "--only",
        "demo",
        "fgr",
        "--pairs",
        "1",
    ]
    arguments += ["--kept", str(tmp_path / "kept"), "-o", str(tmp_path / "all.json"), "--quiet"]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "| | FGR level 1, within 1 % of the diameter | demo, within 7.5 cm |" in printed
    summaries = json.loads((tmp_path / "all.json").read_text())["summaries"]
    reached = {(summary["set"], summary["label"]): summary["mean"] for summary in summaries}
    for key in ("demo", "fgr"):
        assert (
            reached[key, "cgf-32"]["precision"] > reached[key, "cgf-8"]["precision"] > reached[key, "fpfh"]["precision"]
        )
    shares = [reached["fgr", "cgf-32"]["precision"], reached["demo", "cgf-32"]["near"][2]]
    line = f"| CGF, 32 dimensions | {' | '.join(f'{100 * share:.1f}' for share in shares)} |"
    assert line in printed.replace("**", "")  # Of the best of each column.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demo", "--suite", "paper"], "DATA must go without --suite, got both; give --data or --weights-folder"),
        (
            ["--suite", "paper", "--data", "x", "--quick", "--update"],
            "--update must go without --quick; two pairs of each",
        ),
        (["--suite", "paper", "--data", "nowhere"], "--data must be the folder of the benchmark data, got nowhere"),
        ([], "DATA must be given, or --suite"),
    ],
)
def test_bad_options_are_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["evaluate", *arguments]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_all_sets_are_found(shared: Path) -> None:
    # Happy Buddha has a test of its own; to find its pairs, all scans have to be read.
    only = [name for name in SETS if name != "happy"]
    groups = find_groups(shared / "data", only, limit=2)
    assert {group.set for group in groups} == set(only)
    assert len([group.name for group in groups if group.set == "cross"]) == 7
    assert {group.name for group in groups if group.set in ("rooms", "lomatch")} == set(TEST_SCENES)
    assert {len(group.pairs) for group in groups} == {1, 2}
    assert not {group.name for group in groups if group.set == "radii"} & set(TEST_SCENES)

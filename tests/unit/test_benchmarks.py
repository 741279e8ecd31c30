"""`python -m benchmarks` runs, with and without what it compares with."""

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks import inputs, report
from benchmarks.__main__ import main
from benchmarks.groups import Group, Row
from benchmarks.straight import find_neighbors, straight_histograms
from benchmarks.timing import Timing
from cgf.descriptors.spherical_histogram import histogram_grid

ROOT = Path(__file__).resolve().parents[2]


def test_the_command_runs_on_the_demo_without_its_peers(tmp_path: Path) -> None:
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    for name in ("faiss", "hnswlib", "sklearn"):
        (hidden / f"{name}.py").write_text("raise ModuleNotFoundError('hidden')", "utf-8")
    environment = {key: value for key, value in os.environ.items() if key != "CGF_SHARED"}
    environment |= {"PYTHONPATH": str(hidden), "PATH": str(tmp_path)}
    command = [sys.executable, "-m", "benchmarks", "--quick", "--only", "neighbors", "dense"]
    command += ["--output", str(tmp_path / "out"), "--cache", str(tmp_path / "cache")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "absent; apt-get install g++ pkg-config libpcl-dev" in done.stdout
    assert "absent; uv sync --inexact --group bench" in done.stdout
    results = json.loads((tmp_path / "out" / "results.json").read_text("utf-8"))
    search, dense = results["groups"]
    measured = {row["name"]: row["timing"] is not None for row in search["rows"]}
    assert measured["32 dimensions: both directions, two nearest"]
    assert measured["32: SciPy cKDTree"]
    assert not measured["32: FLANN, one k-d tree"]
    assert not measured["32: faiss IndexFlatL2"]
    assert [row["timing"] for row in dense["rows"]] == [None]
    assert ET.parse(tmp_path / "out" / "plot.svg").getroot().tag.endswith("svg")
    assert "| 32: faiss IndexFlatL2 |" in (tmp_path / "out" / "table.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--data", "nowhere"], "--data must be a folder, got nowhere"),
        (["--repeats", "0"], "--repeats must be at least 1, got 0"),
    ],
)
def test_unusable_options_are_refused(arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(arguments)
    assert sentence in capsys.readouterr().err


def test_the_straight_loop_is_the_histogram() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(800, 3))
    centers, frames = points[:20], np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(20)])
    neighbors, starts = find_neighbors(points, centers, 0.7)
    straight = straight_histograms(points, centers, frames, neighbors, starts, 0.7, 0.06)
    rows, counts = histogram_grid(points, support_radius=0.7, min_radius=0.06).histograms(centers, frames)
    np.testing.assert_array_equal(np.diff(starts) - 1, counts)
    # Single precision may put a neighbour on the other side of an edge.
    assert (np.abs(rows - straight).sum(axis=1) * counts / 2 <= 1.01).all()


@pytest.mark.parametrize("count", [50, 3458, 9000])
def test_a_resampled_scan_has_so_many_points_of_the_same_surface(count: int) -> None:
    cloud = inputs.load_scan(None).cloud
    result = inputs.resample(cloud, count)
    assert len(result) == count
    tree = cKDTree(cloud.points)
    assert tree.query(result.points)[0].max() <= tree.query(cloud.points, k=4)[0].max()
    assert len(np.unique(result.points, axis=0)) == count


@pytest.mark.parametrize(("value", "shown"), [(0.0123456, "0.0123"), (12.345, "12.3"), (1234.5, "1,234"), (0.0, "0")])
def test_figures_are_three(value: float, shown: str) -> None:
    row = Row("name", "s", Timing((value,), (value,)))
    assert report.cells(row)[2] == shown


@pytest.mark.parametrize(("ratio", "met"), [(2.0, "yes"), (1.9, "no")])
def test_what_is_reached_is_said(ratio: float, met: str) -> None:
    row = Row("peer", "s", Timing((1.0,), (1.0,)), ratio, 2.0)
    assert report.cells(row)[6] == met
    assert f"| {met} |" in report.markdown([Group("key", "Title", [row])])


def some_groups() -> list[Group]:
    ours = Row("cgf", "s", Timing((2.0, 1.0), (9.0, 9.0)), ours=True)
    peer = Row("peer", "s", Timing((4.0, 3.0), (9.0, 9.0)), 3.0, 2.0)
    missing = Row("other", "s", None, reach=2.0, note="absent; install it")
    shared = Row("cgf, 2 threads", "s", Timing((1.0,), (0.5,)), 1.9, 1.9, "times as fast", ours=True, by_clock=True)
    return [Group("describing", "Describing, on something", [ours, peer, missing, shared])]


def test_the_summary_has_a_line_for_each_row_of_ours() -> None:
    lines = report.summary(some_groups()).splitlines()[2:]
    assert lines == [
        "| Describing: cgf | 1.00 s | peer 3.00 (3.00 times) |",
        "| Describing: cgf, 2 threads | 0.500 s | 1.90 times as fast |",
    ]


def test_documents_are_updated_between_their_comments(tmp_path: Path) -> None:
    path = tmp_path / "a.md"
    begin, end = "<!-- made by: python -m benchmarks --update -->\n", "<!-- until here -->\nafter\n"
    path.write_text(f"before\n{begin}old\n{end}", "utf-8")
    for _ in range(2):
        report.update(path, "new\n")
        assert path.read_text("utf-8") == f"before\n{begin}\nnew\n\n{end}"


def test_a_document_without_the_comments_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.md"
    path.write_text("text", "utf-8")
    with pytest.raises(ValueError, match=r"a\.md must have the lines <!-- made by: .* -->, got no such lines"):
        report.update(path, "new")
    assert path.read_text("utf-8") == "text"


@pytest.mark.parametrize("name", ["README.md", "docs/performance.md"])
def test_the_documents_have_the_comments(name: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy.md"
    copy.write_text((ROOT / name).read_text("utf-8"), "utf-8")
    report.update(copy, "new")

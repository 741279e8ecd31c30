"""The command line: what it refuses, what it prints, how it ends."""

import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from app.main import build_parser as parser
from app.main import main, open_session
from cgf import io
from cgf.descriptors.network import shipped_weights
from cgf.types import PointCloud
from tests.app.scenes import LONG_S, hills

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with the hills as a.ply and b.ply, their true pose, and things that cannot be used."""
    pair = hills()
    assert pair.target_from_source is not None
    io.write_cloud(tmp_path / "a.ply", pair.source)
    io.write_cloud(tmp_path / "b.ply", pair.target)
    io.write_transform(tmp_path / "gt.txt", pair.target_from_source)
    np.savetxt(tmp_path / "sheared.txt", np.diag([1.0, 2.0, 1.0, 1.0]))
    (tmp_path / "empty.ply").write_bytes(b"")
    (tmp_path / "cut.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:2000])
    (tmp_path / "text.ply").write_text("hello")
    np.savetxt(tmp_path / "few.xyz", np.random.default_rng(0).normal(size=(4, 3)))
    np.savetxt(tmp_path / "equal.xyz", np.ones((50, 3)))
    np.savetxt(tmp_path / "line.xyz", np.outer(np.arange(50.0), [1.0, 2.0, 3.0]))
    broken = pair.source.points.copy()
    broken[7] = np.nan
    np.save(tmp_path / "nan.npy", broken)
    io.write_cloud(tmp_path / "millimetres.ply", PointCloud(pair.source.points * 1000, pair.source.normals))
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("a.ply missing.ply", r"missing\.ply"),
        ("a.ply empty.ply", r"empty\.ply"),
        ("a.ply cut.ply", r"cut\.ply"),
        ("a.ply text.ply", r"text\.ply"),
        ("a.ply few.xyz", r"few\.xyz must have 10 points or more, got 4"),
        ("a.ply equal.xyz", r"equal\.xyz must spread in space, got 50 points that are all equal"),
        ("a.ply line.xyz", r"line\.xyz must spread in space, got 50 points on one line"),
        (
            "a.ply nan.npy",
            r"nan\.npy must be finite, got 1 of \d+ rows with NaN or inf \(first at row 7\).*--drop-invalid",
        ),
        ("a.ply b.ply --gt sheared.txt", r"sheared\.txt must be rigid"),
        ("a.ply b.ply --gt missing.txt", r"missing\.txt"),
        ("a.ply b.ply --estimate sheared.txt", r"sheared\.txt must be rigid"),
        ("a.ply b.ply --radius 0.001", r"--radius must be above the point spacing"),
        ("a.ply b.ply --radius 100", r"--radius must be at most the diameter"),
        ("a.ply b.ply --voxel -1", r"--voxel must be 0"),
        ("a.ply b.ply --dim 5", r"--dim must be one of"),
        ("a.ply b.ply --descriptor sift", r"--descriptor must be one of"),
        ("a.ply b.ply --port 99999", r"--port must be from 0 to 65535, got 99999"),
        ("a.ply", r"cgf-viewer must be given two clouds, a folder of pairs, or --demo, got 1 path"),
        ("", r"cgf-viewer must be given two clouds, a folder of pairs, or --demo, got 0 paths"),
        ("--demo a.ply b.ply", r"--demo must stand without clouds and poses of your own"),
        (".", r"must have a gt\.log beside its clouds"),
        (". --estimate gt.txt", r"--estimate must come with two clouds, got a folder"),
        (". --viewpoint 0 0 0", r"--viewpoint must come with two clouds, got a folder"),
    ],
)
def test_bad_input_is_one_readable_line_and_status_2(
    files: Path, arguments: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    port = [] if "--port" in arguments else ["--port", "0"]
    assert main([*arguments.split(), *port, "--no-browser"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert re.match(rf"^cgf-viewer: .*{message}", captured.err), captured.err


def test_an_option_that_does_not_exist_is_one_line_and_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--no-such-option"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_millimetres_are_warned_of(files: Path) -> None:
    options = parser().parse_args([str(files / "millimetres.ply")] * 2)
    session = open_session(options)
    session.start()
    assert session.wait_until_idle(LONG_S)
    messages = [message.text for message in session.snapshot().messages]
    session.close()
    assert any("if this is a room in millimetres, say so with Unit mm" in text for text in messages)


def test_invalid_rows_can_be_dropped(files: Path) -> None:
    session = open_session(parser().parse_args([str(files / "nan.npy"), str(files / "b.ply"), "--drop-invalid"]))
    session.close()


def test_options_of_the_command_line_are_the_first_settings(files: Path) -> None:
    arguments = (
        f"{files}/a.ply {files}/b.ply --gt {files}/gt.txt --dim 16 --radius 0.7 --voxel 0.05 --mutual --ratio 0.9"
    )
    session = open_session(parser().parse_args([*arguments.split(), "--model", "indoor", "--descriptor", "cgf"]))
    settings = session.settings
    session.close()
    assert (settings.dim, settings.support_radius, settings.voxel_size) == (16, 0.7, 0.05)
    assert (settings.mutual, settings.max_ratio, settings.model) == (True, 0.9, "indoor")


def test_a_folder_offers_all_its_pairs(files: Path) -> None:
    pair = hills()
    assert pair.target_from_source is not None
    rows = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in pair.target_from_source)
    folder = files / "scene"
    folder.mkdir()
    for number, cloud in enumerate((pair.target, pair.source)):
        io.write_cloud(folder / f"cloud_bin_{number}.ply", cloud)
    (folder / "gt.log").write_text(f"0 1 2\n{rows}\n")
    session = open_session(parser().parse_args([str(folder)]))
    snapshot = session.snapshot()
    session.close()
    assert len(snapshot.pairs) == 1


@pytest.fixture
def start() -> Iterator[Callable[..., tuple["subprocess.Popen[str]", str]]]:
    """Starts the command in a process of its own and waits for its URL."""
    running: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> tuple["subprocess.Popen[str]", str]:
        code = "import sys; from app.main import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", code, *arguments, "--no-browser", "--port", "0"]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(r"cgf-viewer: (http://127\.0\.0\.1:\d+/[\w-]{32,}/)  \(Ctrl-C stops it\)\n", line)
        assert found, line or (process.stderr and process.stderr.read())
        return process, found.group(1)

    yield start
    for process in running:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("phase", ["working", "ready"])
def test_ctrl_c_ends_it_at_once_and_cleanly(
    start: Callable[..., tuple["subprocess.Popen[str]", str]], phase: str
) -> None:
    process, url = start("--demo")
    with urllib.request.urlopen(url + "api/events", timeout=LONG_S) as stream:
        # An open page keeps a connection; ending during the computation and after it have to be as quick.
        for line in stream:
            if f'"phase": "{phase}"'.encode() in line or b'"phase": "ready"' in line:
                break
        started = time.monotonic()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 0
    assert time.monotonic() - started < 5
    assert out == "\n"
    assert err == ""


def test_a_port_in_use_is_status_2_and_names_it(
    start: Callable[..., tuple["subprocess.Popen[str]", str]], capsys: pytest.CaptureFixture[str]
) -> None:
    _, url = start("--demo")
    port = url.split(":")[2].split("/")[0]
    assert main(["--demo", "--no-browser", "--port", port]) == 2
    assert capsys.readouterr().err == (
        f"cgf-viewer: port {port} is in use; choose another with --port, or stop the program that has it\n"
    )


@pytest.mark.skipif(sys.platform == "win32", reason="signals differ on Windows")
def test_it_ends_on_sigterm_too(start: Callable[..., tuple["subprocess.Popen[str]", str]]) -> None:
    process, _ = start("--demo")
    process.terminate()
    process.communicate(timeout=LONG_S)
    assert process.returncode in (0, -signal.SIGTERM)


def test_a_pose_found_elsewhere_is_the_estimate(files: Path) -> None:
    arguments = [f"{files}/a.ply", f"{files}/b.ply", "--estimate", f"{files}/gt.txt", "--radius", "0.8"]
    session = open_session(parser().parse_args(arguments))
    session.start()
    assert session.wait_until_idle(LONG_S)
    snapshot = session.snapshot()
    session.close()
    assert snapshot.reference == "estimate"
    assert snapshot.estimate is not None
    assert snapshot.estimate.given
    assert snapshot.command.startswith(f"cgf match {files}/a.ply {files}/b.ply --descriptor cgf --radius 0.8")


def test_own_weights_are_used_until_another_descriptor_is_chosen(files: Path) -> None:
    weights = shipped_weights("cgf-indoor")
    clouds = [str(files / "a.ply"), str(files / "b.ply")]
    session = open_session(parser().parse_args([*clouds, "--radius", "0.8", "--weights", str(weights)]))
    assert session.settings.pair_settings().weights == weights
    assert session.settings.changed({"descriptor": "fpfh"}, pairs=1).pair_settings().weights is None
    session.close()


@pytest.mark.parametrize("text", ["0", "-3", "many"])
def test_a_number_of_points_to_draw_must_be_one(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parser().parse_args(["--demo", f"--max-points={text}"])
    assert ended.value.code == 2
    assert f"--max-points: must be 1 or more, got '{text}'" in capsys.readouterr().err

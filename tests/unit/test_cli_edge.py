"""Where the commands meet the shell: statuses, lines about errors, Ctrl-C, and files that cannot be written."""

import importlib.metadata
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cgf import cli
from cgf.checks import InputError


def failing(error: BaseException) -> Callable[[], int]:
    def command() -> int:
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("a.ply is\nempty"), 2, "cgf: a.ply is empty"),
        (ValueError("radius must be positive, got 0"), 2, "cgf: radius must be positive, got 0"),
        (ValueError(), 2, "cgf: failed with ValueError; --debug shows where"),
        (KeyError("x"), 1, "cgf: failed with KeyError: 'x'; --debug shows where"),
        (MemoryError(), 1, "cgf: memory does not suffice; choose a larger --voxel"),
        (OSError(28, "No space left on device", "/tmp/a"), 1, "cgf: /tmp/a: No space left on device"),
        (KeyboardInterrupt(), 130, "cgf: interrupted"),
    ],
)
@pytest.mark.parametrize("debug", [False, True])
def test_the_edge_turns_what_is_raised_into_a_line_and_a_status(
    error: BaseException, status: int, line: str, debug: bool, capsys
) -> None:
    assert cli.run(failing(error), program="cgf", debug=debug) == status
    said = capsys.readouterr().err
    assert said.endswith(line + "\n")
    assert ("Traceback" in said) == debug
    if not debug:
        assert said == line + "\n"


def test_the_edge_passes_the_status_of_a_command_on() -> None:
    assert cli.run(lambda: 7, program="cgf", debug=False) == 7


def test_help_names_every_command_and_comes_before_heavy_libraries() -> None:
    code = "import sys\nfrom cgf.cli import main\ntry:\n    main(['--help'])\nfinally:\n    print(list(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for command in cli.COMMANDS:
        assert command.name in done.stdout
    loaded = done.stdout.splitlines()[-1]
    for heavy in ("numpy", "scipy", "torch", "open3d", "numba"):
        assert f"'{heavy}'" not in loaded


@pytest.mark.parametrize("installed", [True, False])
def test_the_version_is_printed(installed: bool, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def version(name: str) -> str:
        if not installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.2.3"

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("1.2.3" if installed else "unknown")


def started(code: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    )


def test_control_c_ends_at_once_with_one_line() -> None:
    process = started(
        "import sys, threading\nfrom cgf.cli import run\n"
        "def command():\n    print('ready', flush=True)\n    threading.Event().wait(60)\n    return 0\n"
        "sys.exit(run(command, program='cgf match', debug=False))"
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    begin = time.monotonic()
    os.kill(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode == 130
    assert said.strip() == "cgf match: interrupted"
    assert time.monotonic() - begin < 5


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    process = started(
        "import sys\nfrom cgf.cli import run\n"
        "def command():\n    sys.stdin.readline()\n    print('x' * 1_000_000)\n    return 0\n"
        "sys.exit(run(command, program='cgf', debug=False))"
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=20) == 1
    assert said == ""


def test_an_interrupted_export_leaves_no_half_file(tmp_path: Path) -> None:
    from cgf.evaluation.matches import write_whole

    output = tmp_path / "m.csv"
    output.write_text("before")

    def write(file) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(output, write)
    assert output.read_text() == "before"
    assert list(tmp_path.iterdir()) == [output]


def test_an_export_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    from cgf.evaluation.matches import write_whole

    (tmp_path / "taken.csv").mkdir()
    with pytest.raises(InputError, match=r"taken\.csv cannot be written: .*; choose another place"):
        write_whole(tmp_path / "taken.csv", lambda file: file.close())

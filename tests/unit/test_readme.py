"""What the README shows works as shown."""

import re
from pathlib import Path

import pytest

import cgf

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text("utf-8")


def blocks(*languages: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", README, flags=re.DOTALL | re.MULTILINE)
    return [text for language, text in fenced if language in languages]


def test_the_commands_are_those_that_are_tested() -> None:
    commands = "".join(blocks("sh"))
    assert ".venv/bin/uv run --frozen cgf-viewer --demo" in commands
    assert "bash tests/run" in commands
    assert "bash tests/run\n" in (ROOT / ".ci" / "run").read_text("utf-8")


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = blocks("python")
    pair = cgf.load_demo()
    cgf.write_cloud(tmp_path / "a.ply", pair.source)
    cgf.write_cloud(tmp_path / "b.ply", pair.target)
    monkeypatch.chdir(tmp_path)
    assert len([line for line in example.splitlines() if line]) == 6
    exec(compile(example, "README.md", "exec"), {})


def test_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", README)
    local = [link for link in links if "://" not in link]
    assert local
    assert [link for link in local if not (ROOT / link).exists()] == []

"""What a run gives: a table for the terminal and for Markdown, numbers as JSON, and a plot."""

import json
import math
import os
import platform
import subprocess
from dataclasses import asdict
from datetime import datetime, timezone
from html import escape
from importlib import metadata
from pathlib import Path

from benchmarks.groups import Group, Row
from benchmarks.timing import ROOT
from cgf.evaluation.suite.report import replace_marked

COLUMNS = ("", "unit", "best", "median", "ratio", "reach", "met", "")
PACKAGES = ("faiss-cpu", "hnswlib", "numba", "numpy", "open3d-cpu", "scikit-learn", "scipy")


def machine() -> dict[str, object]:
    """Where and when the run is made."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    try:
        commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        commit = ""
    return {
        "processor": _processor(),
        "processors": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": commit,
        "versions": _versions(),
    }


def cells(row: Row) -> tuple[str, ...]:
    """The row as text, in the order of `COLUMNS`."""
    if row.timing is None:
        times = ("", "")
    else:
        values = row.timing.wall if row.by_clock else row.timing.cpu
        times = (_figures(min(values)), _figures(sorted(values)[len(values) // 2]))
    ratio = "" if row.ratio is None else _figures(row.ratio)
    reach = "" if row.reach is None else _figures(row.reach)
    met = "" if row.ratio is None or row.reach is None else "yes" if row.ratio >= row.reach else "no"
    return (row.name, row.unit, *times, ratio, reach, met, row.note)


def text(groups: list[Group]) -> str:
    """A table for the terminal."""
    lines = []
    widths = [
        max(len(cell) for cell in column)
        for column in zip(COLUMNS, *(cells(row) for group in groups for row in group.rows), strict=True)
    ]
    for group in groups:
        lines += ["", group.title]
        for line in (COLUMNS, *(cells(row) for row in group.rows)):
            parts = [
                cell.rjust(width) if 2 <= k <= 5 else cell.ljust(width)
                for k, (cell, width) in enumerate(zip(line, widths, strict=True))
            ]
            lines.append("  " + "  ".join(parts).rstrip())
    return "\n".join(lines).strip() + "\n"


def markdown(groups: list[Group]) -> str:
    """The same for a document."""
    lines = []
    for group in groups:
        lines += [
            f"**{group.title}**",
            "",
            "| | unit | best | median | ratio | reach | met | |",
            "|---|---|--:|--:|--:|--:|---|---|",
        ]
        lines += ["| " + " | ".join(cells(row)) + " |" for row in group.rows]
        lines.append("")
    return "\n".join(lines)


def summary(groups: list[Group]) -> str:
    """A line for each row of the project, with those of its peers that follow it."""
    lines = ["| | this project | beside |", "|---|---|---|"]
    for group in groups:
        subject = group.title.split(",")[0]
        own: list[str] = []
        beside: list[str] = []
        for row in group.rows:
            if row.ours:
                lines += _line(own, beside)
                time = "" if row.timing is None else f"{_figures(row.seconds or 0)} {row.unit}"
                figure = time or f"{_figures(row.ratio or 0)} {row.unit}"
                own, beside = [f"{subject}: {row.name}", figure], []
                whole = group.key in ("dense", "sizes")
                if row.timing is not None and row.ratio is not None:
                    beside.append(f"{_figures(row.ratio)} {row.note if whole else row.note.split(';')[0]}")
                elif whole:
                    beside.append(row.note)
            elif row.ratio is not None:
                beside.append(f"{row.name.split(': ')[-1]} {_figures(row.seconds or 0)} ({_figures(row.ratio)} times)")
        lines += _line(own, beside)
    return "\n".join(lines) + "\n"


def update(path: Path, content: str, *, module: str = "benchmarks") -> None:
    """Put `content` between the two comments of a document that say which module makes it.

    Raises:
        ValueError: The document has no such comments.
    """
    replace_marked(path, content, command=f"python -m {module} --update")


def where() -> str:
    """One line on the machine and its software."""
    facts = machine()
    load = f", load {facts['load']:.1f} at the end" if facts["load"] is not None else ""
    versions = ", ".join(f"{name} {version}" for name, version in _versions().items())
    return f"{facts['processor']}, {facts['processors']} processors{load}, {facts['time']}; {versions}.\n"


def _line(own: list[str], beside: list[str]) -> list[str]:
    return [f"| {own[0]} | {own[1]} | {'; '.join(beside)} |"] if own else []


def save(groups: list[Group], folder: Path) -> list[Path]:
    """Write `table.md`, `results.json` and `plot.svg`."""
    folder.mkdir(parents=True, exist_ok=True)
    results = {"machine": machine(), "groups": [asdict(group) for group in groups]}
    contents = {
        "table.md": markdown(groups),
        "results.json": json.dumps(results, indent=1) + "\n",
        "plot.svg": plot(groups),
    }
    for name, content in contents.items():
        (folder / name).write_text(content, "utf-8")
    return [folder / name for name in contents]


def plot(groups: list[Group]) -> str:
    """Bars of the times of each group, on a logarithmic scale of its own."""
    left, width, step = 320, 420, 20
    parts: list[str] = []
    y = 10
    for group in groups:
        rows = [(row, row.seconds) for row in group.rows]
        timed = [(row, seconds) for row, seconds in rows if seconds]
        if not timed:
            continue
        low = 10 ** math.floor(math.log10(min(seconds for _, seconds in timed)) - 0.3)
        high = 10 ** math.ceil(math.log10(max(seconds for _, seconds in timed)))
        y += 24
        parts.append(f'<text x="10" y="{y}" font-weight="bold">{escape(group.title)}</text>')
        top = y + 8
        y = top
        for row, seconds in timed:
            length = width * math.log(seconds / low) / math.log(high / low)
            color = "#2a78b5" if row.ours else "#b9bec4"
            parts.append(f'<text x="{left - 8}" y="{y + 14}" text-anchor="end">{escape(row.name)}</text>')
            parts.append(f'<rect x="{left}" y="{y + 3}" width="{length:.1f}" height="{step - 6}" fill="{color}"/>')
            label = f"{_figures(seconds)} {row.unit}"
            parts.append(f'<text x="{left + length + 6:.1f}" y="{y + 14}">{escape(label)}</text>')
            y += step
        for power in range(round(math.log10(low)), round(math.log10(high)) + 1):
            x = left + width * (power - math.log10(low)) / math.log10(high / low)
            parts.append(f'<line x1="{x:.1f}" y1="{top}" x2="{x:.1f}" y2="{y}" stroke="#000" stroke-opacity="0.12"/>')
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left + width + 150} {y + 14}" '
        'font-family="sans-serif" font-size="12">'
    )
    return "\n".join([head, '<rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>", ""])


def _figures(value: float) -> str:
    """Three significant figures without an exponent."""
    if value == 0:
        return "0"
    decimals = max(2 - math.floor(math.log10(abs(value))), 0)
    return f"{value:,.{min(decimals, 6)}f}"


def _versions() -> dict[str, str]:
    return {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())

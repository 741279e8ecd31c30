"""How soon a change is seen: `python -m benchmarks.page` changes settings on the page, in headless Chromium.

Without a graphics card the scene is drawn by the processors that also compute, as in most virtual machines.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import inputs, report
from benchmarks.timing import ROOT

FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]  # fmt: skip
SIZE = {"width": 1440, "height": 900}
START_S, REST_S, LONGEST_S = 120, 3, 60

WATCH = """(() => {
  if (!location.pathname.includes("/viewer")) return;
  const now = () => performance.timeOrigin + performance.now();
  const seen = window.__seen = [];
  const context = WebGL2RenderingContext.prototype;
  let uploads = 0, last = null;
  for (const name of ["bufferData", "bufferSubData"]) {
    const original = context[name];
    context[name] = function (...rest) {
      const data = rest[name === "bufferData" ? 1 : 2];
      if (data instanceof Uint8Array && data.length > 3000) { uploads++; last = this; }
      return original.apply(this, rest);
    };
  }
  const request = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (draw) => request((time) => {
    const begun = now(), before = uploads;
    draw(time);
    if (uploads === before) return;
    const frame = { begun, drawn: null };
    seen.push(frame);
    const fence = last.fenceSync(last.SYNC_GPU_COMMANDS_COMPLETE, 0);
    last.flush();
    const poll = () => {
      if (last.getSyncParameter(fence, last.SYNC_STATUS) === last.SIGNALED) frame.drawn = now();
      else setTimeout(poll, 2);
    };
    setTimeout(poll, 2);
  });
})()"""
"""Notes, in the scene's frame, when frames that take in new colours begin and when they are drawn."""

CHANGE = """async (settings) => {
  const server = await import(new URL("static/server.js", location.href));
  const begun = performance.timeOrigin + performance.now();
  server.change(settings);
  return begun;
}"""
VIEWER = "import sys; from app.main import main; sys.exit(main())"
HAS_POINTS = "() => (window.__viserTestpoints?.rendererInfo.render.points ?? 0) > 0"


@dataclass(frozen=True)
class Seen:
    """Milliseconds from a change to the frames that show it."""

    what: str
    preview: float | None
    all_points: float
    drawn: float


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description="Times changes on the page.")
    parser.add_argument("--data", type=Path, help="folder of the benchmark data; the demo where it is not given")
    parser.add_argument("--update", action="store_true", help="put the table into docs/performance.md")
    options = parser.parse_args()
    browser = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("python -m benchmarks.page: needs Chromium or Chrome; install it, or set CHROMIUM to its path")
    rows = [
        seen for arguments, name, changes in _works(options.data) for seen in _time(browser, arguments, name, changes)
    ]
    table = _table(rows)
    print(table)
    if options.update:
        report.update(ROOT / "docs" / "performance.md", table, module="benchmarks.page")


def _works(data: Path | None) -> Iterator[tuple[list[str], str, list[tuple[str, dict[str, Any]]]]]:
    """What the viewer opens, and what is changed there: each radius once, since it would be remembered."""
    radii = ("radius", "support_radius")
    yield (
        ["--demo"],
        "demo",
        _changes(radii, 0.9, 1.2, 0.8)
        + _changes(("dimension", "dim"), 16, 8)
        + _changes(("filter", "mutual"), True, False),
    )
    if data is not None and (data / inputs.FGR).is_dir():
        yield (
            [str(data / inputs.FGR)],
            "FGR pair 1",
            _changes(radii, 0.3, 0.25, 0.28) + _changes(("dimension", "dim"), 16, 8),
        )
    files = inputs.dense_files(data)
    if data is not None and files is not None:
        poses = data / "indoor" / "3dmatch" / "7-scenes-redkitchen" / "gt.log"
        yield [*map(str, files), "--gt", str(poses)], "dense kitchen", _changes(radii, 0.9, 1.2)


def _changes(named: tuple[str, str], *values: Any) -> list[tuple[str, dict[str, Any]]]:
    what, setting = named
    return [(what, {setting: value}) for value in values]


def _time(
    browser: str, arguments: Sequence[str], name: str, changes: Sequence[tuple[str, dict[str, Any]]]
) -> Iterator[Seen]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, _server(arguments) as url:
        chromium = playwright.chromium.launch(executable_path=browser, args=FLAGS)
        page = chromium.new_page(viewport=SIZE)  # type: ignore[arg-type]
        page.add_init_script(WATCH)
        page.goto(url)
        element = page.wait_for_selector("#scene")
        scene = None if element is None else element.content_frame()
        assert scene is not None
        scene.wait_for_function(HAS_POINTS, timeout=1000 * START_S)
        for what, settings in changes:
            _settle(page)
            scene.evaluate("() => { window.__seen.length = 0; }")
            begun = page.evaluate(CHANGE, settings)
            _settle(page)
            frames = [frame for frame in scene.evaluate("() => window.__seen") if frame["drawn"] is not None]
            if not frames:
                sys.exit(f"python -m benchmarks.page: {name}: no new colours after {json.dumps(settings)}")
            # The true poses of these pairs are known, so the last colours are those of all points.
            preview = frames[0]["begun"] - begun if len(frames) > 1 else None
            shown = frames[-1]
            yield Seen(f"{name}, {what}", preview, shown["begun"] - begun, shown["drawn"] - begun)
        chromium.close()


@contextmanager
def _server(arguments: Sequence[str]) -> Iterator[str]:
    command = [sys.executable, "-c", VIEWER, *arguments, "--no-browser", "--no-cache"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        try:
            yield next(word for line in process.stdout for word in line.split() if word.startswith("http://"))
        finally:
            process.terminate()


def _settle(page: Any) -> None:
    """Wait until everything shown belongs to the settings, then until the scene and what is computed ahead rest."""
    ends = time.monotonic() + LONGEST_S
    time.sleep(0.1)
    while not page.evaluate("async () => (await (await fetch('api/state')).json()).settled"):
        if time.monotonic() > ends:
            sys.exit(f"python -m benchmarks.page: the page has not settled within {LONGEST_S} s")
        time.sleep(0.1)
    time.sleep(REST_S)


def _table(rows: Sequence[Seen]) -> str:
    lines = ["| | preview | all points: their frame begins | drawn |", "|---|--:|--:|--:|"]
    for what in dict.fromkeys(row.what for row in rows):
        own = [row for row in rows if row.what == what]
        columns = [[row.preview for row in own if row.preview is not None], [row.all_points for row in own]]
        columns.append([row.drawn for row in own])
        lines.append(f"| {what} | " + " | ".join(_milliseconds(values) for values in columns) + " |")
    return "\n".join(lines)


def _milliseconds(values: Sequence[float]) -> str:
    if not values:
        return ""
    low, high = round(min(values)), round(max(values))
    return f"{low:,} ms" if low == high else f"{low:,} to {high:,} ms"


if __name__ == "__main__":
    main()

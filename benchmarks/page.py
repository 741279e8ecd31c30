"""How soon a change is seen: `python -m benchmarks.page` changes settings on the page, in headless Chromium.

Without a graphics card the scene is drawn by the processors that also compute, as in most virtual machines.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import inputs, report
from benchmarks.timing import ROOT
from tests.browser.chromium import FLAGS, UNTIL_DRAWN, find_chromium

SIZE = {"width": 1440, "height": 900}
LONGEST_S = 120
LOOK_S = 3
"""A person looks before the next change; meanwhile other dimensions are matched ahead."""

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

CHANGE = f"""async (settings) => {{
  const server = await import(new URL("static/server.js", location.href));
  const isDone = () => {{
    const state = server.state();
    return state?.settled && Object.entries(settings).every(([name, value]) => state.settings[name] === value);
  }};
  const begun = performance.timeOrigin + performance.now();
  if (Object.keys(settings).length) server.change(settings);
  await new Promise((resolve, reject) => {{
    server.listen(() => isDone() && resolve());
    if (isDone()) resolve();
    setTimeout(() => reject(new Error("the page has not settled within {LONGEST_S} s")), {1000 * LONGEST_S});
  }});
  return begun;
}}"""
"""Changes settings, if there are any, and resolves once everything shown belongs to them, to when it was asked for."""
VIEWER = "import sys; from app.main import main; sys.exit(main())"
ALL_DRAWN = "() => window.__seen.every((frame) => frame.drawn !== null)"


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
    browser = find_chromium()
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
        scene.evaluate(UNTIL_DRAWN)
        page.evaluate(CHANGE, {})
        for what, settings in changes:
            page.wait_for_timeout(1000 * LOOK_S)
            scene.evaluate("() => { window.__seen.length = 0; }")
            begun = page.evaluate(CHANGE, settings)
            page.wait_for_timeout(1000 * LOOK_S)
            scene.wait_for_function(ALL_DRAWN, timeout=1000 * LONGEST_S)
            frames = scene.evaluate("() => window.__seen")
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

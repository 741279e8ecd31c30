"""Where Chromium is, how it is started, and when it has drawn: for tests, pictures and benchmarks of the page."""

import os
import shutil

FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]  # fmt: skip
"""Without a graphics card, and without asking the network for anything of its own."""
UNTIL_DRAWN = """() => new Promise((resolve, reject) => {
  const end = performance.now() + 60000;
  const look = () => {
    const viewer = window.__viserMutable;
    const points = window.__viserTestpoints?.rendererInfo.render.points ?? 0;
    if (viewer?.nodeRefFromName["/source"] && viewer?.nodeRefFromName["/target"] && points > 0) resolve(points);
    else if (performance.now() > end) reject(new Error("no points were drawn"));
    else requestAnimationFrame(look);
  };
  look();
})"""
"""Resolves in the scene's frame to the number of points drawn, once both clouds are there."""


def find_chromium() -> str | None:
    """Path of CHROMIUM, or of the first one on the PATH; None where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome")
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)

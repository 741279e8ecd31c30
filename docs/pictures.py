"""Takes the README's pictures from the running page: `python docs/pictures.py`, with what the tests need."""

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from app.pair_source import PairSource  # noqa: E402 - the checkout is not installed where this runs
from app.session import Session  # noqa: E402
from app.settings import Column, Picked, ViewSettings  # noqa: E402
from cgf.datasets.demo import load_demo  # noqa: E402
from tests.app.serving import LONG_S, serve  # noqa: E402
from tests.browser.chromium import FLAGS, UNTIL_DRAWN, find_chromium  # noqa: E402

SIZE = {"width": 1400, "height": 860}
BAD_MATCH = 2305
"""A source point of the demo whose match is wrong, and some of whose runners-up are right."""

# File name, tab, and settings that are not at their default.
PICTURES: list[tuple[str, str, dict[str, object]]] = [
    ("screenshot.png", "summary", {}),
    ("tour-diagnosis.webp", "diagnosis", {"flip_normals": "source"}),
    ("tour-point.webp", "point", {"picked": Picked("source", BAD_MATCH), "line_count": 0, "coloring": "distance"}),
    ("tour-plots.webp", "plots", {"palette": "viridis"}),
    ("tour-poses.webp", "poses", {"layout": "overlaid", "pose": "estimate", "coloring": "residual"}),
    ("tour-compare.webp", "compare", {"columns": (Column("cgf", 32), Column("cgf", 8), Column("fpfh", 33))}),
]


def main() -> None:
    """Take all pictures, or those whose names are given."""
    pair, usual = load_demo(), ViewSettings()
    session = Session([PairSource("demo", lambda: pair, view=("--demo",))], usual)
    with serve(session) as served, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=FLAGS)
        # Twice as large, since the page does not smooth edges where the processor draws.
        page = browser.new_page(viewport=SIZE, color_scheme="dark", device_scale_factor=2)  # type: ignore[arg-type]
        page.set_default_timeout(LONG_S * 1000)
        page.goto(served.url)
        session.wait_until_idle()
        for name, tab, changes in PICTURES:
            if sys.argv[1:] and name not in sys.argv[1:]:
                continue
            defaults = {field: getattr(usual, field) for field in usual.__dataclass_fields__}
            session.change({**defaults, **changes})
            session.wait_until_idle()
            page.evaluate(f"document.getElementById('tab-{tab}').click()")
            frame = next(frame for frame in page.frames if "/viewer" in frame.url)
            frame.evaluate(UNTIL_DRAWN)
            # The scene follows within a few frames, which software draws at its own pace.
            page.wait_for_timeout(4000)
            image = Image.open(io.BytesIO(page.screenshot())).convert("RGB").resize(tuple(SIZE.values()))
            image.save(ROOT / "docs" / name, quality=82, method=6, optimize=True)
        browser.close()


if __name__ == "__main__":
    main()

"""The page in a real Chromium, with software WebGL: state through `/api`, then pixels."""

import json
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Frame, Page, expect, sync_playwright

from app.session import PairSource, Session
from app.settings import ViewSettings
from cgf.datasets.demo import load_demo
from tests.app.serving import LONG_S, Served, serve

pytestmark = pytest.mark.browser

SIZES = [(1440, 900), (1024, 700)]
FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]  # fmt: skip
LINE_TOLERANCE = 3
"""Of 255: how exactly eight bits undo the tone mapping of lines."""


@dataclass
class Viewer:
    """An open page of a running server."""

    served: Served
    page: Page
    complaints: list[str] = field(default_factory=list)

    @property
    def frame(self) -> Frame:
        return next(frame for frame in self.page.frames if "/viewer" in frame.url)

    def state(self) -> dict[str, Any]:
        with urllib.request.urlopen(self.served.url + "api/state", timeout=LONG_S) as answer:
            state: dict[str, Any] = json.load(answer)
        return state

    def settle(self) -> dict[str, Any]:
        """The state once nothing is left to compute."""
        assert self.served.session.wait_until_idle(LONG_S)
        return self.state()

    def pixels(self) -> Counter[tuple[int, int, int]]:
        """Colours of the fully drawn pixels of the scene, with their counts."""
        counted = self.frame.evaluate(_PIXELS)
        return Counter({tuple(int(hexed[at : at + 2], 16) for at in (0, 2, 4)): count for hexed, count in counted})

    def pixels_after(self, before: Counter[tuple[int, int, int]]) -> Counter[tuple[int, int, int]]:
        """The same, once they differ from `before` and have come to rest."""
        self.frame.evaluate(_UNTIL_CHANGED, hash_of(before))
        return self.pixels()


# Reads the canvas as it is shown; the parts that the clouds leave open are transparent there.
_READ = """
  const read = () => {
    const shown = window.__viserMutable.canvas;
    const copy = new OffscreenCanvas(shown.width, shown.height);
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(shown, 0, 0);
    const { data } = context.getImageData(0, 0, copy.width, copy.height);
    const counts = new Map();
    for (let at = 0; at < data.length; at += 4) {
      if (data[at + 3] !== 255) continue;
      const color = (data[at] << 16) | (data[at + 1] << 8) | data[at + 2];
      counts.set(color, (counts.get(color) ?? 0) + 1);
    }
    return counts;
  };
  const digest = (counts) => {
    let sum = 0;
    for (const [color, count] of counts) sum = (sum + (color % 99991) * count) % 2147483647;
    return sum;
  };
"""
_PIXELS = f"""() => {{ {_READ}
  return [...read()].map(([color, count]) => [color.toString(16).padStart(6, "0"), count]);
}}"""
_UNTIL_CHANGED = f"""(before) => new Promise((resolve, reject) => {{ {_READ}
  const end = performance.now() + 60000;
  let last = before;
  const look = () => {{
    const now = digest(read());
    if (now !== before && now === last) resolve(true);
    else if (performance.now() > end) reject(new Error("the scene has not changed"));
    else {{ last = now; window.__viserMutable.requestRender(); setTimeout(look, 150); }}
  }};
  look();
}})"""
_UNTIL_DRAWN = """() => new Promise((resolve, reject) => {
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


def hash_of(counts: Counter[tuple[int, int, int]]) -> int:
    total = 0
    for (red, green, blue), count in counts.items():
        total = (total + ((red << 16 | green << 8 | blue) % 99991) * count) % 2147483647
    return total


@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    pair = load_demo()
    session = Session([PairSource("demo", lambda: pair, ("a.ply", "b.ply"))], ViewSettings())
    with serve(session) as served:
        yield served


@pytest.fixture(scope="module")
def opened(served: Served, browser: Browser) -> Iterator[Viewer]:
    viewer = open_page(served, browser, *SIZES[0])
    viewer.settle()
    viewer.frame.evaluate(_UNTIL_DRAWN)
    yield viewer
    viewer.page.close()
    assert viewer.complaints == []


@pytest.fixture
def viewer(opened: Viewer) -> Iterator[Viewer]:
    """The page, put back afterwards as it was."""
    yield opened
    defaults = ViewSettings()
    opened.served.session.change({name: getattr(defaults, name) for name in defaults.__dataclass_fields__})
    opened.settle()


def open_page(served: Served, browser: Browser, width: int, height: int) -> Viewer:
    page = browser.new_page(viewport={"width": width, "height": height})
    viewer = Viewer(served, page)

    def heard(message: ConsoleMessage) -> None:
        if message.type == "error":
            viewer.complaints.append(message.text)

    page.on("console", heard)
    page.on("pageerror", lambda error: viewer.complaints.append(str(error)))
    page.goto(served.url)
    expect(page.locator("#pair-names .arrow")).to_be_visible(timeout=LONG_S * 1000)
    return viewer


def rgb(hexed: str) -> tuple[int, int, int]:
    return int(hexed[1:3], 16), int(hexed[3:5], 16), int(hexed[5:7], 16)


def test_both_clouds_and_their_matches_are_drawn(viewer: Viewer) -> None:
    state = viewer.settle()
    assert state["settled"], state["messages"]
    assert viewer.frame.evaluate(_UNTIL_DRAWN) >= state["source"]["prepared"] + state["target"]["prepared"]
    canvas = viewer.page.frame_locator("#scene").locator("canvas[data-engine]").bounding_box()
    assert canvas is not None
    assert viewer.pixels().total() > 0.1 * canvas["width"] * canvas["height"]


def test_the_numbers_on_the_page_are_those_of_the_api(viewer: Viewer) -> None:
    state = viewer.settle()
    expect(viewer.page.locator("#precision")).to_have_text(f"{100 * state['numbers']['precision']:.1f} %")
    expect(viewer.page.locator("#status-text")).to_have_text("Ready")
    expect(viewer.page.locator("#model")).to_have_text(state["model"]["reason"])
    right = viewer.page.locator("#funnel li").last
    expect(right).to_contain_text(f"{state['numbers']['right']:,}")


def test_the_legend_has_the_colours_of_the_points(viewer: Viewer) -> None:
    before = viewer.pixels()
    viewer.served.session.change({"line_count": 0})
    shown = viewer.pixels_after(before)
    legend = viewer.state()["legend"]
    explained = {rgb(color) for color in legend["ramp"]} | {rgb(swatch["color"]) for swatch in legend["swatches"]}
    exact = sum(count for color, count in shown.items() if color in explained)
    # The rest are edges, where points blend with each other.
    assert exact > 0.7 * shown.total()
    assert shown[rgb(legend["swatches"][0]["color"])] > 0
    assert len({color for color in shown if color in {rgb(stop) for stop in legend["ramp"]}}) > 100


def test_the_legend_on_the_page_is_painted_with_those_colours(viewer: Viewer) -> None:
    legend = viewer.settle()["legend"]
    painted = viewer.page.evaluate("""() => {
      const canvas = document.getElementById("ramp-colors");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, 1);
      return Array.from({ length: canvas.width }, (_, column) => [...data.slice(4 * column, 4 * column + 3)]);
    }""")
    assert [tuple(color) for color in painted] == [rgb(color) for color in legend["ramp"]]
    expect(viewer.page.locator("#ramp-ticks span").last).to_have_text("≥ 25 cm")
    expect(viewer.page.locator("#swatches li").first).to_have_text("no true partner")


def test_lines_have_the_colours_of_the_legend_too(viewer: Viewer) -> None:
    before = viewer.pixels()
    # Points too small to hide the lines.
    viewer.served.session.change({"point_size": 0.25, "line_count": 400, "line_choice": "best"})
    shown = viewer.pixels_after(before)
    best = rgb(viewer.state()["legend"]["ramp"][8])
    near = [color for color in shown if max(abs(a - b) for a, b in zip(color, best, strict=True)) <= LINE_TOLERANCE]
    assert sum(shown[color] for color in near) > 50


def test_colouring_by_features_changes_the_pixels_and_the_state(viewer: Viewer) -> None:
    before = viewer.pixels()
    viewer.page.get_by_role("radio", name="Features").check()
    after = viewer.pixels_after(before)
    assert viewer.state()["settings"]["coloring"] == "features"
    assert len(after) > 2 * len(before) or after.keys() != before.keys()
    expect(viewer.page.locator("#legend-title")).to_contain_text("like features, like colours")


def test_another_dimension_is_matched_and_shown(viewer: Viewer) -> None:
    full, before = viewer.settle(), viewer.pixels()
    viewer.page.get_by_role("radio", name="8", exact=True).check()
    viewer.pixels_after(before)
    state = viewer.settle()
    assert state["controls"]["dim"] == 8
    assert state["numbers"]["precision"] < full["numbers"]["precision"]
    expect(viewer.page.locator("#precision")).to_have_text(f"{100 * state['numbers']['precision']:.1f} %")
    # The curve before the change stays for comparison.
    expect(viewer.page.locator("#curve .before")).to_have_count(1)


def test_filters_are_applied_from_the_page(viewer: Viewer) -> None:
    everything = viewer.settle()["numbers"]["matches"]
    viewer.page.get_by_label("Mutual only").check()
    expect(viewer.page.locator("#funnel")).to_contain_text("Mutual matches")
    assert viewer.settle()["numbers"]["matches"] < everything


def test_a_value_that_cannot_be_used_is_a_message_and_changes_nothing(viewer: Viewer) -> None:
    before = viewer.settle()
    field = viewer.page.get_by_label("Support radius", exact=True)
    field.fill("99")
    field.press("Enter")
    notice = viewer.page.locator(".notice[data-level=error]")
    expect(notice).to_contain_text("Support radius must be at most the diameter of the clouds")
    expect(field).to_have_value("0.9")
    assert viewer.state()["numbers"] == before["numbers"]
    notice.get_by_role("button", name="Close this message").click()
    expect(notice).to_have_count(0)
    # Chromium itself notes the answer.
    assert [text for text in viewer.complaints if "422" not in text] == []
    viewer.complaints.clear()


def test_text_in_a_number_field_is_refused_by_the_page(viewer: Viewer) -> None:
    field = viewer.page.get_by_label("Error scale", exact=True)
    field.fill("wide")
    field.press("Enter")
    notice = viewer.page.locator(".notice[data-level=error]")
    expect(notice).to_contain_text("Error scale must be a number, got “wide”.")
    notice.get_by_role("button", name="Close this message").click()


def test_a_change_in_one_tab_shows_in_the_other(viewer: Viewer, browser: Browser) -> None:
    other = browser.new_page()
    # Without the scene, which is the server's and needs no second renderer.
    other.route("**/viewer/", lambda route: route.fulfill(body=""))
    other.goto(viewer.served.url)
    expect(other.get_by_role("radio", name="Error")).to_be_checked()
    viewer.page.get_by_role("radio", name="Overlaid").check()
    expect(other.get_by_role("radio", name="Overlaid")).to_be_checked()
    other.close()


def test_the_keyboard_reaches_and_moves_the_controls(viewer: Viewer) -> None:
    viewer.page.get_by_role("radio", name="Error").focus()
    viewer.page.keyboard.press("ArrowRight")
    expect(viewer.page.get_by_role("radio", name="Features")).to_be_checked()
    viewer.page.get_by_label("Lines", exact=True).focus()
    viewer.page.keyboard.press("End")
    expect(viewer.page.locator("#line_count-value")).to_have_text("2,000")
    assert viewer.settle()["settings"]["line_count"] == 2000


def test_every_control_has_a_name(viewer: Viewer) -> None:
    nameless = viewer.page.evaluate("""() =>
      [...document.querySelectorAll("input, select, button, a, iframe")].filter((control) =>
        !(control.labels?.length && [...control.labels].some((label) => label.textContent.trim()))
        && !control.ariaLabel && !control.title && !control.textContent.trim()).map((control) => control.outerHTML)
    """)
    assert nameless == []


# Boxes that hold others, and what must not overlap.
_LAYOUT = """() => {
  const box = (element) => element.getBoundingClientRect();
  const name = (element) => element.id || element.className || element.tagName;
  const visible = [...document.querySelectorAll("body *")]
    .filter((element) => element.checkVisibility() && !element.closest("svg"));
  const outside = visible.filter((element) => {
    const { x, y, right, bottom } = box(element);
    return x < -0.5 || y < -0.5 || right > innerWidth + 0.5 || bottom > innerHeight + 1.5;
  }).map(name);
  // Names of files may be long, and are cut with an ellipsis and a tooltip.
  const mayBeCut = ".pair-names, .model, select, .legend-title, h2 small";
  const cut = visible.filter((element) => element.scrollWidth > element.clientWidth + 1 && element.clientWidth > 0
    && getComputedStyle(element).display !== "inline" && !element.matches(mayBeCut) && !element.closest("select"))
    .map((element) => `${name(element)}: ${element.textContent.trim().slice(0, 40)}`);
  const hidden = [...document.querySelectorAll(".controls, .panel, .dock, .tabpanel, .legend-strip")]
    .filter((element) => element.scrollHeight > element.clientHeight + 1).map(name);
  const overlapping = [];
  const groups = ["body > *", ".top > :not(.progress)", ".controls > *", ".row > *", ".dock > :not(.dock-edge)",
    ".tab-strip > *", ".tabs > *", ".tabpanel > *", ".legend-strip > *", ".actions > *", ".panel > *",
    "#funnel > li", "#figures > *", ".ramp-ticks > *", "#swatches > *", ".stage > :not(iframe)"];
  for (const group of groups) {
    const parents = new Map();
    for (const element of document.querySelectorAll(group)) {
      if (!element.checkVisibility()) continue;
      parents.set(element.parentElement, [...(parents.get(element.parentElement) ?? []), element]);
    }
    for (const siblings of parents.values()) for (const [index, one] of siblings.entries())
      for (const other of siblings.slice(index + 1)) {
        const [a, b] = [box(one), box(other)];
        if (a.x < b.right - 1 && b.x < a.right - 1 && a.y < b.bottom - 1 && b.y < a.bottom - 1)
          overlapping.push(`${name(one)} and ${name(other)}`);
      }
  }
  const texts = [...document.querySelectorAll("#curve text")].map((element) => [element.textContent, box(element)]);
  const panel = box(document.querySelector(".panel.curve"));
  const stray = texts.filter(([, text]) => text.x < panel.x || text.right > panel.right || text.bottom > panel.bottom)
    .map(([text]) => text);
  return { outside, cut, hidden, overlapping, stray };
}"""


@pytest.mark.parametrize("size", SIZES, ids=lambda size: "x".join(map(str, size)))
@pytest.mark.parametrize("coloring", ["error", "features", "original"])
def test_nothing_overlaps_or_is_cut_off(viewer: Viewer, size: tuple[int, int], coloring: str) -> None:
    page = viewer.page
    page.set_viewport_size({"width": size[0], "height": size[1]})
    viewer.served.session.change({"coloring": coloring})
    expect(page.get_by_role("radio", name=coloring.capitalize())).to_be_checked()
    found = page.evaluate(_LAYOUT)
    page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})
    assert found == {"outside": [], "cut": [], "hidden": [], "overlapping": [], "stray": []}


def test_the_page_of_the_api_lists_its_paths(viewer: Viewer, browser: Browser) -> None:
    page = browser.new_page()
    page.goto(viewer.served.url + "api/docs")
    expect(page.locator("code", has_text="/api/settings")).to_be_visible()
    page.close()

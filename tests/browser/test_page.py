"""The page in a real Chromium, with software WebGL: state through `/api`, then pixels."""

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.chromium import UNTIL_DRAWN
from tests.browser.driving import LAYOUT, USUAL_SIZE, Viewer, rgb

pytestmark = pytest.mark.browser

LINE_TOLERANCE = 3
"""Of 255: how exactly eight bits undo the tone mapping of lines."""
SMALL = [(960, 600), (820, 1180)]
"""A laptop's screen zoomed to 150 %, and a tablet held upright."""


def test_both_clouds_and_their_matches_are_drawn(viewer: Viewer) -> None:
    state = viewer.settle()
    assert state["settled"], state["messages"]
    assert viewer.frame.evaluate(UNTIL_DRAWN) >= state["source"]["prepared"] + state["target"]["prepared"]
    canvas = viewer.page.frame_locator("#scene").locator("canvas[data-engine]").bounding_box()
    assert canvas is not None
    assert viewer.pixels().total() > 0.1 * canvas["width"] * canvas["height"]


def test_the_numbers_on_the_page_are_those_of_the_api(viewer: Viewer) -> None:
    state = viewer.settle()
    expect(viewer.page.locator("#precision")).to_have_text(f"{100 * state['numbers']['precision']:.1f} %")
    expect(viewer.page.locator("#status-text")).to_have_text("Ready")
    expect(viewer.page.locator("#model")).to_have_text(state["model"]["reason"])
    last = state["funnel"][-1]
    expect(viewer.page.locator("#funnel li").last).to_contain_text(f"{100 * last['precision']:.1f} %{last['count']:,}")


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


def test_new_colours_and_lines_are_in_the_next_frame_and_need_no_shader_compiled(viewer: Viewer) -> None:
    before = viewer.pixels()
    viewer.frame.evaluate("""() => {
      const seen = window.seenByTest = { draws: 0, programs: 0 };
      const count = (name, run) => {
        const given = WebGL2RenderingContext.prototype[name];
        WebGL2RenderingContext.prototype[name] = function (...values) {
          run(...values);
          return given.apply(this, values);
        };
      };
      count("drawArrays", () => { seen.draws += 1; });
      count("linkProgram", () => { seen.programs += 1; });
      count("bufferSubData", (_, __, data) => { if (data instanceof Uint8Array) seen.uploaded = seen.draws; });
      const { drainMessageQueue, messageQueue } = window.__viserMutable;
      window.__viserMutable.drainMessageQueue = () => {
        if (messageQueue.length) seen.taken = seen.draws;
        drainMessageQueue();
      };
    }""")
    viewer.served.session.change({"palette": "viridis", "line_count": 200})
    viewer.pixels_after(before)
    seen = viewer.frame.evaluate("window.seenByTest")
    assert seen["draws"] > 0
    assert seen["uploaded"] == seen["taken"]
    assert seen["programs"] == 0


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
    expect(viewer.page.locator("#funnel")).to_contain_text("Mutual")
    assert viewer.settle()["numbers"]["matches"] < everything


def test_a_value_that_cannot_be_used_is_a_message_and_changes_nothing(viewer: Viewer) -> None:
    before = viewer.settle()
    field = viewer.page.get_by_label("Support radius", exact=True)
    field.fill("99")
    field.press("Enter")
    notice = viewer.page.locator(".notice[data-level=error]")
    expect(notice).to_contain_text("Support radius must be at most the diameter of the clouds")
    expect(field).to_have_value("1.08")
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
    with viewer.page.expect_response("**/api/settings"):
        viewer.page.keyboard.press("End")
    expect(viewer.page.locator("#line_count-value")).to_have_text("2,000")
    assert viewer.settle()["settings"]["line_count"] == 2000
    viewer.page.get_by_label("Surest").focus()
    with viewer.page.expect_response("**/api/settings"):
        viewer.page.keyboard.press("Home")
    expect(viewer.page.locator("#surest-value")).to_have_text("2 %")
    assert viewer.settle()["settings"]["surest"] == 0.02


def test_every_control_has_a_name(viewer: Viewer) -> None:
    nameless = viewer.page.evaluate("""() =>
      [...document.querySelectorAll("input, select, button, a, iframe")].filter((control) =>
        !(control.labels?.length && [...control.labels].some((label) => label.textContent.trim()))
        && !control.ariaLabel && !control.title && !control.textContent.trim()).map((control) => control.outerHTML)
    """)
    assert nameless == []


@pytest.mark.parametrize("coloring", ["error", "features", "original"])
@pytest.mark.parametrize(
    # The last is a tablet held upright, the one before a laptop zoomed to 150 %.
    "size",
    [USUAL_SIZE, (1024, 700), (1180, 820), (960, 600), (820, 1180)],
    ids=lambda size: "x".join(map(str, size)),
)
def test_nothing_overlaps_or_is_cut_off(viewer: Viewer, size: tuple[int, int], coloring: str) -> None:
    page = viewer.page
    page.set_viewport_size({"width": size[0], "height": size[1]})
    viewer.served.session.change({"coloring": coloring})
    expect(page.get_by_role("radio", name=coloring.capitalize())).to_be_checked()
    found = page.evaluate(LAYOUT)
    page.set_viewport_size({"width": USUAL_SIZE[0], "height": USUAL_SIZE[1]})
    scrolled = found.pop("scrolled")
    assert found == {"outside": [], "cut": [], "hidden": [], "overlapping": [], "stray": []}
    # There is room for all settings without scrolling where a screen is of usual size.
    assert scrolled == [] or size in SMALL


def test_the_page_of_the_api_lists_its_paths(viewer: Viewer, browser: Browser) -> None:
    page = browser.new_page()
    page.goto(viewer.served.url + "api/docs")
    expect(page.locator("code", has_text="/api/settings")).to_be_visible()
    page.close()

"""A point picked by a click in the scene, what the panel says of it, and steps through the matches by key."""

import pytest
from playwright.sync_api import expect

from app.colors import PICKED
from tests.browser.driving import Viewer

pytestmark = pytest.mark.browser

SLOW_MS = 60_000
"""Without a graphics card, a change waits for the frame before it."""

# A pixel in the middle of those drawn on the right of the scene, in pixels of the page.
_MIDDLE = """() => {
  const shown = window.__viserMutable.canvas;
  const copy = new OffscreenCanvas(shown.width, shown.height);
  const context = copy.getContext("2d", { willReadFrequently: true });
  context.drawImage(shown, 0, 0);
  const { data } = context.getImageData(0, 0, copy.width, copy.height);
  const scale = shown.clientWidth / shown.width;
  let best = null;
  for (let y = 0; y < copy.height; y += 3) for (let x = 0; x < copy.width; x += 3) {
    if (data[4 * (y * copy.width + x) + 3] !== 255) continue;
    const away = Math.hypot(x - 0.75 * copy.width, y - 0.5 * copy.height);
    if (!best || away < best.away) best = { away, x: (x + 0.5) * scale, y: (y + 0.5) * scale };
  }
  return best;
}"""


def test_a_click_picks_a_point_and_a_drag_turns_the_scene(viewer: Viewer) -> None:
    page, scene = viewer.page, viewer.page.frame_locator("#scene").locator("canvas[data-engine]")
    viewer.settle()
    before = viewer.pixels()
    place = viewer.frame.evaluate(_MIDDLE)
    box = scene.bounding_box()
    assert box is not None
    scene.click(position={"x": place["x"], "y": place["y"]})
    # The page opens what it knows of the point.
    expect(page.get_by_role("tab", name="Point")).to_have_attribute("aria-selected", "true", timeout=SLOW_MS)
    rows = page.locator("#panel-point tbody tr")
    expect(rows.nth(7)).to_be_visible(timeout=SLOW_MS)
    picked = viewer.state()["picked"]
    assert picked["side"] == "target"
    shown = viewer.pixels_after(before)
    assert shown[PICKED] > 10
    point = viewer.served.session.point()
    expect(rows.first).to_contain_text(f"{point.candidates[0].row:,}")
    expect(page.locator("#panel-point h2").first).to_contain_text(f"target {picked['index']:,}")
    painted = page.locator("#panel-point canvas").evaluate_all("""(canvases) => canvases.map((canvas) => {
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return new Set(new Uint32Array(data.buffer)).size;
    })""")
    assert len(painted) == 3
    assert min(painted) > 10
    # Turning the scene picks nothing else.
    page.mouse.move(box["x"] + place["x"], box["y"] + place["y"])
    page.mouse.down()
    page.mouse.move(box["x"] + place["x"] + 40, box["y"] + place["y"], steps=4)
    page.mouse.up()
    page.keyboard.press("Escape")
    expect(rows.first).to_be_hidden(timeout=SLOW_MS)
    state = viewer.state()
    assert state["picked"] is None
    page.get_by_role("button", name="Reset view").click()


def test_keys_go_through_the_matches_and_isolate_them(viewer: Viewer) -> None:
    page = viewer.page
    viewer.settle()
    before = viewer.pixels()
    page.get_by_role("tab", name="Point").click()
    page.keyboard.press("n")
    steps = page.locator("#panel-point .steps output")
    expect(steps).to_contain_text("1 of ", timeout=SLOW_MS)
    page.keyboard.press("n")
    expect(steps).to_contain_text("2 of ", timeout=SLOW_MS)
    state = viewer.state()
    assert state["picked"]["step"] == 2
    assert state["settings"]["isolate"]
    # What lies outside the support fades, to colours that were not there before.
    after = viewer.pixels_after(before)
    faded = sum(count for color, count in after.items() if color not in before)
    assert faded > 0.05 * sum(before.values())
    page.keyboard.press("p")
    expect(steps).to_contain_text("1 of ", timeout=SLOW_MS)
    page.get_by_role("button", name="Isolate").click()
    expect(page.get_by_role("button", name="Isolate")).to_have_attribute("aria-pressed", "false", timeout=SLOW_MS)
    page.get_by_role("radio", name="Distance").check()
    expect(page.locator("#legend-title")).to_have_text("Feature distance to the picked point", timeout=SLOW_MS)
    expect(page.locator("#ramp-ticks span").first).to_have_text(viewer.state()["legend"]["ticks"][0]["label"])
    page.keyboard.press("Escape")
    expect(page.locator("#legend-title")).to_contain_text("Error of each point's match", timeout=SLOW_MS)
    page.get_by_role("tab", name="Summary").click()

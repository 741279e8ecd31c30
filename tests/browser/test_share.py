"""Links, files and reports: what one takes elsewhere."""

import io
import struct
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from app.report import write_report
from app.settings import Picked
from tests.app.scenes import LONG_S
from tests.browser.driving import Viewer

pytestmark = pytest.mark.browser

CAMERA = "1,-2,-5,0,0.5,0"
_UNTIL_AT = """(wanted) => new Promise((resolve, reject) => {
  const end = performance.now() + 60000;
  const look = async () => {
    const { readCamera } = await import("./static/camera.js");
    if (readCamera() === wanted) resolve(true);
    else if (performance.now() > end) reject(new Error(`the camera is at ${readCamera()}`));
    else setTimeout(look, 100);
  };
  look();
})"""


def test_a_link_restores_settings_tab_and_camera(viewer: Viewer) -> None:
    page = viewer.page
    viewer.served.session.change({"coloring": "features"})
    page.goto(f"{viewer.served.url}#tab=share&line_count=25&palette=viridis&camera={CAMERA}")
    expect(page.get_by_role("tab", name="Share")).to_have_attribute("aria-selected", "true")
    expect(page.locator("#line_count-value")).to_have_text("25")
    expect(page.get_by_role("radio", name="Error")).to_be_checked()
    page.evaluate(_UNTIL_AT, CAMERA)
    # What the page would copy is what it was given; the address has only the tab, for the next reload.
    copied = page.evaluate("""async () => {
      const [{ viewText }, state] = [await import("./static/links.js"), await (await fetch("api/state")).json()];
      return viewText(state);
    }""")
    assert copied == f"line_count=25&palette=viridis&tab=share&camera={CAMERA}"
    assert viewer.served.token not in copied
    assert page.evaluate("location.hash") == "#tab=share"
    page.get_by_role("tab", name="Summary").click()


def test_a_link_that_cannot_be_used_says_so(viewer: Viewer) -> None:
    page = viewer.page
    page.get_by_role("tab", name="Share").click()
    page.get_by_label("A link or settings to show").fill("#dim=-1")
    page.get_by_role("button", name="Show", exact=True).click()
    expect(page.locator(".share .problem")).to_have_text(
        "the state cannot be used: Dim should be greater than or equal to 1."
    )
    # Chromium itself notes the answer.
    viewer.complaints.clear()
    page.get_by_role("tab", name="Summary").click()


def test_the_picture_has_the_size_of_the_scene_and_a_legend(viewer: Viewer) -> None:
    page = viewer.page
    page.get_by_role("tab", name="Share").click()
    with page.expect_download(timeout=LONG_S * 1000) as download:
        page.get_by_role("button", name="Picture").click()
    content = Path(download.value.path()).read_bytes()
    width, height = struct.unpack(">II", io.BytesIO(content).read(24)[16:])
    canvas = viewer.frame.evaluate("[__viserMutable.canvas.width, __viserMutable.canvas.height]")
    assert [width, height] == [canvas[0], canvas[1] + 48]
    page.get_by_role("tab", name="Summary").click()


def test_a_report_opens_from_a_file_without_network(viewer: Viewer, browser: Browser, tmp_path: Path) -> None:
    viewer.served.session.change({"line_count": 40, "picked": Picked("source", 100), "coloring": "distance"})
    state = viewer.settle()
    path = tmp_path / "report.html"
    write_report(viewer.served.session, path)
    context = browser.new_context(offline=True)
    page = context.new_page()
    complaints, asked = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    expect(page.locator("#precision")).to_have_text(f"{100 * state['numbers']['precision']:.1f} %")
    expect(page.locator("#legend .ramp span")).to_have_text([tick["label"] for tick in state["legend"]["ticks"]])
    page.get_by_role("radio", name="Error").check()
    expect(page.locator("#legend .swatches li").first).to_have_text("no true partner")
    expect(page.locator("#legend .ramp span").last).to_have_text("≥ 25 cm")
    painted = """() => {
      const shown = document.getElementById("scene");
      const copy = new OffscreenCanvas(shown.width, shown.height);
      const context = copy.getContext("2d");
      context.drawImage(shown, 0, 0);
      const { data } = context.getImageData(0, 0, copy.width, copy.height);
      return data.reduce((sum, value, at) => sum + (at % 4 === 3) * (value > 0), 0);
    }"""
    page.wait_for_function(f"({painted})() > 20000")
    page.get_by_role("radio", name="Overlaid").check()
    page.get_by_role("radio", name="Features").check()
    expect(page.locator("#legend p").first).to_contain_text("like features, like colours")
    assert complaints == []
    assert asked == [path.as_uri()]
    context.close()

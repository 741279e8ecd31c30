"""Opening other clouds from the page."""

from pathlib import Path

import pytest
from playwright.sync_api import expect

from cgf.io import write_cloud
from tests.app.scenes import LONG_S, bumpy_cloud, hills
from tests.browser.driving import Viewer

pytestmark = pytest.mark.browser

_DROP = """async ({ place, files }) => {
  const data = new DataTransfer();
  for (const [name, text] of files) data.items.add(new File([text], name));
  const target = place === "scene" ? document.getElementById("scene").contentDocument : document;
  for (const type of ["dragover", "drop"]) {
    target.body.dispatchEvent(new DragEvent(type, { dataTransfer: data, bubbles: true, cancelable: true }));
  }
}"""


def text_of(name: str) -> str:
    cloud = hills().source if name == "source" else hills().target
    return "\n".join(" ".join(f"{value:.5f}" for value in point) for point in cloud.points)


@pytest.mark.parametrize("place", ["page", "scene"])
def test_dropped_clouds_are_opened(viewer: Viewer, place: str) -> None:
    page = viewer.page
    count = len(viewer.state()["pairs"])
    files = [
        ["left.xyz", text_of("source")],
        ["right.xyz", text_of("target")],
        ["pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"],
    ]
    page.evaluate(_DROP, {"place": place, "files": files})
    expect(page.get_by_label("Source", exact=True)).to_have_value("left.xyz")
    expect(page.get_by_label("Target", exact=True)).to_have_value("right.xyz")
    expect(page.get_by_label("True pose", exact=True)).to_have_value("pose.txt")
    page.get_by_role("button", name="Open", exact=True).click()
    expect(page.locator("#load")).to_be_hidden(timeout=LONG_S * 1000)
    expect(page.locator("#pair")).to_have_value(str(count))
    state = viewer.settle()
    assert state["source"]["name"] == "left.xyz"
    assert state["reference"] == "ground_truth"


def test_a_bad_file_is_one_line_and_what_is_shown_stays(viewer: Viewer, tmp_path: Path) -> None:
    page = viewer.page
    before = viewer.settle()
    write_cloud(tmp_path / "good.ply", bumpy_cloud())
    (tmp_path / "bad.ply").write_text("<b>no cloud</b>")
    page.keyboard.press("l")
    page.locator("#load-source-file").set_input_files(tmp_path / "bad.ply")
    page.get_by_label("Target", exact=True).fill(str(tmp_path / "good.ply"))
    page.get_by_role("button", name="Open", exact=True).click()
    expect(page.locator("#load-problem")).to_contain_text("bad.ply", timeout=LONG_S * 1000)
    page.keyboard.press("Escape")
    after = viewer.state()
    assert after["pairs"] == before["pairs"]
    assert after["numbers"] == before["numbers"]
    # Chromium itself notes the answer.
    viewer.complaints.clear()

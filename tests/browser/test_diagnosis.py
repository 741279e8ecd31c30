"""The tab that says what is wrong."""

import pytest
from playwright.sync_api import expect

from tests.app.scenes import LONG_S
from tests.browser.driving import Viewer, rgb

pytestmark = pytest.mark.browser


def test_what_is_wrong_is_shown_and_mended(viewer: Viewer) -> None:
    page = viewer.page
    page.locator("#tab-diagnosis").click()
    expect(page.locator("#verdict")).to_have_text(viewer.settle()["diagnosis"]["verdict"])
    expect(page.locator("#tab-diagnosis .badge")).to_be_hidden()
    viewer.served.session.change({"flip_normals": "source"})
    viewer.settle()
    expect(page.locator("#tab-diagnosis .badge")).to_have_text("1")
    card = page.locator(".card[data-kind=normals]")
    expect(card).to_contain_text("normals of one cloud point to the other side")
    expect(card.locator("tr.off")).to_have_count(1)
    page.locator(".verdict .apply").click()
    expect(page.locator("#verdict")).to_contain_text("Nothing wrong found", timeout=LONG_S * 1000)
    assert viewer.state()["settings"]["flip_normals"] == "none"


def test_corrections_in_force_can_be_undone(viewer: Viewer) -> None:
    viewer.page.locator("#tab-diagnosis").click()
    viewer.served.session.change({"unit": "cm"})
    viewer.page.locator(".corrections button").click()
    expect(viewer.page.locator(".corrections")).to_be_hidden()
    assert viewer.state()["settings"]["unit"] == "m"


def test_the_points_of_a_finding_are_shown_in_the_scene(viewer: Viewer) -> None:
    before = viewer.pixels()
    viewer.page.locator("#tab-diagnosis").click()
    viewer.page.locator(".card[data-kind=overlap] .points").click()
    shown = viewer.pixels_after(before)
    swatch = viewer.state()["legend"]["swatches"][0]
    assert swatch["label"] == "source"
    # Changes of the test before may still be drawn at first.
    while not shown[rgb(swatch["color"])]:
        shown = viewer.pixels_after(shown)
    assert shown[rgb(swatch["color"])] > 0.02 * shown.total()
    expect(viewer.page.locator("#legend-title")).to_have_text("Highlighted: points with a partner")

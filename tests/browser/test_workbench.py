"""The panels for poses, plots and comparison, linked to the scene."""

import pytest
from playwright.sync_api import expect

from tests.browser.driving import Viewer, rgb

pytestmark = pytest.mark.browser

VISIBLE = "(names) => names.every((name) => window.__viserMutable.nodeRefFromName[name]?.visible)"

TURN = "() => window.__viserMutable.nodeRefFromName['/source'].quaternion.toArray()"


def open_tab(viewer: Viewer, name: str) -> None:
    viewer.page.get_by_role("tab", name=name).click()


def test_a_run_from_the_page_is_listed_and_can_be_shown(viewer: Viewer) -> None:
    page = viewer.page
    open_tab(viewer, "Poses")
    page.get_by_role("radio", name="FGR").check(force=True)
    page.get_by_role("button", name="Run FGR").click()
    row = page.locator(".pose-table tr", has_text="FGR, ICP").last
    expect(row).to_contain_text("°")
    row.get_by_role("button").click()
    expect(row).to_have_class("shown")
    assert viewer.settle()["pose"].startswith("run-")
    row.get_by_role("radio").check()
    expect(row.get_by_role("radio")).to_be_checked()
    assert viewer.settle()["estimate"]["method"] == "fgr+icp"
    page.locator(".pose-table tr[data-name=automatic]").get_by_role("radio").check()


def test_the_slider_moves_the_source_between_two_poses(viewer: Viewer) -> None:
    page = viewer.page
    open_tab(viewer, "Poses")
    before = viewer.frame.evaluate(TURN)
    page.get_by_label("From", exact=True).select_option("loaded")
    page.get_by_label("To", exact=True).select_option("ground_truth")
    slider = page.get_by_label("Place on the way between the two poses")
    slider.focus()
    slider.press("Home")
    slider.press("PageUp")
    viewer.frame.wait_for_function(f"(before) => String(({TURN})()) !== String(before)", arg=before)
    # The scene turns at the first key already, the state follows the second.
    moved = "async () => (await (await fetch('api/state')).json()).settings.pose_share > 0"
    page.wait_for_function(moved)
    state = viewer.settle()
    assert state["settings"]["layout"] == "overlaid"
    assert state["pose"] is None
    assert 0 < state["settings"]["pose_share"] < 0.5
    page.keyboard.press("b")
    expect(page.get_by_role("radio", name="Truth").first).to_be_checked()
    page.keyboard.press("b")
    expect(page.get_by_role("radio", name="Loaded")).to_be_checked()


def test_residuals_are_coloured_with_their_own_legend(viewer: Viewer) -> None:
    before = viewer.pixels()
    open_tab(viewer, "Poses")
    viewer.page.get_by_label("Colour by residual").check(force=True)
    shown = viewer.pixels_after(before)
    legend = viewer.settle()["legend"]
    explained = {rgb(color) for color in legend["ramp"]}
    # The two clouds are painted one after the other, with a rest between them on a busy machine.
    while sum(count for color, count in shown.items() if color in explained) <= 0.9 * shown.total():
        shown = viewer.pixels_after(shown)
    expect(viewer.page.locator("#legend-title")).to_contain_text("Distance to the nearest point of the other cloud")


def test_a_bar_leaves_the_matches_in_it(viewer: Viewer) -> None:
    before = viewer.pixels()
    open_tab(viewer, "Plots")
    bar = viewer.page.locator("[data-bar=error-2]")
    bar.focus()
    bar.press("Enter")
    expect(bar).to_have_attribute("aria-pressed", "true")
    shown = viewer.pixels_after(before)
    state = viewer.settle()
    assert state["settings"]["bar"]["kind"] == "error"
    other = next(swatch for swatch in state["legend"]["swatches"] if swatch["label"] == "other match")
    assert shown[rgb(other["color"])] > 0.5 * shown.total()
    bar.press("Enter")
    expect(bar).to_have_attribute("aria-pressed", "false")
    assert viewer.settle()["settings"]["bar"] is None


def test_the_cursor_of_the_curve_says_what_is_right(viewer: Viewer) -> None:
    page = viewer.page
    open_tab(viewer, "Plots")
    before = viewer.settle()["numbers"]["right"]
    cursor = page.get_by_role("slider", name="Error up to which a match is right")
    cursor.focus()
    cursor.press("PageUp")
    expect(page.locator("#plot-curve")).to_be_visible()
    page.wait_for_function("() => document.querySelector('#threshold').getAttribute('aria-valuenow') > 0.12")
    assert viewer.settle()["numbers"]["right"] > before
    expect(page.locator("#threshold")).to_be_focused()


def test_a_point_over_dimensions_takes_its_dimension(viewer: Viewer) -> None:
    open_tab(viewer, "Plots")
    point = viewer.page.locator("[data-bar=dim-8]")
    expect(point).not_to_have_attribute("class", "point unknown")
    point.press("Enter")
    expect(viewer.page.get_by_role("radio", name="8", exact=True)).to_be_checked()
    assert viewer.settle()["controls"]["dim"] == 8


def test_columns_stand_beside_each_other_and_go_again(viewer: Viewer) -> None:
    page = viewer.page
    open_tab(viewer, "Compare")
    page.get_by_role("button", name="Dimensions").click()
    viewer.frame.wait_for_function(VISIBLE, arg=["/column-0/source", "/column-1/source", "/column-2/source"])
    assert not viewer.frame.evaluate(VISIBLE, ["/source"])
    state = viewer.settle()
    assert [column["label"] for column in state["columns"]] == ["CGF-32", "CGF-16", "CGF-8"]
    shares = [column["precision"] for column in state["columns"]]
    assert shares == sorted(shares, reverse=True)
    for number, share in enumerate(shares):
        expect(page.locator(".columns li").nth(number)).to_contain_text(f"{100 * share:.1f} %")
    page.get_by_role("button", name="Leave").click()
    viewer.frame.wait_for_function(VISIBLE, arg=["/source", "/target"])
    assert not viewer.frame.evaluate(VISIBLE, ["/column-2/source"])
    assert viewer.settle()["columns"] == []

"""Tabs, keys, commands, themes: what holds the panels of the page together."""

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.browser.driving import LAYOUT, Viewer

pytestmark = pytest.mark.browser


def test_tabs_are_moved_by_arrow_keys_and_kept_in_the_address(flat: Viewer) -> None:
    page = flat.page
    page.get_by_role("tab", name="Summary").click()
    page.keyboard.press("ArrowLeft")
    expect(page.get_by_role("tab", name="Share")).to_be_focused()
    expect(page.get_by_role("tabpanel", name="Share")).to_be_visible()
    expect(page.get_by_role("tabpanel", name="Summary")).to_be_hidden()
    assert page.evaluate("location.hash") == "#tab=share"
    page.keyboard.press("Home")
    expect(page.get_by_role("tab", name="Summary")).to_have_attribute("aria-selected", "true")


def _click_beside_all_points(page: Page) -> None:
    """The scene has the focus then, and no point is picked, which would open another tab."""
    page.frame_locator("#scene").locator("canvas[data-engine]").click(position={"x": 8, "y": 8})


def test_keys_work_while_the_scene_has_the_focus_but_not_while_typing(viewer: Viewer) -> None:
    page = viewer.page
    _click_beside_all_points(page)
    page.keyboard.press("4")
    expect(page.get_by_role("tab", name="Plots")).to_have_attribute("aria-selected", "true")
    page.get_by_label("Error scale", exact=True).focus()
    page.keyboard.press("1")
    expect(page.get_by_role("tab", name="Plots")).to_have_attribute("aria-selected", "true")
    page.keyboard.press("Escape")
    page.get_by_role("tab", name="Plots").press("1")
    expect(page.get_by_role("tab", name="Summary")).to_have_attribute("aria-selected", "true")
    page.get_by_label("Error scale", exact=True).fill("0.25")


def test_commands_are_found_by_words_and_run_by_enter(viewer: Viewer) -> None:
    page = viewer.page
    _click_beside_all_points(page)
    page.keyboard.press("Control+k")
    page.keyboard.type("colour features")
    expect(page.locator("#commands [role=option]")).to_have_count(1)
    page.keyboard.press("Enter")
    expect(page.locator("#commands")).to_be_hidden()
    expect(page.get_by_role("radio", name="Features")).to_be_checked()


def test_help_lists_every_key(flat: Viewer) -> None:
    page = flat.page
    page.get_by_role("tab", name="Summary").press("?")
    listed = page.locator("#help li")
    for label, key in [("Show summary", "1"), ("Find a command", "/"), ("Light or dark", "t")]:
        expect(listed.filter(has_text=label).locator("kbd", has_text=key).first).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#help")).to_be_hidden()


def test_the_theme_follows_the_system_until_another_is_chosen(viewer: Viewer) -> None:
    page = viewer.page
    ground = "getComputedStyle(document.body).backgroundColor"
    scene = "getComputedStyle(document.querySelector('canvas[data-engine]')).backgroundImage"
    page.emulate_media(color_scheme="dark")
    dark, dark_scene = page.evaluate(ground), viewer.frame.evaluate(scene)
    page.emulate_media(color_scheme="light")
    light = page.evaluate(ground)
    assert light != dark
    assert viewer.frame.evaluate(scene) != dark_scene
    page.get_by_role("button", name="Light or dark").click()
    assert page.evaluate(ground) == dark
    assert viewer.frame.evaluate(scene) == dark_scene
    page.reload()
    assert page.evaluate(ground) == dark
    # Back to what the system has, which it follows again.
    page.get_by_role("button", name="Light or dark").click()
    page.emulate_media(color_scheme="dark")
    assert page.evaluate(ground) == dark
    page.emulate_media(color_scheme=None)


def test_the_dock_is_made_higher_by_button_and_by_keys(flat: Viewer) -> None:
    page = flat.page
    dock, stage = page.locator("#dock"), page.locator(".stage")
    height = lambda locator: locator.evaluate("element => element.offsetHeight")  # noqa: E731
    usual = height(dock)
    page.get_by_role("button", name="Higher results").click()
    assert height(dock) > 1.5 * usual
    assert height(stage) >= 200
    page.get_by_role("button", name="Higher results").click()
    assert height(dock) == usual
    page.get_by_role("separator", name="Height of the results").press("ArrowUp")
    assert height(dock) == usual + 24
    page.get_by_role("separator", name="Height of the results").dblclick()
    assert height(dock) == usual


def test_one_forwarded_port_is_enough(viewer: Viewer) -> None:
    assert len(viewer.asked) > 20
    own = (viewer.served.url, viewer.served.socket_url, "blob:", "data:")
    assert [address for address in viewer.asked if not address.startswith(own)] == []


@pytest.mark.parametrize("size", [(1024, 700), (820, 1180)], ids=lambda size: "x".join(map(str, size)))
def test_nothing_overlaps_on_any_tab(flat: Viewer, size: tuple[int, int]) -> None:
    page = flat.page
    page.set_viewport_size({"width": size[0], "height": size[1]})
    found = {}
    for tab in page.get_by_role("tab").all():
        tab.click()
        report = page.evaluate(LAYOUT)
        del report["scrolled"], report["stray"]
        found[tab.text_content()] = {kind: names for kind, names in report.items() if names}
    assert {tab: kinds for tab, kinds in found.items() if kinds} == {}


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing_serious_on_any_tab(flat: Viewer, theme: str) -> None:
    page = flat.page
    page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
    found = []

    def look(place: str) -> None:
        # The scene's frame is another program's canvas, without text or controls.
        results = Axe().run(page, context={"exclude": [["#scene"]]}, options={"iframes": False})
        found.extend(
            (place, violation["id"], [node["target"] for node in violation["nodes"]])
            for violation in results.response["violations"]
            if violation["impact"] in ("serious", "critical")
        )

    for tab in page.get_by_role("tab").all():
        tab.click()
        look(str(tab.text_content()))
    for key in ("?", "/", "l"):
        page.keyboard.press(key)
        look(key)
        page.keyboard.press("Escape")
    assert found == []

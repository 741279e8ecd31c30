"""One browser, one server and one open page for all tests of the page."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, sync_playwright

from app.pair_source import PairSource
from app.session import Session
from app.settings import ViewSettings
from cgf.datasets.demo import load_demo
from tests.app.serving import Served, serve
from tests.browser.chromium import FLAGS, UNTIL_DRAWN
from tests.browser.driving import USUAL_SIZE, Viewer, open_page


@pytest.fixture(scope="session")
def browser(chromium: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def served() -> Iterator[Served]:
    pair = load_demo()
    session = Session([PairSource("demo", lambda: pair, ("a.ply", "b.ply"))], ViewSettings())
    with serve(session) as served:
        yield served


@pytest.fixture(scope="session")
def opened(served: Served, browser: Browser) -> Iterator[Viewer]:
    viewer = open_page(served, browser, *USUAL_SIZE)
    viewer.settle()
    viewer.frame.evaluate(UNTIL_DRAWN)
    yield viewer
    viewer.page.close()


@pytest.fixture(scope="session")
def opened_flat(served: Served, browser: Browser) -> Iterator[Viewer]:
    flat = open_page(served, browser, *USUAL_SIZE, has_scene=False)
    yield flat
    flat.page.close()


@pytest.fixture
def viewer(opened: Viewer) -> Iterator[Viewer]:
    """The page, put back afterwards as it was."""
    yield opened
    put_back(opened)


@pytest.fixture
def flat(opened_flat: Viewer) -> Iterator[Viewer]:
    """The page without its scene, put back afterwards as it was."""
    opened_flat.settle()
    yield opened_flat
    put_back(opened_flat)


def put_back(viewer: Viewer) -> None:
    viewer.page.evaluate("for (const dialog of document.querySelectorAll('dialog')) dialog.close()")
    viewer.page.set_viewport_size({"width": USUAL_SIZE[0], "height": USUAL_SIZE[1]})
    viewer.page.emulate_media(color_scheme=None)
    viewer.page.get_by_role("tab").first.click()
    defaults = ViewSettings()
    viewer.served.session.change({name: getattr(defaults, name) for name in defaults.__dataclass_fields__})
    viewer.settle()
    complaints, viewer.complaints = viewer.complaints, []
    assert complaints == []

"""One browser, one server and one open page for all tests of the page."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, sync_playwright

from app.pair_source import PairSource
from app.session import Session
from app.settings import ViewSettings
from cgf.datasets.demo import load_demo
from tests.app.serving import Served, serve
from tests.browser.driving import FLAGS, UNTIL_DRAWN, USUAL_SIZE, Viewer, open_page


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


@pytest.fixture
def viewer(opened: Viewer) -> Iterator[Viewer]:
    """The page, put back afterwards as it was."""
    yield opened
    opened.page.evaluate("for (const dialog of document.querySelectorAll('dialog')) dialog.close()")
    defaults = ViewSettings()
    opened.served.session.change({name: getattr(defaults, name) for name in defaults.__dataclass_fields__})
    opened.settle()
    complaints, opened.complaints = opened.complaints, []
    assert complaints == []

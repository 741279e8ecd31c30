"""What all tests share: where data and programs are, and how hypothesis searches."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.browser.chromium import find_chromium

ROOT = Path(__file__).resolve().parent.parent

# The last jaxtyping for Python 3.10 overlooks `@no_type_check` and wraps kernels so that Numba cannot compile them.
# There the annotations go unchecked; everything else is tested.
if sys.version_info < (3, 11):
    sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "_JaxtypingFinder"]

# Shells start programs in the background with Ctrl-C ignored, and those pass it on to the programs that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Kernels compile in the first example, which then takes seconds: no deadline, and slowness is no failure. The examples
# of a continuous integration run are the same every time.
settings.register_profile(
    "cgf", deadline=None, derandomize="CI" in os.environ, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cgf")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Browser tests come last: their server runs on, and its threads draw from `random`, which hypothesis watches."""
    items.sort(key=lambda item: item.get_closest_marker("browser") is not None)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Programs that tests start neither read nor write what the user's own runs keep."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of benchmark data and reference results beside the checkout, or a skip that says so."""
    folder = Path(os.environ.get("CGF_SHARED", ROOT.parent / "shared"))
    if not (folder / "data").is_dir():
        reason = f"needs the benchmark data, which is not in {folder}; set CGF_SHARED to its folder"
        if os.environ.get("CGF_REQUIRE_SHARED"):
            pytest.fail(reason)
        pytest.skip(reason)
    return folder


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of the Chromium that browser tests drive."""
    path = find_chromium()
    if path is None:
        pytest.fail("browser tests need Chromium; install it, or set CHROMIUM to its path, or pass -m 'not browser'")
    return path

"""Where the files of the page lie."""

from pathlib import Path


def static_folder() -> Path:
    """Beside the package in a checkout, inside it once installed."""
    package = Path(__file__).resolve().parent
    installed = package / "static"
    return installed if installed.is_dir() else package.parent / "static"

"""Libraries that are heavy or hard to load."""

import ctypes
import importlib
from types import ModuleType

from cgf.checks import InputError


def import_open3d() -> ModuleType:
    """Import Open3D on first use, with the libusb that its Linux library links to and few servers have.

    Raises:
        InputError: Another library of the system is missing, as in containers.
        ImportError: Open3D cannot be loaded, for another reason.
    """
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        if "libusb" not in str(error):
            _explain(error)
            raise
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return importlib.import_module("open3d")


def _explain(error: ImportError) -> None:
    if "cannot open shared object file" in str(error):
        library = str(error).split(":")[0]
        raise InputError(
            f"Open3D, which computes fpfh, must find {library}, got none on this system; "
            "on Debian and Ubuntu: apt-get install libegl1 libgl1 libidn2-0 libx11-6"
        ) from error

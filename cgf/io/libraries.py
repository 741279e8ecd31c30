"""Libraries that are heavy or hard to load."""

import ctypes
import importlib
from types import ModuleType


def import_open3d() -> ModuleType:
    """Import Open3D on first use, with the libusb that its Linux library links to and few servers have.

    Raises:
        ImportError: Open3D cannot be loaded, for another reason than libusb.
    """
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        if "libusb" not in str(error):
            raise
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return importlib.import_module("open3d")

"""Two overlapping fragments of an indoor scene that come with the package."""

from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from cgf.geometry.transforms import compose, invert, move, rigid, rotation_about
from cgf.io import PairFiles, read_cloud
from cgf.types import Pair, PointCloud


def load_demo() -> Pair:
    """Two fragments of a room, in metres, of which the source was moved so that they no longer fit.

    The clouds are Open3D's (MIT licence, beside them), with normals as stored; in its frame they fit as they are.
    """
    motion = _motion()
    source = move(motion, _read("cloud_bin_1.pcd"))
    return Pair(
        name="demo",
        source=replace(source, name="cloud_bin_1 (moved)"),
        target=replace(_read("cloud_bin_0.pcd"), name="cloud_bin_0"),
        target_from_source=invert(motion),
    )


def find_demo() -> PairFiles:
    """The files of the same two fragments, in whose frames they fit as they are."""
    folder = Path(str(files("cgf.datasets"))) / "demo_data"
    return PairFiles("demo", folder / "cloud_bin_1.pcd", folder / "cloud_bin_0.pcd", np.eye(4))


def _motion() -> Float64[np.ndarray, "4 4"]:
    """A turn by 40 degrees about a tilted axis through the room's middle, and a shift by most of a metre."""
    middle = np.array([2.3, 0.7, -1.6])
    turn = rigid(rotation_about((0.3, 1.0, 0.2), np.radians(40.0)))
    return compose(rigid(np.eye(3), middle + np.array([0.6, 0.4, 0.5])), turn, rigid(np.eye(3), -middle))


def _read(name: str) -> PointCloud:
    with as_file(files("cgf.datasets") / "demo_data" / name) as path:
        return read_cloud(path)

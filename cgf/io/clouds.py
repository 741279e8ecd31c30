"""Any file of points to a checked `PointCloud`, and back."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from cgf.checks import ArrayLike, InputError, check_finite_rows, check_points
from cgf.io.meshes import read_obj, read_stl, vertex_normals
from cgf.io.pcd import read_pcd
from cgf.io.ply import read_ply, write_ply
from cgf.io.raw import RawCloud
from cgf.io.tables import read_npy, read_npz, read_text, write_npz
from cgf.types import PointCloud

_READERS: dict[str, Callable[[Path], RawCloud]] = {
    ".ply": read_ply, ".pcd": read_pcd, ".obj": read_obj, ".stl": read_stl, ".npy": read_npy, ".npz": read_npz,
    ".xyz": read_text, ".txt": read_text, ".csv": read_text, ".asc": read_text, ".pts": read_text,
}  # fmt: skip
_WRITERS: dict[str, Callable[[Path, PointCloud], None]] = {".ply": write_ply, ".npz": write_npz}
CLOUD_SUFFIXES = tuple(_READERS)
_LARGEST_SHARE_WITHOUT_NORMAL = 0.01


def read_cloud(path: str | Path, *, viewpoint: ArrayLike | None = None, drop_invalid: bool = False) -> PointCloud:
    """Read a file of points, whose format its suffix tells; the vertices of a mesh are its points.

    Normals are those of the file, made unit length; a mesh without them takes those of its triangles, weighted by
    area. Where more than 1 % of them are zero, NaN or inf there are none; fewer take that of the nearest other point.
    Colours that are all black count as none.

    Args:
        path: PLY, PCD, OBJ, STL, NPY, NPZ or a text table (XYZ, TXT, CSV, ASC, PTS).
        viewpoint: Position of the sensor, in the cloud's frame; None takes the file's, or else the origin.
        drop_invalid: Leave out points with NaN or inf instead of refusing them.

    Raises:
        InputError: The file is missing, of another format, damaged, or its points do not show a surface.
    """
    path = Path(path)
    raw = _read_raw(path)
    normals, points = raw.normals, raw.points
    if normals is None and raw.faces is not None and len(raw.faces):
        normals = vertex_normals(points, raw.faces, str(path))
    colors = raw.colors
    if drop_invalid:
        valid = np.isfinite(points).all(axis=1)
        points = points[valid]
        normals = None if normals is None else normals[valid]
        colors = None if colors is None else colors[valid]
    return _checked(path, points, normals, colors, raw.viewpoint if viewpoint is None else viewpoint)


def write_cloud(path: str | Path, cloud: PointCloud) -> None:
    """Write a cloud with its normals and colours as binary PLY or NPZ (which also keeps the viewpoint).

    Raises:
        InputError: The suffix is another one, or the file cannot be written.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(f"{path} must end in {' or '.join(_WRITERS)}, got {path.suffix!a}; choose one of these")
    try:
        writer(path, cloud)
    except OSError as error:
        raise InputError(f"{path} must be writable, got '{error.strerror}'; choose another place") from None


def _read_raw(path: Path) -> RawCloud:
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(CLOUD_SUFFIXES)
        raise InputError(f"{path} must be a point cloud or mesh ({known}), got the suffix {path.suffix!a}; convert it")
    check_file(path)
    try:
        return reader(path)
    except OSError as error:
        raise InputError(f"{path} must be readable, got '{error.strerror}'; check its permissions") from None


def check_file(path: Path) -> None:
    """Raise an InputError where `path` is no file with something in it."""
    try:
        if path.is_dir():
            raise InputError(f"{path} must be a file, got a folder; name a file in it")
        if not path.is_file():
            raise InputError(f"{path} must exist, got no such file; check the path")
        if path.stat().st_size == 0:
            raise InputError(f"{path} must hold data, got an empty file; copy or export it again")
    except OSError as error:
        raise InputError(f"{path} must be readable, got '{error.strerror}'; check its permissions") from None


def _checked(
    path: Path,
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"] | None,
    colors: UInt8[np.ndarray, "N 3"] | None,
    viewpoint: ArrayLike | None,
) -> PointCloud:
    remedy = "leave them out with --drop-invalid (drop_invalid=True in Python)"
    try:
        check_finite_rows(points, str(path), remedy=remedy)
        points = check_points(points, str(path))
    except ValueError as error:
        raise InputError(str(error)) from None
    position = np.zeros(3) if viewpoint is None else np.array(viewpoint, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise InputError(f"viewpoint must be 3 finite numbers, got {position.tolist()}")
    return PointCloud(
        points=points,
        normals=None if normals is None else _unit_normals(normals, points),
        # Many programs write black where they know no colours.
        colors=colors if colors is not None and colors.any() else None,
        name=path.name,
        viewpoint=position,
    )


def _unit_normals(
    normals: Float64[np.ndarray, "N 3"], points: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"] | None:
    """Normals of length 1, or None where too many have no direction."""
    with np.errstate(over="ignore", invalid="ignore"):
        # Twice, since the square of a very long or short one leaves the range of float64.
        scaled = normals / np.abs(normals).max(axis=1, keepdims=True)
        unit: Float64[np.ndarray, "N 3"] = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    usable = np.isfinite(unit).all(axis=1)
    if np.mean(~usable) > _LARGEST_SHARE_WITHOUT_NORMAL:
        return None
    if not usable.all():
        from scipy.spatial import cKDTree  # on first use: it costs half a second to import

        unit[~usable] = unit[usable][cKDTree(points[usable]).query(points[~usable])[1]]
    return unit

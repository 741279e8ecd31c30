"""Rows of numbers: text tables, NPY and NPZ."""

import struct
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from cgf.checks import InputError
from cgf.io.raw import RawCloud, decode_colors, parse_rows, to_float64
from cgf.types import PointCloud

_SEPARATORS = bytes.maketrans(b",;\t", b"   ")
_COLUMNS = {
    "points": (("x", "y", "z"),),
    "normals": (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")),
    "colors": (("r", "g", "b"), ("red", "green", "blue")),
}
# A damaged archive raises any of these from numpy, zipfile or zlib.
_DAMAGED = (
    ValueError, OSError, EOFError, KeyError, TypeError, IndexError, SyntaxError, OverflowError, MemoryError,
    RuntimeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip


def read_text(path: Path) -> RawCloud:
    """Read a table of x y z and perhaps normals and colours, separated by blanks, commas or semicolons.

    A first line with the names of the columns is obeyed, also as a comment; a first line with the number of points
    (`.pts`) is skipped. Without names, three columns are normals where they have length 1, and colours where they are
    integers from 0 to 255.
    """
    lines = [line.translate(_SEPARATORS).strip() for line in path.read_bytes().splitlines()]
    names = _column_names(lines)
    rows = [(number, line) for number, line in enumerate(lines, start=1) if line and not line.startswith((b"#", b"//"))]
    if names is not None and rows and rows[0][0] == 1:
        rows = rows[1:]
    announced = _announced_count([line for _, line in rows[:2]])
    if announced is not None:
        rows = rows[1:]
        if len(rows) < announced:
            raise InputError(f"{path} must have {announced} points, got {len(rows)} rows; the file may be truncated")
    if not rows:
        raise InputError(f"{path} must have rows of x, y and z, got none")
    table = parse_rows([line for _, line in rows], None, str(path), [number for number, _ in rows])
    return _named_columns(table, names, path) if names is not None else _guessed_columns(table, str(path))


def read_npy(path: Path) -> RawCloud:
    """Read an NPY array of 3 columns or more, taken as those of a text table."""
    return _guessed_columns(read_matrix(path), str(path))


def read_npz(path: Path) -> RawCloud:
    """Read the arrays `points`, `normals`, `colors` and `viewpoint` of an NPZ file; only the first must be there."""
    arrays = _load(path)
    key = next((name for name in ("points", "xyz", "pcd", "arr_0") if name in arrays), None)
    if key is None:
        raise InputError(f"{path} must have an array 'points', got {ascii(', '.join(arrays) or 'no arrays')[:80]}")
    raw = _guessed_columns(_numbers(arrays[key], f"'{key}' of {path}"), str(path))
    normals, colors = raw.normals, raw.colors
    if "normals" in arrays:
        normals = _rows_beside(_numbers(arrays["normals"], f"'normals' of {path}"), raw, f"'normals' of {path}")
    if "colors" in arrays:
        values = arrays["colors"]
        _rows_beside(_numbers(values, f"'colors' of {path}"), raw, f"'colors' of {path}")
        colors = decode_colors(values)
    viewpoint = None
    if "viewpoint" in arrays:
        viewpoint = _numbers(arrays["viewpoint"], f"'viewpoint' of {path}")
        if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
            raise InputError(f"'viewpoint' of {path} must be 3 finite numbers, got shape {viewpoint.shape}")
    return RawCloud(raw.points, normals, colors, viewpoint=viewpoint)


def read_matrix(path: Path) -> Float64[np.ndarray, "..."]:
    """Read an NPY array of any shape."""
    return _numbers(_single(path), f"the array of {path}")


def write_npz(path: Path, cloud: PointCloud) -> None:
    """Write the arrays that `read_npz` reads."""
    arrays = {"points": cloud.points, "viewpoint": cloud.viewpoint}
    if cloud.normals is not None:
        arrays["normals"] = cloud.normals
    if cloud.colors is not None:
        arrays["colors"] = cloud.colors
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _single(path: Path) -> np.ndarray:
    arrays = _load(path)
    if "" not in arrays:
        raise InputError(f"{path} must hold one array, got an archive of several; give it the suffix .npz")
    return arrays[""]


def _load(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive, or the one of an NPY file under an empty name."""
    try:
        # Opened here, since numpy leaves damaged archives open.
        with path.open("rb") as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of headers of old versions, and of damaged ones
            loaded = np.load(stream, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"": loaded}
            with loaded:
                return {name: loaded[name] for name in loaded.files}
    except _DAMAGED:
        raise InputError(
            f"{path} must be a numpy file of plain numbers, got one that numpy cannot read; "
            "the file may be truncated or of another format"
        ) from None


def _numbers(array: np.ndarray, name: str) -> Float64[np.ndarray, "..."]:
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name} must hold real numbers, got {ascii(str(array.dtype))[:40]}")
    return to_float64(array)


def _rows_beside(values: Float64[np.ndarray, "..."], raw: RawCloud, name: str) -> Float64[np.ndarray, "N 3"]:
    if values.shape != raw.points.shape:
        raise InputError(f"{name} must have shape {raw.points.shape} as the points have, got {values.shape}")
    return values


def _column_names(lines: list[bytes]) -> list[str] | None:
    """Names of the columns, if the first line has them."""
    first = lines[0] if lines else b""
    words = first.lstrip(b"#/").decode("latin-1").replace('"', "").lower().split()
    return words if {"x", "y", "z"} <= set(words) else None


def _announced_count(lines: list[bytes]) -> int | None:
    """The number in the first line, if it stands there alone and more columns follow."""
    if len(lines) < 2 or len(lines[1].split()) < 3 or not lines[0].isdigit() or len(lines[0]) > 12:
        return None
    return int(lines[0])


def _named_columns(table: Float64[np.ndarray, "N D"], names: list[str], path: Path) -> RawCloud:
    if table.shape[1] != len(names):
        raise InputError(f"{path} must have a column for each of its {len(names)} names, got {table.shape[1]} columns")
    found: dict[str, Float64[np.ndarray, "N 3"]] = {}
    for kind, choices in _COLUMNS.items():
        for choice in choices:
            if set(choice) <= set(names):
                found[kind] = np.ascontiguousarray(table[:, [names.index(name) for name in choice]])
    colors = found.get("colors")
    return RawCloud(found["points"], found.get("normals"), None if colors is None else decode_colors(colors))


def _guessed_columns(table: Float64[np.ndarray, "..."], name: str) -> RawCloud:
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{name} must have 3 columns or more, x y z first, got shape {table.shape}")
    normals: Float64[np.ndarray, "N 3"] | None = None
    colors: UInt8[np.ndarray, "N 3"] | None = None
    # Column 3 may also be an intensity, as in `.pts`.
    for start in (3, 6) if table.shape[1] != 7 else (4,):
        block = table[:, start : start + 3]
        if block.shape[1] < 3:
            break
        if normals is None and _look_like_normals(block):
            normals = np.ascontiguousarray(block)
        elif colors is None and _look_like_colors(block):
            colors = block.astype(np.uint8)
    return RawCloud(np.ascontiguousarray(table[:, :3]), normals, colors)


def _look_like_normals(block: Float64[np.ndarray, "N 3"]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(block, axis=1)
    return len(block) > 0 and float(np.mean(np.abs(lengths - 1) < 0.02)) > 0.99


def _look_like_colors(block: Float64[np.ndarray, "N 3"]) -> bool:
    return len(block) > 0 and bool(((block >= 0) & (block <= 255) & (block == np.floor(block))).all())

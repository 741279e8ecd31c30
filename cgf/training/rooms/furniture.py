"""Models of furniture, in their real size, from libraries of the program Sweet Home 3D (`.sh3f`, ZIP archives)."""

import re
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import InputError
from cgf.io.meshes import read_obj
from cgf.types import Progress

_CATALOG = "PluginFurnitureCatalog.properties"
_ENTRY = re.compile(r"^(\w+)#(\d+)=(.*)$", re.MULTILINE)
_TEXTURE_AND_NORMAL = re.compile(rb"/\S*")
"""Of a corner of a face."""
_OUTDOORS = ("Exterior", "Vehicles", "Staircases", "Characters")
_MOST_BYTES = 8_000_000
"""Larger models, most of them trees, cost more than they teach."""
_CENTIMETRE = 0.01


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles."""

    vertices: Float64[np.ndarray, "V 3"]
    triangles: Int64[np.ndarray, "T 3"]


@dataclass(frozen=True, eq=False)
class Model:
    """A piece of furniture, in metres: z up, its back at the lowest y, centred in x and y, standing on z = 0."""

    name: str
    size: Float64[np.ndarray, "3"]
    elevation: float
    """Of its lowest point above the floor, where it hangs."""
    mesh: Mesh


def read_libraries(paths: list[Path], *, progress: Progress) -> list[Model]:
    """Read what may stand in a room from all libraries, in the order of their catalogs.

    Raises:
        InputError: A file is no furniture library, or they hold no model.
    """
    models = []
    for number, path in enumerate(paths):
        progress(number / len(paths), f"reading {path.name}")
        models += _read_library(path)
    if not models:
        names = ", ".join(str(path) for path in paths)
        raise InputError(f"{names} must hold OBJ models of what stands in rooms, got none; give another library")
    return models


def _read_library(path: Path) -> list[Model]:
    try:
        with zipfile.ZipFile(path) as archive:
            models = [_read(archive, entry) for entry in _entries(archive.read(_CATALOG).decode("latin-1"))]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path} must be a furniture library of Sweet Home 3D (.sh3f), got '{error}'; check the path"
        ) from None
    return [model for model in models if model is not None]


def _entries(catalog: str) -> list[dict[str, str]]:
    """The properties of each model, in the order of their numbers."""
    found: dict[int, dict[str, str]] = {}
    for key, number, value in _ENTRY.findall(catalog):
        found.setdefault(int(number), {})[key] = value.strip()
    return [found[number] for number in sorted(found)]


def _read(archive: zipfile.ZipFile, entry: dict[str, str]) -> Model | None:
    """A model in its real size; None if it belongs outdoors, is no OBJ file, or too large."""
    name = entry.get("model", "").lstrip("/")
    if not name.lower().endswith(".obj") or entry.get("category") in _OUTDOORS:
        return None
    if archive.getinfo(name).file_size > _MOST_BYTES:
        return None
    mesh = _read_obj(archive.read(name))
    if not len(mesh.triangles):
        return None
    rotation = np.array(entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split(), dtype=np.float64).reshape(3, 3)
    # In the library x is the width, y the height and z the depth, and the front looks along z.
    x, y, z = (mesh.vertices @ rotation.T).T
    vertices = np.stack([-x, z, y], axis=1)
    size = _CENTIMETRE * np.array([float(entry[key]) for key in ("width", "depth", "height")])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - [*(low + high)[:2] / 2, low[2]]) * (size / np.maximum(high - low, 1e-6))
    elevation = _CENTIMETRE * float(entry.get("elevation", 0))
    return Model(entry.get("name", name), size, elevation, Mesh(vertices, mesh.triangles))


def _read_obj(data: bytes) -> Mesh:
    """Polygons as triangles; materials and what else there is do not matter."""
    with tempfile.NamedTemporaryFile(suffix=".obj") as file:
        kept = (line for line in data.splitlines() if line[:2] in (b"v ", b"f "))
        file.write(b"\n".join(_TEXTURE_AND_NORMAL.sub(b"", line) for line in kept))
        file.flush()
        raw = read_obj(Path(file.name))
    return Mesh(raw.points, np.empty((0, 3), np.int64) if raw.faces is None else raw.faces)

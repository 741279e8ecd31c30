"""OBJ and STL meshes, and normals of vertices from triangles."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import InputError
from cgf.io.raw import RawCloud, decode_colors, parse_rows, to_float64

_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 84


def vertex_normals(
    points: Float64[np.ndarray, "N 3"], faces: Int64[np.ndarray, "F 3"], name: str
) -> Float64[np.ndarray, "N 3"]:
    """Sum of the normals of the triangles at each vertex, weighted by area, of any length.

    The side is that from which the corners run anticlockwise. Vertices of no triangle get zero.

    Raises:
        InputError: A triangle names a vertex that is not there; the text calls the file `name`.
    """
    outside = (faces < 0) | (faces >= len(points))
    if outside.any():
        face, corner = (int(index) for index in np.argwhere(outside)[0])
        raise InputError(
            f"{name} must have faces between its {len(points)} vertices, got vertex {faces[face, corner]} "
            f"in triangle {face}; the file may be damaged"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        a, b, c = (points[faces[:, corner]] for corner in range(3))
        crossed = np.cross(b - a, c - a)
        return np.stack(
            [np.bincount(faces.ravel(), np.repeat(crossed[:, axis], 3), minlength=len(points)) for axis in range(3)],
            axis=1,
        )


def read_obj(path: Path) -> RawCloud:
    """Read vertices, colours after them, and normals (means over the faces' corners) of an OBJ file."""
    vertices: list[tuple[int, bytes]] = []
    directions: list[tuple[int, bytes]] = []
    faces: list[tuple[int, bytes]] = []
    rows = {b"v": vertices, b"vn": directions, b"f": faces}
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        key, _, rest = line.strip().partition(b" ")
        if key in rows:
            rows[key].append((number, rest))
    if not vertices:
        raise InputError(f"{path} must have vertices, lines that begin with 'v', got none; check its format")
    # Colours are an extension: three more numbers. A fourth number alone is a weight.
    width = 6 if all(len(rest.split()) >= 6 for _, rest in vertices) else 3
    table = _table(vertices, width, path)
    corners = _corners(faces, len(vertices), len(directions), path)
    triangles, normals = corners[:, :, 0], None
    if directions:
        vectors = _table(directions, 3, path)
        if len(corners):
            normals = _corner_normals(corners, vectors, len(vertices))
        elif len(directions) == len(vertices):
            normals = vectors
    return RawCloud(
        points=np.ascontiguousarray(table[:, :3]),
        normals=normals,
        colors=decode_colors(table[:, 3:]) if width == 6 else None,
        faces=np.ascontiguousarray(triangles) if len(triangles) else None,
    )


def _table(rows: list[tuple[int, bytes]], width: int, path: Path) -> Float64[np.ndarray, "N D"]:
    return parse_rows([rest for _, rest in rows], width, str(path), [number for number, _ in rows])


def _corners(rows: list[tuple[int, bytes]], vertices: int, normals: int, path: Path) -> Int64[np.ndarray, "F 3 2"]:
    """Vertex and normal of each corner of each triangle, from 0; -1 for a corner without normal."""
    triangles = []
    for number, rest in rows:
        try:
            polygon = [_corner(word, vertices, normals) for word in rest.split()]
        except ValueError:
            shown = ascii(rest[:40].decode("latin-1"))
            raise InputError(
                f"{path} must have faces between vertices that are there, got {shown} in line {number}; "
                "the file may be damaged"
            ) from None
        triangles += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3, 2)


def _corner(word: bytes, vertices: int, normals: int) -> tuple[int, int]:
    """Read `v`, `v/vt`, `v//vn` or `v/vt/vn`; negative numbers count from the end."""
    parts = word.split(b"/")
    vertex = _index(parts[0], vertices)
    normal = _index(parts[2], normals) if len(parts) > 2 and parts[2] else -1
    return vertex, normal


def _index(word: bytes, count: int) -> int:
    value = int(word[:20])
    index = value - 1 if value > 0 else count + value
    if value == 0 or not 0 <= index < count:
        raise ValueError
    return index


def _corner_normals(
    corners: Int64[np.ndarray, "F 3 2"], vectors: Float64[np.ndarray, "M 3"], count: int
) -> Float64[np.ndarray, "N 3"] | None:
    vertex, normal = corners.reshape(-1, 2).T
    known = normal >= 0
    if not known.any():
        return None
    return np.stack(
        [np.bincount(vertex[known], vectors[normal[known], axis], minlength=count) for axis in range(3)], axis=1
    )


def read_stl(path: Path) -> RawCloud:
    """Read the corners of an STL file's triangles, equal ones joined into one vertex."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:_STL_HEADER], "little")
    if len(data) == _STL_HEADER + count * _STL_TRIANGLE.itemsize:
        corners = to_float64(np.frombuffer(data, _STL_TRIANGLE, count, _STL_HEADER)["corners"].reshape(-1, 3))
    elif data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1000]:
        corners = _text_corners(data, path)
    else:
        raise InputError(
            f"{path} must be an STL file, got {len(data)} bytes where its header announces "
            f"{_STL_HEADER + count * _STL_TRIANGLE.itemsize}; the file may be truncated or of another format"
        )
    if not len(corners):
        raise InputError(f"{path} must have triangles, got none")
    points, rows = np.unique(corners, axis=0, return_inverse=True)
    return RawCloud(points=points, faces=rows.reshape(-1, 3).astype(np.int64))


def _text_corners(data: bytes, path: Path) -> Float64[np.ndarray, "C 3"]:
    rows = []
    for number, line in enumerate(data.splitlines(), start=1):
        key, _, rest = line.strip().partition(b" ")
        if key.lower() == b"vertex":
            rows.append((number, rest))
    if len(rows) % 3 or b"endsolid" not in data.lower():
        raise InputError(
            f"{path} must end with 'endsolid' after whole triangles, got {len(rows)} corners; the file may be truncated"
        )
    return _table(rows, 3, path) if rows else np.empty((0, 3))

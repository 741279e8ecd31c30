"""PLY files: text and both byte orders, point clouds, meshes and Cyberware range grids."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from cgf.checks import InputError
from cgf.io.raw import RawCloud, decode_colors, parse_rows
from cgf.types import PointCloud

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str = ""
    """Type of the length of a list; empty for a single value."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(item.count_dtype for item in self.properties)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """Layout of one row in a binary file, lists left out but for their lengths."""
        return np.dtype([(item.name, order + (item.count_dtype or item.dtype)) for item in self.properties])


@dataclass(frozen=True)
class _Header:
    order: str
    """Byte order as numpy writes it; empty for text."""
    elements: tuple[_Element, ...]
    is_cyberware: bool
    size: int
    """Bytes up to the first value."""
    lines: int


def read_ply(path: Path) -> RawCloud:
    """Read the vertices of a PLY file, their normals and colours, and the faces as triangles."""
    data = path.read_bytes()
    header = _parse_header(data, path)
    vertices, faces = _read_binary(data, header, path) if header.order else _read_text(data, header, path)
    points = _numbers(vertices, ("x", "y", "z"))
    if points is None:
        raise InputError(
            f"{path} must have a vertex element with x, y and z, got {', '.join(vertices)[:80] or 'no vertices'!a}"
        )
    colors = _columns(vertices, ("red", "green", "blue"))
    colors = _columns(vertices, ("diffuse_red", "diffuse_green", "diffuse_blue")) if colors is None else colors
    return RawCloud(
        points=points,
        normals=_numbers(vertices, ("nx", "ny", "nz")),
        colors=None if colors is None else decode_colors(colors),
        faces=faces,
        viewpoint=_scanner_position(points) if header.is_cyberware else None,
    )


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a binary PLY with coordinates in double precision."""
    fields = [(axis, "<f8") for axis in "xyz"]
    columns = list(cloud.points.T)
    if cloud.normals is not None:
        fields += [(name, "<f8") for name in ("nx", "ny", "nz")]
        columns += list(cloud.normals.T)
    if cloud.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns += list(cloud.colors.T)
    table = np.empty(len(cloud), dtype=fields)
    for (name, _), column in zip(fields, columns, strict=True):
        table[name] = column
    kinds = {"<f8": "double", "u1": "uchar"}
    properties = "".join(f"property {kinds[kind]} {name}\n" for name, kind in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    path.write_bytes(header.encode("ascii") + table.tobytes())


def _scanner_position(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "3"] | None:
    """A place far on the +z side, where the Cyberware scanner stands in the frame of its raw scans."""
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return None
    low, high = finite.min(axis=0), finite.max(axis=0)
    return np.asarray((low + high) / 2 + np.array([0.0, 0.0, 10.0]) * np.linalg.norm(high - low))


def _parse_header(data: bytes, path: Path) -> _Header:
    head = data[:_LONGEST_HEADER]
    if not head.startswith(b"ply"):
        raise InputError(f"{path} must be a PLY file, got one that does not begin with 'ply'; check its format")
    # Quirk: some programs end lines with a carriage return alone.
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", head)
    if end is None:
        raise InputError(f"{path} must have a PLY header that ends with 'end_header'; the file may be truncated")
    size = end.end()
    lines = head[:size].decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n")[:-1]
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if len(words) == 3 and words[0] == "format" and words[1] in _BYTE_ORDERS:
            order = _BYTE_ORDERS[words[1]]
        elif words and words[0] in ("format", "element", "property") and not _extend(elements, words):
            raise InputError(f"{path} must have a valid PLY header, got {line[:60]!a} in line {number}")
    if any(element.count and not element.properties for element in elements):
        raise InputError(f"{path} must have a PLY header with properties for each element, got an element without any")
    if order is None:
        raise InputError(f"{path} must have a PLY header with a 'format' line, got none")
    is_cyberware = any(line.split() == ["obj_info", "is_cyberware_data", "1"] for line in lines)
    return _Header(order, tuple(elements), is_cyberware, size, len(lines))


def _extend(elements: list[_Element], words: list[str]) -> bool:
    """Take one line of the header into `elements`; False where it is not valid."""
    match words:
        case ["element", name, count] if count.isdecimal() and len(count) < 16:
            elements.append(_Element(name, int(count), ()))
            return True
        case ["property", "list", length, kind, name] if not _TYPES.get(length, "f").startswith("f"):
            item = _Property(name, _TYPES.get(kind, ""), _TYPES[length])
        case ["property", kind, name]:
            item = _Property(name, _TYPES.get(kind, ""))
        case _:
            return False
    if not elements or not item.dtype or any(item.name == other.name for other in elements[-1].properties):
        return False
    last = elements[-1]
    elements[-1] = _Element(last.name, last.count, (*last.properties, item))
    return True


_Tables = tuple[dict[str, np.ndarray], Int64[np.ndarray, "F 3"] | None]


def _read_text(data: bytes, header: _Header, path: Path) -> _Tables:
    lines = [line for line in data[header.size :].splitlines() if line.strip()]
    wanted = sum(element.count for element in header.elements)
    if len(lines) < wanted:
        raise InputError(
            f"{path} must have {wanted} rows after its header, got {len(lines)}; the file may be truncated"
        )
    vertices: dict[str, np.ndarray] = {}
    faces = None
    start = 0
    for element in header.elements:
        rows = lines[start : start + element.count]
        numbers = range(header.lines + 1 + start, header.lines + 1 + start + element.count)
        start += element.count
        if element.name == "vertex" and rows:
            if element.has_lists:
                raise InputError(f"{path} must have single values at its vertices, got a list property")
            table = parse_rows(rows, len(element.properties), str(path), numbers)
            vertices = {
                # Colours are told from fractions by their type, so columns take the type of the header.
                item.name: _cast(table[:, column], item.dtype)
                for column, item in enumerate(element.properties)
            }
        elif element.name == "face" and rows and _face_list(element) == 0:
            faces = _text_faces(rows, str(path), numbers)
    return vertices, faces


def _cast(column: Float64[np.ndarray, "N"], dtype: str) -> np.ndarray:
    if dtype not in ("u1", "u2"):
        return column
    return np.asarray(np.clip(np.nan_to_num(column), 0, np.iinfo(dtype).max), dtype=dtype)


def _text_faces(rows: list[bytes], path: str, numbers: range) -> Int64[np.ndarray, "F 3"]:
    triangles: list[Int64[np.ndarray, "F 3"]] = []
    words = [row.split(maxsplit=1)[0] for row in rows]
    lengths = np.array([int(word) if word.isdigit() and len(word) < 7 else -1 for word in words])
    if (lengths < 0).any():
        row = int(np.argmax(lengths < 0))
        shown = ascii(words[row][:20].decode("latin-1"))
        raise InputError(
            f"{path} must have faces that begin with their number of corners, got {shown} in line {numbers[row]}; "
            "the file may be damaged"
        )
    for length in np.unique(lengths):
        if length < 3:
            continue
        chosen = np.flatnonzero(lengths == length)
        table = parse_rows([rows[row] for row in chosen], int(length) + 1, path, [numbers[int(row)] for row in chosen])
        triangles.append(_fan(_as_rows(table[:, 1:])))
    return np.concatenate([np.empty((0, 3), dtype=np.int64), *triangles])


def _as_rows(values: Float64[np.ndarray, "F K"]) -> Int64[np.ndarray, "F K"]:
    """Indices as integers; what cannot be one becomes -1, which no face may hold."""
    valid = np.isfinite(values) & (np.abs(values) < 2**52)
    rows: Int64[np.ndarray, "F K"] = np.where(valid, values, -1).astype(np.int64)
    return rows


def _fan(polygons: Int64[np.ndarray, "F K"]) -> Int64[np.ndarray, "T 3"]:
    """Cut polygons of equal length into triangles around their first corner."""
    corners = polygons.shape[1]
    parts = [polygons[:, [0, corner, corner + 1]] for corner in range(1, corners - 1)]
    return np.concatenate([np.empty((0, 3), dtype=np.int64), *parts])


def _face_list(element: _Element) -> int | None:
    """Which property lists the corners of a face."""
    for column, item in enumerate(element.properties):
        if item.count_dtype and not item.dtype.startswith("f") and item.name in ("vertex_indices", "vertex_index"):
            return column
    return None


def _read_binary(data: bytes, header: _Header, path: Path) -> _Tables:
    vertices: dict[str, np.ndarray] = {}
    faces = None
    offset = header.size
    has_faces = any(element.name == "face" for element in header.elements)
    for element in header.elements:
        dtype = element.dtype(header.order)
        # A list holds at least its length, so this many bytes must be there in any case.
        if len(data) - offset < element.count * dtype.itemsize:
            raise InputError(
                f"{path} must have {element.count} rows of '{element.name}', got {len(data) - offset} bytes for them; "
                "the file may be truncated"
            )
        if not element.has_lists:
            table = np.frombuffer(data, dtype=dtype, count=element.count, offset=offset)
            offset += element.count * dtype.itemsize
            if element.name == "vertex":
                vertices = {name: table[name] for name in dtype.names or ()}
        elif element.name == "vertex":
            raise InputError(f"{path} must have single values at its vertices, got a list property")
        elif vertices and not (has_faces and faces is None):
            break
        else:
            found, offset = _binary_lists(data, element, header.order, offset, path)
            faces = found if element.name == "face" else faces
    return vertices, faces


def _binary_lists(
    data: bytes, element: _Element, order: str, offset: int, path: Path
) -> tuple[Int64[np.ndarray, "F 3"] | None, int]:
    """Triangles of an element with lists, or None if it has no corners; and where it ends."""
    column = _face_list(element)
    regular = _regular_lists(data, element, order, offset)
    if regular is not None:
        table, end = regular
        found = None if column is None else _fan(table[element.properties[column].name]["values"].astype(np.int64))
        return found, end
    by_length: dict[int, list[np.ndarray]] = {}
    for _ in range(element.count):
        for index, item in enumerate(element.properties):
            kind = np.dtype(order + item.dtype)
            length = 1
            if item.count_dtype:
                count_kind = np.dtype(order + item.count_dtype)
                length = int(np.frombuffer(_bytes(data, offset, count_kind.itemsize, path), count_kind)[0])
                offset += count_kind.itemsize
            values = _bytes(data, offset, max(length, 0) * kind.itemsize, path)
            offset += len(values)
            if index == column and length >= 3:
                by_length.setdefault(length, []).append(np.frombuffer(values, kind))
    if column is None:
        return None, offset
    parts = [_fan(np.stack(rows).astype(np.int64)) for rows in by_length.values()]
    return (np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.int64)), offset


def _bytes(data: bytes, offset: int, size: int, path: Path) -> bytes:
    if offset + size > len(data):
        raise InputError(f"{path} must hold all of its faces, got an end within them; the file may be truncated")
    return data[offset : offset + size]


def _regular_lists(data: bytes, element: _Element, order: str, offset: int) -> tuple[np.ndarray, int] | None:
    """The element as one table, if every list is as long as that of the first row, as in a triangle mesh."""
    fields: list[tuple[str, object]] = []
    lengths: dict[str, int] = {}
    position = offset
    for item in element.properties:
        kind = np.dtype(order + item.dtype)
        if not item.count_dtype:
            fields.append((item.name, kind))
            position += kind.itemsize
            continue
        count_kind = np.dtype(order + item.count_dtype)
        if element.count == 0 or position + count_kind.itemsize > len(data):
            return None
        length = int(np.frombuffer(data, count_kind, count=1, offset=position)[0])
        if not 0 <= length <= 255:
            return None
        lengths[item.name] = length
        fields.append((item.name, np.dtype([("length", count_kind), ("values", kind, (length,))])))
        position += count_kind.itemsize + length * kind.itemsize
    dtype = np.dtype(fields)
    if offset + element.count * dtype.itemsize > len(data):
        return None
    table = np.frombuffer(data, dtype=dtype, count=element.count, offset=offset)
    if any((table[name]["length"] != length).any() for name, length in lengths.items()):
        return None
    return table, offset + element.count * dtype.itemsize


def _columns(table: dict[str, np.ndarray], names: tuple[str, str, str]) -> np.ndarray | None:
    """Three columns of a table side by side, if it has them all."""
    if not all(name in table for name in names):
        return None
    return np.stack([table[name] for name in names], axis=1)


def _numbers(table: dict[str, np.ndarray], names: tuple[str, str, str]) -> Float64[np.ndarray, "N 3"] | None:
    """Three columns in double precision; the odd NaN of a damaged file is no cause for a warning."""
    if not all(name in table for name in names):
        return None
    rows = np.empty((len(table[names[0]]), 3))
    with np.errstate(over="ignore", invalid="ignore"):
        for column, name in enumerate(names):
            rows[:, column] = table[name]
    return rows

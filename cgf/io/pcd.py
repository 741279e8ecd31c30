"""PCD files of the Point Cloud Library: text, binary and compressed."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from cgf.checks import InputError
from cgf.io.raw import RawCloud, decode_colors, parse_rows, to_float64

_LONGEST_HEADER = 1 << 16
_LARGEST_EXPANSION = 300  # LZF turns 3 bytes into at most 264


def read_pcd(path: Path) -> RawCloud:
    """Read points, normals and colours of a PCD file; the viewpoint is the translation it gives."""
    data = path.read_bytes()
    header, body = _parse_header(data, path)
    names = _names(header, path)
    dtype = _row_dtype(header, names, path)
    count = _point_count(header, path)
    viewpoint = _viewpoint(header, path)
    mode = header["DATA"][0]
    if mode == "ascii":
        table = _read_ascii(data, body, dtype, count, path)
    elif mode == "binary":
        table = _from_rows(data[body:], dtype, count, path)
    elif mode == "binary_compressed":
        table = _read_compressed(data[body:], dtype, count, path)
    else:
        raise InputError(f"{path} must have DATA ascii, binary or binary_compressed, got {mode[:30]!a}")
    points = _columns(table, ("x", "y", "z"))
    if points is None:
        raise InputError(f"{path} must have the fields x, y and z, got {' '.join(names)[:80]!a}")
    return RawCloud(
        points=points,
        normals=_columns(table, ("normal_x", "normal_y", "normal_z")),
        colors=_colors(table),
        viewpoint=viewpoint,
    )


def _parse_header(data: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Words of the header by the first of each line, and where the data begins."""
    header: dict[str, list[str]] = {}
    start = 0
    while start < min(len(data), _LONGEST_HEADER):
        end = data.find(b"\n", start)
        if end < 0:
            break
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if not words or words[0].startswith("#"):
            continue
        header[words[0].upper()] = words[1:]
        if words[0].upper() == "DATA" and len(words) > 1:
            return header, start
    raise InputError(
        f"{path} must be a PCD file with a header that ends with a DATA line, got none; "
        "the file may be truncated or of another format"
    )


def _viewpoint(header: dict[str, list[str]], path: Path) -> Float64[np.ndarray, "3"] | None:
    """Translation of the sensor; its rotation does not matter here."""
    words = header.get("VIEWPOINT")
    if words is None:
        return None
    try:
        position = np.array([float(word) for word in words[:3]])
    except ValueError:
        position = np.empty(0)
    if len(position) != 3 or not np.isfinite(position).all():
        raise InputError(f"{path} must have 3 numbers or more after VIEWPOINT, got {' '.join(words)[:40]!a}")
    return position


def _names(header: dict[str, list[str]], path: Path) -> list[str]:
    names = header.get("FIELDS") or header.get("COLUMNS")
    if not names:
        raise InputError(f"{path} must have FIELDS in its header, got none")
    # Padding is called `_` and may come several times.
    return [f"_{index}" if name == "_" else name for index, name in enumerate(names)]


def _row_dtype(header: dict[str, list[str]], names: list[str], path: Path) -> np.dtype[np.void]:
    sizes = header.get("SIZE", ["4"] * len(names))
    kinds = header.get("TYPE", ["F"] * len(names))
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts) or len(set(names)) < len(names):
        raise InputError(f"{path} must have as many SIZE, TYPE and COUNT as FIELDS in its header, all of them distinct")
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        code = f"<{kind.lower()}{size}"
        if code not in ("<f4", "<f8", "<i1", "<i2", "<i4", "<i8", "<u1", "<u2", "<u4", "<u8"):
            raise InputError(
                f"{path} must have fields of type F, I or U of 1 to 8 bytes, got {ascii(kind + size)[:20]}"
            )
        if not count.isdecimal() or not 1 <= int(count) <= 100_000:
            raise InputError(f"{path} must have a COUNT of 1 or more for each field, got {ascii(count)[:20]}")
        fields.append((name, code, (int(count),)))
    return np.dtype(fields)


def _point_count(header: dict[str, list[str]], path: Path) -> int:
    """POINTS, or the product of WIDTH and HEIGHT in old files."""
    counts = []
    for key in ("POINTS",) if "POINTS" in header else ("WIDTH", "HEIGHT"):
        words = header.get(key, [])
        if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 15:
            raise InputError(f"{path} must have a number after {key} in its header, got {' '.join(words)[:40]!a}")
        counts.append(int(words[0]))
    return math.prod(counts)


def _read_ascii(data: bytes, body: int, dtype: np.dtype[np.void], count: int, path: Path) -> np.ndarray:
    lines = [line for line in data[body:].splitlines() if line.strip()]
    if len(lines) < count:
        raise InputError(f"{path} must have {count} points, got {len(lines)} rows; the file may be truncated")
    table = np.zeros(count, dtype=dtype)
    if not count:
        return table
    # Packed colours are large integers, which float64 holds exactly.
    width = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
    first = data[:body].count(b"\n") + 1
    rows = parse_rows(lines[:count], width, str(path), range(first, first + count))
    column = 0
    for name in dtype.names or ():
        (length,) = dtype[name].shape
        values = rows[:, column : column + length]
        # Numbers beyond the field's type become inf, or whatever an integer makes of them, as they would in C.
        with np.errstate(over="ignore", invalid="ignore"):
            table[name] = values
        column += length
    return table


def _from_rows(data: bytes, dtype: np.dtype[np.void], count: int, path: Path) -> np.ndarray:
    if len(data) < count * dtype.itemsize:
        raise InputError(
            f"{path} must have {count} points of {dtype.itemsize} bytes, got {len(data)} bytes; "
            "the file may be truncated"
        )
    return np.frombuffer(data, dtype=dtype, count=count)


def _read_compressed(data: bytes, dtype: np.dtype[np.void], count: int, path: Path) -> np.ndarray:
    size = count * dtype.itemsize
    packed, unpacked = (int(value) for value in np.frombuffer(data[:8].ljust(8, b"\0"), "<u4"))
    if len(data) < 8 + packed or unpacked < size or unpacked > max(packed, 1) * _LARGEST_EXPANSION:
        raise InputError(
            f"{path} must have {count} points of {dtype.itemsize} bytes in {packed} compressed bytes, "
            f"got {max(len(data) - 8, 0)} bytes for {unpacked}; the file may be truncated"
        )
    content = _decompress_lzf(data[8 : 8 + packed], unpacked)
    if content is None:
        raise InputError(f"{path} must have {unpacked} bytes after decompression; the file may be damaged")
    # The compressed form holds all of the first field, then all of the second, and so on.
    table = np.zeros(count, dtype=dtype)
    offset = 0
    for name in dtype.names or ():
        field = dtype[name]
        table[name] = np.frombuffer(content, field.base, count * field.shape[0], offset).reshape(count, -1)
        offset += count * field.itemsize
    return table


def _decompress_lzf(data: bytes, size: int) -> bytes | None:
    """Undo Marc Lehmann's LZF; None where the data is not LZF of that size."""
    out = bytearray()
    position = 0
    try:
        while position < len(data) and len(out) <= size:
            control = data[position]
            position += 1
            if control < 32:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            start = len(out) - ((control & 31) << 8) - data[position] - 1
            position += 1
            length += 2
            if start < 0:
                return None
            # A copy may reach into what it writes: then it repeats.
            piece = out[start : start + length]
            while len(piece) < length:
                piece += piece[: length - len(piece)]
            out += piece
    except IndexError:
        return None
    return bytes(out) if len(out) == size else None


def _columns(table: np.ndarray, names: tuple[str, str, str]) -> np.ndarray | None:
    if not all(name in (table.dtype.names or ()) for name in names):
        return None
    return to_float64(np.stack([table[name][:, 0] for name in names], axis=1))


def _colors(table: np.ndarray) -> np.ndarray | None:
    """Colours, which PCL packs into four bytes that it often calls a float."""
    for name in ("rgb", "rgba"):
        if name in (table.dtype.names or ()) and table.dtype[name].base.itemsize == 4:
            packed = np.ascontiguousarray(table[name][:, 0]).view(np.uint32)
            return np.stack([packed >> 16, packed >> 8, packed], axis=1).astype(np.uint8)
    separate = _columns(table, ("r", "g", "b"))
    return None if separate is None else decode_colors(separate)

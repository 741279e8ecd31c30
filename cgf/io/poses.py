"""Rigid motions in files: 4x4 matrices, trajectory logs and their information matrices."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from cgf.checks import ArrayLike, InputError, check_transform
from cgf.io.clouds import check_file
from cgf.io.tables import read_matrix

_SHOWN_BLOCKS = 8


@dataclass(frozen=True, eq=False)
class LogEntry:
    """One block of a `gt.log`: the pose of one fragment in the frame of another."""

    target: int
    source: int
    total: int
    """Number of fragments, as the file says; -1 where it does not know."""
    target_from_source: Float64[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class InfoEntry:
    """One block of a `gt.info`."""

    target: int
    source: int
    total: int
    information: Float64[np.ndarray, "6 6"]
    """Weighs the squared error of a pose; 3DMatch has translation first, Fast Global Registration rotation first."""


def read_transform(path: str | Path, *, source_name: str = "", target_name: str = "") -> Float64[np.ndarray, "4 4"]:
    """Read the motion of the source onto the target.

    Args:
        path: A 4x4 matrix in a text or NPY file, or a log with blocks `target source total` and a 4x4.
        source_name: File name of the source, whose last number tells its block of a log with several.
        target_name: The same for the target. A block of the reversed pair is inverted.

    Raises:
        InputError: The file is missing, of another format, has no block for this pair, or its matrix is not rigid.
    """
    path = Path(path)
    check_file(path)
    if path.suffix.lower() == ".npy":
        return _rigid(read_matrix(path), str(path))
    lines = _lines(path)
    if lines and _header(lines[0][1]) is not None:
        return _choose(read_log(path), path, index_in_name(source_name), index_in_name(target_name))
    return _rigid(_matrix(lines, path, 4), str(path))


def write_transform(path: str | Path, target_from_source: Float64[np.ndarray, "4 4"]) -> None:
    """Write a 4x4 matrix as text that reads back to the last digit.

    Raises:
        InputError: The file cannot be written.
    """
    _write(path, _matrix_text(target_from_source))


def read_log(path: str | Path) -> list[LogEntry]:
    """Read all blocks of a trajectory log, in the order of the file.

    Raises:
        InputError: The file is missing, damaged, or one of its matrices is not rigid.
    """
    path = Path(path)
    entries = []
    for target, source, total, matrix in _blocks(path, 4):
        entries.append(LogEntry(target, source, total, _rigid(matrix, f"block {target} {source} of {path}")))
    return entries


def write_log(path: str | Path, entries: list[LogEntry]) -> None:
    """Write a trajectory log that `read_log` reads back to the last digit.

    Raises:
        InputError: The file cannot be written.
    """
    blocks = [f"{e.target} {e.source} {e.total}\n{_matrix_text(e.target_from_source)}" for e in entries]
    _write(path, "\n".join(blocks))


def read_info(path: str | Path) -> list[InfoEntry]:
    """Read all information matrices that go with a trajectory log.

    Raises:
        InputError: The file is missing or damaged.
    """
    return [InfoEntry(*block) for block in _blocks(Path(path), 6)]


def index_in_name(name: str) -> int | None:
    """The last number in the stem of a file name: 7 for `cloud_bin_7.ply`."""
    numbers = re.findall(r"\d+", Path(name).stem)
    return int(numbers[-1]) if numbers else None


def _matrix_text(matrix: Float64[np.ndarray, "4 4"]) -> str:
    return "\n".join(" ".join(repr(float(value)) for value in row) for row in matrix)


def _write(path: str | Path, text: str) -> None:
    try:
        Path(path).write_text(text + "\n", encoding="ascii")
    except OSError as error:
        raise InputError(f"{path} must be writable, got '{error.strerror}'; choose another place") from None


def _choose(entries: list[LogEntry], path: Path, source: int | None, target: int | None) -> Float64[np.ndarray, "4 4"]:
    for entry in entries:
        if (entry.target, entry.source) == (target, source):
            return entry.target_from_source
    for entry in entries:
        if (entry.target, entry.source) == (source, target):
            return np.linalg.inv(entry.target_from_source)
    if len(entries) == 1:
        return entries[0].target_from_source
    found = ", ".join(f"{entry.target} {entry.source}" for entry in entries[:_SHOWN_BLOCKS])
    more = f" and {len(entries) - _SHOWN_BLOCKS} more" if len(entries) > _SHOWN_BLOCKS else ""
    wanted = f"{'?' if target is None else target} {'?' if source is None else source}"
    raise InputError(
        f"{path} must have a block '{wanted}' (target and source: the last numbers in the names of the files), "
        f"got {found}{more}; rename the files or give a 4x4 matrix"
    )


def _lines(path: Path) -> list[tuple[int, bytes]]:
    """Lines that are neither empty nor comments, with their numbers, commas as blanks."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} must be readable, got '{error.strerror}'; check its permissions") from None
    lines = ((number, line.replace(b",", b" ").strip()) for number, line in enumerate(data.splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith(b"#")]


def _header(line: bytes) -> tuple[int, int, int] | None:
    words = line.split()
    if len(words) != 3 or not all(re.fullmatch(rb"-?\d{1,9}", word) for word in words):
        return None
    target, source, total = (int(word) for word in words)
    return target, source, total


def _blocks(path: Path, size: int) -> Iterator[tuple[int, int, int, Float64[np.ndarray, "D D"]]]:
    check_file(path)
    lines = _lines(path)
    if not lines:
        raise InputError(f"{path} must have blocks of three integers and a {size}x{size} matrix, got none")
    for start in range(0, len(lines), size + 1):
        number, line = lines[start]
        header = _header(line)
        if header is None:
            shown = ascii(line[:30].decode("latin-1"))
            raise InputError(
                f"{path} must have blocks of three integers and a {size}x{size} matrix, got {shown} in line {number}"
            )
        yield *header, _matrix(lines[start + 1 : start + 1 + size], path, size)


def _matrix(lines: list[tuple[int, bytes]], path: Path, size: int) -> Float64[np.ndarray, "D D"]:
    rows = [line.split() for _, line in lines]
    try:
        values = np.array([[float(word) for word in row] for row in rows])
    except ValueError:
        values = np.empty(0)
    if values.shape != (size, size):
        place = f" from line {lines[0][0]} on" if lines else ""
        widths = ", ".join(map(str, sorted({len(row) for row in rows}))) or "none"
        raise InputError(
            f"{path} must have {size} rows of {size} numbers{place}, got {len(rows)} rows of {widths}; "
            "the file may be truncated or of another format"
        )
    return values


def _rigid(matrix: ArrayLike, name: str) -> Float64[np.ndarray, "4 4"]:
    try:
        return check_transform(matrix, name)
    except ValueError as error:
        raise InputError(str(error)) from None

"""What a reader of one format finds in a file, before it is checked."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from cgf.checks import InputError


@dataclass(frozen=True, eq=False)
class RawCloud:
    """Arrays as they stand in a file; they may hold NaN, and normals of any length."""

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"] | None = None
    colors: UInt8[np.ndarray, "N 3"] | None = None
    faces: Int64[np.ndarray, "F 3"] | None = None
    """Triangles, as rows of `points`; rows out of range are possible."""
    viewpoint: Float64[np.ndarray, "3"] | None = None
    """Where the sensor was, if the file says so."""


def to_float64(values: np.ndarray) -> Float64[np.ndarray, "..."]:
    """Real numbers in double precision; the odd NaN of a damaged file is no cause for a warning."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float64, order="C")


def decode_colors(values: np.ndarray) -> UInt8[np.ndarray, "N 3"]:
    """Colours as bytes: floats are taken as 0 to 1 where none is above 1, 16-bit integers are scaled down."""
    if values.dtype == np.uint8:
        return values.astype(np.uint8, order="C")
    if values.dtype == np.uint16:
        return (values >> 8).astype(np.uint8)
    levels = np.nan_to_num(to_float64(values), nan=0.0, posinf=255.0, neginf=0.0)
    if values.dtype.kind == "f" and (levels <= 1).all():
        levels = levels * 255
    return np.asarray(np.rint(np.clip(levels, 0, 255)), dtype=np.uint8)


def parse_rows(
    lines: list[bytes], columns: int | None, path: str, numbers: Sequence[int]
) -> Float64[np.ndarray, "N D"]:
    """Numbers of a text table, one row a line, separated by blanks.

    Args:
        lines: Lines that are not empty.
        columns: Fewest columns a row must have, and how many are kept; None keeps all, which must then be as many
            in every row.
        path: For messages.
        numbers: Of the lines in their file, for messages.

    Raises:
        InputError: A row is too short, of another width, or holds something that is no number.
    """
    kept = range(columns) if columns is not None else None
    table: Float64[np.ndarray, "N D"] | None = None
    with suppress(ValueError):
        # The comment sign is one that no number holds: a damaged line must not pass for a comment.
        table = np.loadtxt(lines, dtype=np.float64, comments=None, usecols=kept, ndmin=2, encoding="latin-1")
    # Lines of odd blanks are skipped without a word.
    if table is None or len(table) < len(lines):
        raise InputError(_bad_row(lines, columns, path, numbers))
    return table


def _bad_row(lines: list[bytes], columns: int | None, path: str, numbers: Sequence[int]) -> str:
    """Say what is wrong with the first row that cannot be read."""
    wanted = columns if columns is not None else len(lines[0].split())
    for number, line in zip(numbers, lines, strict=False):
        fields = line.split()
        short = len(fields) < wanted if columns is not None else len(fields) != wanted
        if short:
            return (
                f"{path} must have {wanted} numbers in every row, got {len(fields)} in line {number}; "
                "the file may be truncated"
            )
        for text in fields[:wanted]:
            if not _is_number(text):
                shown = ascii(text[:20].decode("latin-1"))
                return f"{path} must hold numbers, got {shown} in line {number}; the file may be damaged"
    return f"{path} must hold rows of numbers; the file may be damaged"


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True

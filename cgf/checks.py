"""Checks at the border: each raises one sentence that names the value and the remedy."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, SupportsFloat

import numpy as np
from jaxtyping import Float64

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
else:
    # The union in numpy refuses tuples where annotations are checked while running; our own checks say more anyway.
    ArrayLike = Any

__all__ = [
    "ArrayLike",
    "InputError",
    "check_count",
    "check_finite_rows",
    "check_fraction",
    "check_points",
    "check_positive",
    "check_transform",
]

_LARGEST_COORDINATE = 1e100  # squares of anything larger overflow further down
_FLAT_RATIO = 1e-6
_BLOCK = 1 << 14


class InputError(ValueError):
    """A file or a setting that the user gave cannot be used; the text is one readable line."""


def check_points(points: ArrayLike, name: str = "points", *, minimum: int = 10) -> Float64[np.ndarray, "N 3"]:
    """Copy `points` as float64 rows, after checking that a surface can be seen in them.

    Args:
        points: Anything that numpy makes an (N, 3) array of.
        name: What the caller calls them: an argument or a file.
        minimum: Fewest rows accepted.

    Raises:
        ValueError: Not (N, 3), NaN or inf, too few, too large, all equal, or all on one line.
    """
    array = _as_float(points, name)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} must have shape (N, 3), got {array.shape}")
    check_finite_rows(array, name)
    if len(array) < minimum:
        raise ValueError(f"{name} must have {minimum} points or more, got {len(array)}")
    if len(array):
        _check_extent(array, name)
    return array


def check_finite_rows(array: Float64[np.ndarray, "N D"], name: str, *, remedy: str = "drop them first") -> None:
    """Raise a ValueError that counts the rows of `array` holding NaN or inf, if there are any."""
    finite = np.isfinite(array)
    if not finite.all():
        invalid = ~finite.all(axis=1)
        count, first = int(invalid.sum()), int(np.argmax(invalid))
        raise ValueError(
            f"{name} must be finite, got {count} of {len(array)} rows with NaN or inf (first at row {first}); {remedy}"
        )


def check_transform(
    matrix: ArrayLike, name: str = "target_from_source", *, tolerance: float = 1e-3
) -> Float64[np.ndarray, "4 4"]:
    """Copy `matrix` as float64, after checking that it is a rigid motion.

    Args:
        matrix: 4x4, acting on columns.
        name: What the caller calls it.
        tolerance: Largest deviation of an entry of R'R from the identity, for matrices printed with few digits.

    Raises:
        ValueError: Not 4x4, not finite, or not rigid; the text says in which way.
    """
    array = _as_float(matrix, name)
    if array.shape != (4, 4):
        raise ValueError(f"{name} must have shape (4, 4), got {array.shape}")
    check_finite_rows(array, name, remedy="give a 4x4 rigid motion")
    if not np.allclose(array[3], (0, 0, 0, 1), rtol=0, atol=1e-6):
        raise ValueError(
            f"{name} must have the last row 0 0 0 1, got {_row(array[3])}; "
            "give the matrix that acts on columns, transposed if need be"
        )
    rotation = array[:3, :3]
    scale = float(np.cbrt(abs(np.linalg.det(rotation))))
    deviation = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not deviation <= tolerance:
        raise ValueError(
            f"{name} must be rigid, got a 3x3 part that deviates from a rotation by {deviation:.3g} "
            f"(scale {scale:.4g}); remove scale and shear"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"{name} must be a rotation and a translation, got a reflection; flip the sign of one axis")
    return array


def check_positive(value: SupportsFloat, name: str) -> float:
    """Return `value` as a float, after checking that it is finite and above zero."""
    number = float(value)
    if not np.isfinite(number) or number <= 0:
        raise ValueError(f"{name} must be positive, got {number:g}")
    return number


def check_count(value: int, name: str, *, minimum: int) -> None:
    """Raise a ValueError if `value` is below `minimum`."""
    if value < minimum:
        raise ValueError(f"{name} must be {minimum} or more, got {value}")


def check_fraction(value: SupportsFloat, name: str) -> None:
    """Raise a ValueError unless `value` lies between 0 and 1 and is neither."""
    number = float(value)
    if not 0 < number < 1:
        raise ValueError(f"{name} must be between 0 and 1, got {number:g}")


def _as_float(values: ArrayLike, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biuf":
            raise TypeError
        return np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array of real numbers, got {type(values).__name__}") from None


def _check_extent(points: Float64[np.ndarray, "N 3"], name: str) -> None:
    largest = max(float(points.max()), -float(points.min()))
    if largest > _LARGEST_COORDINATE:
        row = int(np.argmax(np.abs(points).max(axis=1)))
        raise ValueError(
            f"{name} must stay below {_LARGEST_COORDINATE:g}, got {largest:.3g} at row {row}; "
            "the file may be damaged or in another byte order"
        )
    extent = max(float(np.abs(block).max()) for block in _centred_blocks(points, points[0]))
    if extent <= 1e-14 * largest or extent == 0:
        raise ValueError(
            f"{name} must spread in space, got {len(points)} points that are all equal to {_row(points[0])}"
        )
    mean = points[0] + sum(block.sum(axis=0) / len(points) for block in _centred_blocks(points, points[0]))
    products = sum(block.T @ block for block in _centred_blocks(points, mean, scale=extent))
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(products), 0))
    if len(points) > 2 and spreads[1] <= _FLAT_RATIO * spreads[2]:
        raise ValueError(
            f"{name} must spread in space, got {len(points)} points on one line, or one far from all others"
        )


def _centred_blocks(
    points: Float64[np.ndarray, "N 3"], centre: Float64[np.ndarray, "3"], *, scale: float = 1.0
) -> Iterator[Float64[np.ndarray, "B 3"]]:
    """`points` minus `centre` over `scale`, some at a time: ten million at once take seconds to write to memory."""
    return ((points[start : start + _BLOCK] - centre) / scale for start in range(0, len(points), _BLOCK))


def _row(values: Float64[np.ndarray, "D"]) -> str:
    return " ".join(f"{value:.6g}" for value in values)

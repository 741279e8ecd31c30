"""How rows of numbers lie in memory for the tile registers of `cgf.descriptors.amx`, and where each bin goes."""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt16
from numba import njit

from cgf.descriptors.settings import AZIMUTH_BINS, CHANNELS, COLUMN_BINS, ELEVATION_BINS, RADIAL_BINS

EDGE = 32
"""Rows of a block: two tiles of 16."""
DEPTH = 32
"""Numbers of a row of a tile, which one step of a product takes."""
_LINE = 32
"""Numbers of two bytes in a line of the cache."""
_OUTER = RADIAL_BINS - 1
HISTOGRAM_STEPS = -(-COLUMN_BINS * CHANNELS // DEPTH)
"""Of one azimuth sector of an oriented histogram."""
INNERMOST_STEP = _OUTER * CHANNELS * ELEVATION_BINS // DEPTH
"""From where on the innermost shells stand, channel by channel for each elevation, after all others."""
STEPS_OF_ELEVATION = _OUTER * CHANNELS // DEPTH
assert INNERMOST_STEP * DEPTH == _OUTER * CHANNELS * ELEVATION_BINS


class Tiles(NamedTuple):
    """Histograms as `cgf.descriptors.amx` takes them; from `histogram_room`."""

    numbers: UInt16[np.ndarray, "B 12 T 32 32"]
    """Blocks of 32, whose sectors' rows stand together step by step."""
    used: Bool[np.ndarray, "B 12 T"]
    """Which steps of a block hold anything but zeros; the others need not be multiplied."""


def steps_of(numbers: int) -> int:
    """Steps that a row of so many numbers takes; the last is filled up with zeros."""
    return -(-numbers // DEPTH)


def histogram_order(channels: int) -> Int64[np.ndarray, "P"]:
    """For each place of a sector's row for the tiles, the number of its bin in a histogram of so many channels.

    Shells but the innermost come first, 16 of one channel after the other, elevation by elevation: so many are written
    at once.
    """
    bins = np.arange(channels * COLUMN_BINS).reshape(channels, ELEVATION_BINS, RADIAL_BINS).transpose(1, 0, 2)
    return np.concatenate([bins[:, :, 1:].ravel(), bins[:, :, 0].ravel()])


def to_bfloat16(values: Float32[np.ndarray, "*S"]) -> UInt16[np.ndarray, "*S"]:
    """The upper halves of the numbers, rounded to the nearest, ties to even."""
    bits = values.view(np.uint32)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).astype(np.uint16)


@njit(nogil=True)
@no_type_check
def aligned_room(size):
    """Zeros that begin with a line of the cache, so that no row of a tile lies in two: that takes twice the time."""
    room = np.zeros(size + _LINE, np.uint16)
    start = (-room.ctypes.data % (2 * _LINE)) // 2
    return room[start : start + size]


def histogram_room(rows: int, steps: int = HISTOGRAM_STEPS) -> Tiles:
    """Memory for so many histograms, by default oriented."""
    shape = (-(-rows // EDGE), AZIMUTH_BINS, steps, EDGE, DEPTH)
    return Tiles(np.asarray(aligned_room(int(np.prod(shape))).reshape(shape)), np.zeros(shape[:3], np.bool_))

"""The circular convolutions of the azimuth network: the first of what there is, the others as few matrix products.

Of an oriented histogram six bins of seven hold no neighbour, so adding up rows of weights for the others is faster than
products with all of them. The layers after it are dense. There Winograd's minimal filtering F(4, 3) gives four outputs
of a filter of three taps by 6 products instead of 12 (Lavin and Gray, Fast Algorithms for Convolutional Neural
Networks, 2016). Its transforms are sums over a few columns, compiled so that they pass through memory once.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

from cgf.descriptors.settings import AZIMUTH_BINS, CHANNELS

_TILES = AZIMUTH_BINS // 4
_TILE_OF_FILTER = np.array(
    [[1 / 4, 0, 0], [-1 / 6, -1 / 6, -1 / 6], [-1 / 6, 1 / 6, -1 / 6], [1 / 24, 1 / 12, 1 / 6],
     [1 / 24, -1 / 12, 1 / 6], [0, 0, 1]],
)  # fmt: skip


def filter_tiles(weight: Float32[np.ndarray, "O I3"]) -> Float32[np.ndarray, "6 I O"]:
    """The three taps of a layer (before, at, after a column), transformed for `convolve_circularly`."""
    taps = np.stack(np.split(weight.astype(np.float64), 3, axis=1))
    return np.ascontiguousarray(np.einsum("wk,koi->wio", _TILE_OF_FILTER, taps), dtype=np.float32)


def convolve_circularly(
    columns: Float32[np.ndarray, "12 K I"], tiles: Float32[np.ndarray, "6 I O"], bias: Float32[np.ndarray, "O"]
) -> Float32[np.ndarray, "12 K O"]:
    """Each column from itself and its two neighbours, plus `bias`, and zero where that is negative."""
    count, width = columns.shape[1:]
    spread = np.empty((6, _TILES * count, width), np.float32)
    _transform_input(columns, spread)
    products = np.matmul(spread, tiles)
    outputs = np.empty((AZIMUTH_BINS, count, len(bias)), np.float32)
    _transform_output(products, bias, outputs)
    return outputs


def pack_bins(weight: Float32[np.ndarray, "O I3"]) -> Float32[np.ndarray, "3 B C O"]:
    """The three taps of the first layer by bin and channel, for `convolve_filled`."""
    outputs = len(weight)
    bins = weight.shape[1] // (3 * CHANNELS)
    packed = _aligned((3, bins, CHANNELS, outputs))
    packed[:] = weight.reshape(outputs, 3, CHANNELS, bins).transpose(1, 3, 2, 0)
    return packed


def convolve_filled(
    values: Float32[np.ndarray, "K W"], packed: Float32[np.ndarray, "3 B C O"], bias: Float32[np.ndarray, "O"]
) -> Float32[np.ndarray, "12 K O"]:
    """As `convolve_circularly`, of oriented histograms, whose bins are empty where the first channel is zero."""
    outputs = _aligned((AZIMUTH_BINS, len(values), len(bias)))
    _add_filled(values.reshape(len(values), AZIMUTH_BINS, CHANNELS, -1), packed, bias, outputs)
    return outputs


def _aligned(shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Memory that begins with a line of the cache, so that vectors do not lie in two."""
    size = int(np.prod(shape))
    room = np.empty(size + 16, np.float32)
    start = -room.ctypes.data % 64 // 4
    return room[start : start + size].reshape(shape)


@njit(cache=True, nogil=True, fastmath={"contract"})
@no_type_check
def _add_filled(values, packed, bias, outputs):
    bins = packed.shape[1]
    filled = np.empty((AZIMUTH_BINS, bins), np.int32)
    counts = np.empty(AZIMUTH_BINS, np.int32)
    for k in range(len(values)):
        for sector in range(AZIMUTH_BINS):
            count = 0
            for b in range(bins):
                filled[sector, count] = b
                count += values[k, sector, 0, b] > 0
            counts[sector] = count
        for sector in range(AZIMUTH_BINS):
            sums = outputs[sector, k]
            sums[:] = bias
            for tap in range(3):
                near = (sector + tap + AZIMUTH_BINS - 1) % AZIMUTH_BINS
                column = values[k, near]
                for i in range(counts[near]):
                    b = filled[near, i]
                    weights = packed[tap, b]
                    first, second, third, fourth = column[0, b], column[1, b], column[2, b], column[3, b]
                    for j in range(len(sums)):
                        sums[j] += (
                            first * weights[0, j]
                            + second * weights[1, j]
                            + third * weights[2, j]
                            + fourth * weights[3, j]
                        )
            for j in range(len(sums)):
                sums[j] = max(sums[j], np.float32(0.0))


@njit(cache=True, nogil=True, fastmath={"contract"})
@no_type_check
def _transform_input(columns, spread):
    two, four, five = np.float32(2.0), np.float32(4.0), np.float32(5.0)
    count = columns.shape[1]
    for tile in range(_TILES):
        for k in range(count):
            before, after = columns[4 * tile - 1, k], columns[(4 * tile + 4) % AZIMUTH_BINS, k]
            a, b = columns[4 * tile, k], columns[4 * tile + 1, k]
            c, d = columns[4 * tile + 2, k], columns[4 * tile + 3, k]
            row = tile * count + k
            for i in range(len(a)):
                even, odd = d[i] - four * b[i], c[i] - four * a[i]
                even_2, odd_2 = d[i] - b[i], two * (c[i] - a[i])
                spread[0, row, i] = four * before[i] - five * b[i] + d[i]
                spread[1, row, i] = even + odd
                spread[2, row, i] = even - odd
                spread[3, row, i] = even_2 + odd_2
                spread[4, row, i] = even_2 - odd_2
                spread[5, row, i] = four * a[i] - five * c[i] + after[i]


@njit(cache=True, nogil=True, fastmath={"contract"})
@no_type_check
def _transform_output(products, bias, outputs):
    zero, two, four, eight = np.float32(0.0), np.float32(2.0), np.float32(4.0), np.float32(8.0)
    count = outputs.shape[1]
    for tile in range(_TILES):
        for k in range(count):
            row = tile * count + k
            for i in range(len(bias)):
                even, odd = products[1, row, i] + products[2, row, i], products[1, row, i] - products[2, row, i]
                even_2, odd_2 = products[3, row, i] + products[4, row, i], products[3, row, i] - products[4, row, i]
                outputs[4 * tile, k, i] = max(products[0, row, i] + even + even_2 + bias[i], zero)
                outputs[4 * tile + 1, k, i] = max(odd + two * odd_2 + bias[i], zero)
                outputs[4 * tile + 2, k, i] = max(even + four * even_2 + bias[i], zero)
                outputs[4 * tile + 3, k, i] = max(odd + eight * odd_2 + products[5, row, i] + bias[i], zero)

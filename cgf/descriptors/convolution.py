"""The circular convolution of the azimuth network, as few matrix products as there can be.

Winograd's minimal filtering F(4, 3) gives four outputs of a filter of three taps by 6 products instead of 12 (Lavin and
Gray, Fast Algorithms for Convolutional Neural Networks, 2016). Its transforms are sums over a few columns, which are
compiled so that they pass through memory once.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

from cgf.descriptors.settings import AZIMUTH_BINS

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

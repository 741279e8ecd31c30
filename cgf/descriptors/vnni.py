"""The azimuth network in 8-bit integers, for processors with instructions that multiply them (VNNI).

Those are Intel's and AMD's of the last years, most of which have no tile registers. An instruction multiplies four
times as many bytes as one of float32 vectors does numbers, and its sums are exact. What is multiplied is rounded:
weights to a 127th of the largest of an output, and of each point the inputs of a layer to a 127th (first layer) or a
255th of the largest. Features differ from those of single precision by 1.5 % of their length on average, 6 % at most.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, no_type_check

import llvmlite.binding as llvm
import numpy as np
from jaxtyping import Float32, Int8, Int64, UInt8
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from cgf.descriptors.byte_rounding import ROWS, SECTOR_ROOM, round_bins, round_rows
from cgf.descriptors.settings import AZIMUTH_BINS, CHANNELS, COLUMN_BINS, INPUT_GAIN
from cgf.geometry.lanes import INT32, INT64, LANES, Lanes, Writer

_GROUP = 4
"""Bytes that an instruction multiplies and adds up, for each of 16 sums."""
_TAPS = 3
"""A sector and its two neighbours."""
_BLOCK = 3 * LANES
"""Outputs looked at together."""
_WIDE_BLOCK = 6 * LANES
"""The same in the first layer, which takes one point at a time."""
_ZERO = 128
"""What stands for a weight of zero in the first layer, whose inputs may be negative: one of the two has no sign."""


@lru_cache(maxsize=1)
def has_bytes() -> bool:
    """Whether this processor multiplies vectors of bytes."""
    return "+avx512vnni" in _features() or "+avxvnni" in _features()


@lru_cache(maxsize=1)
def _features() -> list[str]:
    """Of the processor that Numba compiles for."""
    return str(cpu_target.target_context.codegen().magic_tuple()[2]).split(",")


def _multiply_bytes(builder: Any, sums: Any, unsigned: Any, signed: Any) -> Any:
    """Sums (16 of 32 bits) plus the products of four bytes each, of 16 x 4 without and with a sign."""
    if "+avx512vnni" in _features():
        return _instruction(builder, "vpdpbusd $2, $1, $0", "v", sums, unsigned, signed)
    halves = []
    for half in (range(LANES // 2), range(LANES // 2, LANES)):
        lanes = ir.Constant(ir.VectorType(INT32, LANES // 2), list(half))
        parts = [builder.shuffle_vector(value, value, lanes) for value in (sums, unsigned, signed)]
        halves.append(_instruction(builder, "{vex} vpdpbusd $2, $1, $0", "x", *parts))
    return builder.shuffle_vector(*halves, ir.Constant(ir.VectorType(INT32, LANES), list(range(LANES))))


def _instruction(builder: Any, text: str, register: str, sums: Any, unsigned: Any, signed: Any) -> Any:
    llvm.initialize_native_asmparser()
    kind = sums.type
    assembly = ir.InlineAsm(ir.FunctionType(kind, [kind] * 3), text, f"={register},{register},{register},0")
    return builder.call(assembly, [unsigned, signed, sums])


class _Sums:
    """Sums in registers: the compiler keeps these variables there."""

    def __init__(self, write: Writer, count: int) -> None:
        self._builder, vector = write.builder, ir.VectorType(INT32, LANES)
        self._places = [cgutils.alloca_once(write.builder, vector) for _ in range(count)]  # type: ignore[no-untyped-call]
        for place in self._places:
            write.builder.store(ir.Constant(vector, None), place)

    def add(self, number: int, unsigned: Lanes, signed: Lanes) -> None:
        place = self._places[number]
        sums = _multiply_bytes(self._builder, self._builder.load(place), unsigned.value, signed.value)
        self._builder.store(sums, place)

    def __getitem__(self, number: int) -> Lanes:
        return Lanes(self._builder, self._builder.load(self._places[number]))


def _words(write: Writer, base: Any) -> Any:
    """The same memory, read four bytes at a time."""
    return write.builder.bitcast(base, INT32.as_pointer())


@intrinsic
@no_type_check
def _add_bins(_context, bins, filled, counts, sector, weights, scale, scales, bias, outputs):
    """Write `outputs` (96,) of one sector of one point: scaled sums of weights times filled bins, plus `bias`, or zero.

    `bins` (12 * SECTOR_ROOM,) hold the four bytes of each bin, and `filled` the numbers of those that are not zero,
    as many as `counts` says. `weights` are (3, 187, 96, 4).
    """

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        bins, filled, counts, sector, weights, scale, scales, bias, outputs = write.unpack(signature, args)
        count = _WIDE_BLOCK // LANES
        sums, weights = _Sums(write, count), _words(write, weights)
        for tap in range(_TAPS):
            near = builder.urem(builder.add(sector, INT64(tap + AZIMUTH_BINS - 1)), INT64(AZIMUTH_BINS))
            row = builder.mul(near, INT64(SECTOR_ROOM))
            end = builder.load(builder.gep(counts, [near]))
            with write.steps(INT64(0), end, 1) as (i, _):
                number = builder.zext(builder.load(builder.gep(filled, [builder.add(row, i)])), INT64)
                value = write.load(bins, builder.add(row, number))
                first = builder.mul(builder.add(number, INT64(tap * COLUMN_BINS)), INT64(_WIDE_BLOCK))
                for k in range(count):
                    sums.add(k, write.load_each(weights, builder.add(first, INT64(k * LANES))), value)
        for k in range(count):
            at = INT64(k * LANES)
            values = sums[k].to_floats() * write.repeat(scale) * write.load_each(scales, at)
            _store_rectified(write, values, bias, at, outputs, at)
        return context.get_dummy_value()

    return types.void(bins, filled, counts, sector, weights, scale, scales, bias, outputs), generate


@intrinsic
@no_type_check
def _multiply(_context, columns, sector, weights, row_scales, scales, bias, block, outputs):
    """Write 48 `outputs` (12, 8, W) of one sector, from 48 `block` on, as `_add_bins` does.

    `columns` are (12, 8, W) and `weights` (B, 3, W / 4, 48, 4).
    """

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        width = context.make_array(signature.args[0])(context, builder, args[0]).shape
        width = builder.extract_value(width, 2)
        columns, sector, weights, row_scales, scales, bias, block, outputs = write.unpack(signature, args)
        columns, weights = _words(write, columns), _words(write, weights)
        groups = builder.udiv(width, INT64(_GROUP))
        sector_words = builder.mul(groups, INT64(ROWS))
        vectors = _BLOCK // LANES
        rows_together = ROWS if "+avx512vnni" in _features() else 2
        for first_row in range(0, ROWS, rows_together):
            sums = _Sums(write, rows_together * vectors)
            for tap in range(_TAPS):
                near = builder.urem(builder.add(sector, INT64(tap + AZIMUTH_BINS - 1)), INT64(AZIMUTH_BINS))
                rows = builder.mul(near, sector_words)
                taps = builder.add(builder.mul(block, INT64(_TAPS)), INT64(tap))
                first = builder.mul(builder.mul(taps, groups), INT64(_BLOCK))
                with write.steps(INT64(0), groups, 1) as (group, _):
                    at = builder.add(first, builder.mul(group, INT64(_BLOCK)))
                    factors = [write.load_each(weights, builder.add(at, INT64(k * LANES))) for k in range(vectors)]
                    for row in range(rows_together):
                        offset = builder.mul(groups, INT64(first_row + row))
                        value = write.load(columns, builder.add(builder.add(rows, offset), group))
                        for k, factor in enumerate(factors):
                            sums.add(row * vectors + k, value, factor)
            for row in range(rows_together):
                to = builder.mul(builder.add(builder.mul(sector, INT64(ROWS)), INT64(first_row + row)), width)
                scale = write.load(row_scales, INT64(first_row + row))
                for k in range(vectors):
                    at = builder.add(builder.mul(block, INT64(_BLOCK)), INT64(k * LANES))
                    values = sums[row * vectors + k].to_floats() * scale * write.load_each(scales, at)
                    _store_rectified(write, values, bias, at, outputs, builder.add(to, at))
        return context.get_dummy_value()

    return types.void(columns, sector, weights, row_scales, scales, bias, block, outputs), generate


def _store_rectified(write: Writer, values: Lanes, bias: Any, at: Any, outputs: Any, to: Any) -> None:
    """Store `values` plus their part of the bias, or zero."""
    values = values + write.load_each(bias, at)
    write.store_each(write.call(f"llvm.maxnum.v{LANES}f32", values, write.repeat(0.0)), outputs, to)


@njit(cache=True, nogil=True, fastmath={"contract"})
@no_type_check
def _fill_pooled(histograms, first, second, third, scales, biases, pooled):
    """Largest and mean values over the sectors, side by side, of the third layer, into `pooled` (K, 2 C)."""
    width, channels = scales.shape[1], pooled.shape[1] // 2
    values = np.zeros((AZIMUTH_BINS, ROWS, width), np.float32)
    rounded = np.zeros((AZIMUTH_BINS, ROWS, width), np.uint8)
    bins, filled = np.zeros(AZIMUTH_BINS * SECTOR_ROOM, np.int32), np.empty(AZIMUTH_BINS * SECTOR_ROOM, np.int32)
    counts, sums = np.empty(AZIMUTH_BINS, np.int64), np.empty(AZIMUTH_BINS, np.int32)
    steps, zeros = np.empty(ROWS, np.float32), np.empty(_WIDE_BLOCK, np.float32)
    for start in range(0, len(histograms), ROWS):
        count = min(ROWS, len(histograms) - start)
        for row in range(count):
            step = round_bins(histograms[start + row], bins, filled, counts, sums)
            for sector in range(AZIMUTH_BINS):
                around = sums[sector - 1] + sums[sector] + sums[(sector + 1) % AZIMUTH_BINS]
                for block in range(len(first)):
                    columns = slice(block * _WIDE_BLOCK, (block + 1) * _WIDE_BLOCK)
                    for i in range(_WIDE_BLOCK):
                        own = scales[0, block * _WIDE_BLOCK + i]
                        zeros[i] = biases[0, block * _WIDE_BLOCK + i] - np.float32(_ZERO * around) * step * own
                    outputs = values[sector, row, columns]
                    _add_bins(bins, filled, counts, sector, first[block], step, scales[0, columns], zeros, outputs)
        round_rows(values, rounded, steps)
        for block in range(len(second)):
            for sector in range(AZIMUTH_BINS):
                _multiply(rounded, sector, second, steps, scales[1], biases[1], block, values)
        round_rows(values, rounded, steps)
        for block in range(len(third)):
            for sector in range(AZIMUTH_BINS):
                _multiply(rounded, sector, third, steps, scales[2], biases[2], block, values)
        for row in range(count):
            for i in range(channels):
                largest, total = np.float32(0.0), np.float32(0.0)
                for sector in range(AZIMUTH_BINS):
                    largest = max(largest, values[sector, row, i])
                    total += values[sector, row, i]
                pooled[start + row, i] = largest
                pooled[start + row, channels + i] = total / np.float32(AZIMUTH_BINS)


@dataclass(frozen=True, eq=False)
class ByteNetwork:
    """The convolutions of an azimuth network, for histograms with normals."""

    first: UInt8[np.ndarray, "_ 3 187 96 4"]
    second: Int8[np.ndarray, "_ 3 G 48 4"]
    third: Int8[np.ndarray, "_ 3 G 48 4"]
    scales: Float32[np.ndarray, "3 W"]
    """What a step of each output's weights stands for."""
    biases: Float32[np.ndarray, "3 W"]
    channels: int

    def pooled(self, histograms: Float32[np.ndarray, "K B"]) -> Float32[np.ndarray, "K C2"]:
        """The largest and the mean values over azimuth of the third layer, which the hidden layer takes."""
        pooled = np.empty((len(histograms), 2 * self.channels), np.float32)
        _fill_pooled(histograms, self.first, self.second, self.third, self.scales, self.biases, pooled)
        return pooled


def pack_network(weights: dict[str, Float32[np.ndarray, "..."]]) -> ByteNetwork:
    """Round and pack the three convolutions of an azimuth network whose histograms have normals."""
    channels = [len(weights[f"columns.{i}.bias"]) for i in range(3)]
    width = -(-max(channels) // _WIDE_BLOCK) * _WIDE_BLOCK
    scales, biases = np.zeros((2, 3, width), np.float32)
    rounded = []
    for i, outputs in enumerate(channels):
        weight = weights[f"columns.{i}.weight"]
        steps = np.maximum(np.abs(weight).max(axis=1), 1e-30) / 127
        scales[i, :outputs], biases[i, :outputs] = steps, weights[f"columns.{i}.bias"]
        rounded.append(np.rint(weight / steps[:, None]).astype(np.int64).reshape(outputs, _TAPS, -1))
    scales[0] *= INPUT_GAIN
    return ByteNetwork(
        _pack_bins(rounded[0], width), _pack(rounded[1], width), _pack(rounded[2], width), scales, biases, channels[2]
    )


def _pack_bins(rounded: Int64[np.ndarray, "O 3 I"], width: int) -> UInt8[np.ndarray, "_ 3 187 96 4"]:
    outputs = len(rounded)
    padded = np.zeros((width, _TAPS, CHANNELS, COLUMN_BINS), np.int64)
    padded[:outputs] = rounded.reshape(outputs, _TAPS, CHANNELS, COLUMN_BINS)
    blocks = (padded + _ZERO).reshape(-1, _WIDE_BLOCK, _TAPS, CHANNELS, COLUMN_BINS)
    return _aligned(blocks.transpose(0, 2, 4, 1, 3).astype(np.uint8))


def _pack(rounded: Int64[np.ndarray, "O 3 I"], width: int) -> Int8[np.ndarray, "_ 3 G 48 4"]:
    outputs, _, inputs = rounded.shape
    padded = np.zeros((width, _TAPS, width), np.int8)
    padded[:outputs, :, :inputs] = rounded
    blocks = padded.reshape(-1, _BLOCK, _TAPS, width // _GROUP, _GROUP)
    return _aligned(blocks.transpose(0, 2, 3, 1, 4))


def _aligned(values: np.ndarray) -> np.ndarray:
    """The same in memory that begins with a line of the cache, so that vectors do not lie in two."""
    room = np.empty(values.size + 64, np.uint8)
    start = -room.ctypes.data % 64
    found = room[start : start + values.size].view(values.dtype).reshape(values.shape)
    found[...] = values
    return found

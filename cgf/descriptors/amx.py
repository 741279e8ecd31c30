"""The azimuth network in bfloat16, on the tile registers (AMX) of processors that have them.

A tile instruction multiplies 16 x 32 by 32 x 16 numbers, for which float32 vectors take 16 times as long. No library
that is small enough to depend on offers them to NumPy, so the instructions are written here, as assembly in a compiled
loop. Features differ from those of `cgf.descriptors.convolution` by the rounding of inputs to 8 significant bits.
"""

import ctypes
import os
import platform
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, no_type_check

import llvmlite.binding as llvm
import numpy as np
from jaxtyping import Float32, UInt16
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from cgf.descriptors.settings import AZIMUTH_BINS, COLUMN_BINS, HISTOGRAM_BINS, INPUT_GAIN, HistogramKind
from cgf.descriptors.tile_layout import (
    DEPTH,
    EDGE,
    aligned_room,
    histogram_order,
    histogram_room,
    steps_of,
    to_bfloat16,
)
from cgf.geometry.lanes import INT64, LANES, Lanes, Writer, rounded

_ARCH_PRCTL, _ARCH_REQ_XCOMP_PERM, _XFEATURE_XTILEDATA = 158, 0x1023, 18

_CONFIGURATION = np.zeros(64, np.uint8)
"""Of the eight tiles, as `ldtilecfg` reads it: palette 1, 64 bytes a row, 16 rows."""
_CONFIGURATION[0] = 1
_CONFIGURATION[16:32].view(np.uint16)[:] = 64
_CONFIGURATION[48:56] = 16


@lru_cache(maxsize=1)
def has_tiles() -> bool:
    """Whether this processor multiplies tiles of bfloat16 and the system lets this process do so (Linux 5.16)."""
    features = llvm.get_host_cpu_features()
    if platform.system() != "Linux" or not all(features.get(name, False) for name in ("amx-tile", "amx-bf16")):
        return False
    # The registers are so large that the kernel saves them only for processes that have asked.
    permitted = ctypes.CDLL(None).syscall(_ARCH_PRCTL, _ARCH_REQ_XCOMP_PERM, _XFEATURE_XTILEDATA) == 0
    if permitted:
        llvm.initialize_native_asmparser()
    return permitted


def uses_tiles() -> bool:
    """Whether the network computes in bfloat16: where it can, unless `CGF_PRECISION` is `float32`.

    Raises:
        ValueError: `CGF_PRECISION` is neither empty, `bfloat16` nor `float32`.
    """
    precision = os.environ.get("CGF_PRECISION", "")
    if precision not in ("", "bfloat16", "float32"):
        raise ValueError(f"CGF_PRECISION must be bfloat16 or float32, got {precision}")
    return precision != "float32" and has_tiles()


def pack_weights(weight: Float32[np.ndarray, "O I3"]) -> UInt16[np.ndarray, "B S 1024"]:
    """A layer for the tiles: per `EDGE` outputs, and per step of 32 inputs, two tiles of 16 outputs each.

    Its inputs are three runs of equal length, each padded with zeros to whole steps.
    """
    taps = 3
    outputs, inputs = len(weight), weight.shape[1] // taps
    blocks, steps = -(-outputs // EDGE), steps_of(inputs)
    padded = np.zeros((blocks * EDGE, taps, steps * DEPTH), np.float32)
    padded[:outputs, :, :inputs] = weight.reshape(outputs, taps, inputs)
    # A tile's row holds, for each of 16 outputs, the weights of two inputs that follow each other.
    parts = to_bfloat16(padded).reshape(blocks, 2, 16, taps * steps, 16, 2)
    packed = aligned_room(parts.size).reshape(blocks, taps * steps, 2 * 16 * DEPTH)
    packed[:] = parts.transpose(0, 3, 1, 4, 2, 5).reshape(packed.shape)
    return packed


def _run(label: int, operand: int) -> str:
    """Assembly of one run of steps: two tiles of rows times two tiles of weights, added to the four sums."""
    return f"""
        movq ${operand}, %rax
        movq $4, %rcx
    {label}:
        tileloadd (%rax,%r11,1), %tmm4
        tileloadd (%rdx,%r11,1), %tmm6
        tdpbf16ps %tmm6, %tmm4, %tmm0
        tileloadd 1024(%rdx,%r11,1), %tmm7
        tdpbf16ps %tmm7, %tmm4, %tmm1
        tileloadd 1024(%rax,%r11,1), %tmm5
        tdpbf16ps %tmm6, %tmm5, %tmm2
        tdpbf16ps %tmm7, %tmm5, %tmm3
        addq $$2048, %rax
        addq $$2048, %rdx
        decq %rcx
        jnz {label}b
    """


_PRODUCTS = f"""
    tilezero %tmm0
    tilezero %tmm1
    tilezero %tmm2
    tilezero %tmm3
    movq $$64, %r11
    movq $3, %rdx
    {_run(1, 0)} {_run(2, 1)} {_run(3, 2)}
    movq $5, %rax
    movq $$128, %r11
    tilestored %tmm0, (%rax,%r11,1)
    tilestored %tmm1, 64(%rax,%r11,1)
    tilestored %tmm2, 2048(%rax,%r11,1)
    tilestored %tmm3, 2112(%rax,%r11,1)
"""
"""Operands: three addresses of rows, address of weights, steps of a run, address of sums."""
_CLOBBERED = "~{rax},~{rcx},~{rdx},~{r11},~{memory},~{dirflag},~{fpsr},~{flags}"


def _assembly(builder: Any, text: str, operands: list[Any], constraints: str) -> None:
    signature = ir.FunctionType(ir.VoidType(), [INT64] * len(operands))
    builder.call(ir.InlineAsm(signature, text, constraints, side_effect=True), operands)


@intrinsic
@no_type_check
def _multiply(_context, rows, first, second, third, weights, steps, sums):
    """Write into `sums` (32, 32) the products of 32 rows with 32 columns of weights.

    Rows lie in blocks (32, 32), one for each step. Those of three runs of `steps` begin with number `first`, `second`
    and `third`.
    """

    def generate(context, builder, signature, args):
        def address(place, block=None):
            data = context.make_array(signature.args[place])(context, builder, args[place]).data
            number = INT64(0) if block is None else builder.mul(block, INT64(EDGE * DEPTH))
            return builder.ptrtoint(builder.gep(data, [number]), INT64)

        _assembly(
            builder,
            _PRODUCTS,
            [*(address(0, args[k]) for k in (1, 2, 3)), address(4), args[5], address(6)],
            ",".join(["r"] * 6 + [_CLOBBERED]),
        )
        return context.get_dummy_value()

    return types.void(rows, first, second, third, weights, steps, sums), generate


@intrinsic
@no_type_check
def _configure(_context, configuration):
    def generate(context, builder, signature, args):
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        _assembly(builder, "ldtilecfg ($0)", [builder.ptrtoint(data, INT64)], "r,~{memory}")
        return context.get_dummy_value()

    return types.void(configuration), generate


@intrinsic
@no_type_check
def _release(_context):
    def generate(context, builder, _signature, _args):
        _assembly(builder, "tilerelease", [], "~{memory}")
        return context.get_dummy_value()

    return types.void(), generate


def _rectified(write: Writer, sums: Any, bias: Any, row: Any, column: int, block: Any) -> Lanes:
    """Sums plus their part of the bias, or zero, of 16 outputs of a block."""
    place = write.builder.add(write.builder.mul(row, INT64(EDGE)), INT64(column))
    first = write.builder.add(write.builder.mul(block, INT64(EDGE)), INT64(column))
    values = write.load_each(sums, place) + write.load_each(bias, first)
    return write.call(f"llvm.maxnum.v{LANES}f32", values, write.repeat(0.0))


# As intrinsics, since where they are called the compiler would not turn loops into vector instructions.
@intrinsic
@no_type_check
def _round(_context, values, gain, blocks, row):
    """Write rounded multiples of `values` into a row of `blocks` (steps, 32, 32), as many as fill whole steps."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        count = context.make_array(signature.args[0])(context, builder, args[0]).nitems
        values, gain, blocks, row = write.unpack(signature, args)
        start = builder.mul(row, INT64(DEPTH))
        with write.steps(INT64(0), builder.and_(count, INT64(-DEPTH)), DEPTH) as (i, _):
            to = builder.add(builder.mul(i, INT64(EDGE)), start)
            for half in (INT64(0), INT64(LANES)):
                multiples = write.repeat(gain) * write.load_each(values, builder.add(i, half))
                write.store_rounded(multiples, blocks, builder.add(to, half))
        return context.get_dummy_value()

    return types.void(values, gain, blocks, row), generate


@intrinsic
@no_type_check
def _activate(_context, sums, bias, block, rounded):
    """Rectified sums plus their part of `bias`, rounded."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        sums, bias, block, rounded = write.unpack(signature, args)
        with write.steps(INT64(0), INT64(EDGE), 1) as (row, _):
            for column in (0, LANES):
                to = builder.add(builder.mul(row, INT64(EDGE)), INT64(column))
                write.store_rounded(_rectified(write, sums, bias, row, column, block), rounded, to)
        return context.get_dummy_value()

    return types.void(sums, bias, block, rounded), generate


@intrinsic
@no_type_check
def _activate_and_pool(_context, sums, bias, block, largest, total):
    """Rectified sums plus their part of `bias`, added to what blocks (32, 32) hold of all sectors."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        sums, bias, block, largest, total = write.unpack(signature, args)
        with write.steps(INT64(0), INT64(EDGE), 1) as (row, _):
            for column in (0, LANES):
                values = _rectified(write, sums, bias, row, column, block)
                at = builder.add(builder.mul(row, INT64(EDGE)), INT64(column))
                most = write.call(f"llvm.maxnum.v{LANES}f32", write.load_each(largest, at), values)
                write.store_each(most, largest, at)
                write.store_each(write.load_each(total, at) + values, total, at)
        return context.get_dummy_value()

    return types.void(sums, bias, block, largest, total), generate


@njit(nogil=True)
@no_type_check
def _convolve(columns, weights, sums, sector, block):
    """The sums of `EDGE` outputs of one sector, from itself and its two neighbours."""
    steps = columns.shape[1]
    before, after = (sector + AZIMUTH_BINS - 1) % AZIMUTH_BINS, (sector + 1) % AZIMUTH_BINS
    _multiply(columns, before * steps, sector * steps, after * steps, weights[block], steps, sums)


@njit(cache=True, nogil=True)
@no_type_check
def _put_into_tiles(histograms, order, roots, tiles):
    """Rounded, in the order of the tiles."""
    for k in range(len(histograms)):
        for sector in range(AZIMUTH_BINS):
            values = histograms[k, sector * len(order) : (sector + 1) * len(order)]
            for place in range(len(order)):
                value = values[order[place]]
                number = rounded(np.sqrt(value) if roots else value)
                tiles[k // EDGE, sector, place // DEPTH, k % EDGE, place % DEPTH] = number


@njit(cache=True, nogil=True)
@no_type_check
def _fill_hidden(tiles, first, second, third, last, biases, configuration, hidden):
    size = EDGE * DEPTH
    columns = aligned_room(AZIMUTH_BINS * len(first) * size).reshape(AZIMUTH_BINS, len(first), EDGE, DEPTH)
    others = aligned_room(AZIMUTH_BINS * len(second) * size).reshape(AZIMUTH_BINS, len(second), EDGE, DEPTH)
    largest, total = (np.empty((len(third), EDGE, EDGE), np.float32), np.empty((len(third), EDGE, EDGE), np.float32))
    pooled = aligned_room(len(last[0]) * size).reshape(len(last[0]), EDGE, DEPTH)
    sums = np.empty((EDGE, EDGE), np.float32)
    run = len(last[0]) // 3
    one, mean = np.float32(1.0), np.float32(1.0 / AZIMUTH_BINS)
    _configure(configuration)
    for start in range(0, len(hidden), EDGE):
        count = min(EDGE, len(hidden) - start)
        inputs = tiles[start // EDGE]
        for sector in range(AZIMUTH_BINS):
            for block in range(len(first)):
                _convolve(inputs, first, sums, sector, block)
                _activate(sums, biases[0], block, columns[sector, block])
        for sector in range(AZIMUTH_BINS):
            for block in range(len(second)):
                _convolve(columns, second, sums, sector, block)
                _activate(sums, biases[1], block, others[sector, block])
        largest[:], total[:] = np.float32(0.0), np.float32(0.0)
        for sector in range(AZIMUTH_BINS):
            for block in range(len(third)):
                _convolve(others, third, sums, sector, block)
                _activate_and_pool(sums, biases[2], block, largest[block], total[block])
        for block in range(len(third)):
            for r in range(count):
                _round(largest[block, r], one, pooled[block : block + 1], r)
                _round(total[block, r], mean, pooled[len(third) + block :], r)
        for block in range(len(last)):
            _multiply(pooled, 0, run, 2 * run, last[block], run, sums)
            for r in range(count):
                for j in range(min(EDGE, hidden.shape[1] - block * EDGE)):
                    hidden[start + r, block * EDGE + j] = max(sums[r, j] + biases[3][block * EDGE + j], np.float32(0.0))
    _release()


@dataclass(frozen=True, eq=False)
class TiledNetwork:
    """The weights of an azimuth network up to its hidden layer, packed for the tiles."""

    layers: tuple[UInt16[np.ndarray, "_ _ 1024"], ...]
    biases: tuple[Float32[np.ndarray, "_"], ...]
    """Padded with zeros to whole blocks."""
    width: int
    """Of the hidden layer."""
    histogram: HistogramKind

    def hidden(self, histograms: Float32[np.ndarray, "K B"]) -> Float32[np.ndarray, "K H"]:
        """The hidden layer, given these histograms, or their square roots, times `INPUT_GAIN`."""
        order = histogram_order(histograms.shape[1] // HISTOGRAM_BINS)
        tiles = histogram_room(len(histograms), steps_of(len(order)))
        _put_into_tiles(histograms, order, self.histogram == "roots", tiles)
        return self.hidden_of_tiles(tiles, len(histograms))

    def hidden_of_tiles(
        self, tiles: UInt16[np.ndarray, "N 12 T 32 32"], count: int
    ) -> Float32[np.ndarray, "{count} H"]:
        """The hidden layer of the first `count` histograms in `tiles`, as `HistogramGrid.fill_tiles` writes them."""
        hidden = np.empty((count, self.width), np.float32)
        _fill_hidden(tiles, *self.layers, self.biases, _CONFIGURATION, hidden)
        return hidden


def pack_network(weights: dict[str, Float32[np.ndarray, "..."]], histogram: HistogramKind) -> TiledNetwork:
    """Pack the three convolutions and the hidden layer of an azimuth network."""
    # In the order of the tiles, and times the gain, which changes no digit.
    first = weights["columns.0.weight"] * np.float32(INPUT_GAIN)
    columns = first.reshape(len(first), 3, -1)
    order = histogram_order(columns.shape[2] // COLUMN_BINS)
    layers = [pack_weights(columns[:, :, order].reshape(first.shape))]
    layers += [pack_weights(weights[f"columns.{k}.weight"]) for k in (1, 2)]
    # The maximum and the mean over the sectors, each padded as the sums of the third layer are.
    weight, width = weights["hidden.weight"], len(layers[2]) * EDGE
    both = np.zeros((len(weight), 3 * DEPTH * -(-2 * width // (3 * DEPTH))), np.float32)
    channels = weight.shape[1] // 2
    both[:, :channels], both[:, width : width + channels] = weight[:, :channels], weight[:, channels:]
    layers.append(pack_weights(both))
    biases = [weights[f"{name}.bias"] for name in ("columns.0", "columns.1", "columns.2", "hidden")]
    padded = [np.pad(bias, (0, len(layer) * EDGE - len(bias))) for bias, layer in zip(biases, layers, strict=True)]
    return TiledNetwork(tuple(layers), tuple(padded), len(weight), histogram)

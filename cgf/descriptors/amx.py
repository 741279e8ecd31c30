"""The azimuth network in bfloat16, on the tile registers (AMX) of processors that have them.

A tile instruction multiplies 16 x 32 by 32 x 16 numbers, for which float32 vectors take 16 times as long. No library
that is small enough to depend on offers them to NumPy, so the instructions are written here, as assembly in a compiled
loop. Features differ from those of `cgf.descriptors.convolution` by the rounding of inputs to 8 significant bits.
"""

import ctypes
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
    Tiles,
    aligned_room,
    histogram_order,
    histogram_room,
    steps_of,
    to_bfloat16,
)
from cgf.geometry.lanes import INT64, LANES, Lanes, Writer, rounded

WIDTH = 48
"""Outputs of a block: three tiles of 16."""
_TAPS = 3
"""A sector and its two neighbours."""
_ROWS_BYTES, _WEIGHTS_BYTES = 2 * EDGE * DEPTH, 2 * WIDTH * DEPTH
"""Of a step."""
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


def pack_weights(weight: Float32[np.ndarray, "O I"], *, taps: int = _TAPS) -> UInt16[np.ndarray, "B S 1536"]:
    """A layer for the tiles: per `WIDTH` outputs, and per step of 32 inputs, three tiles of 16 outputs each.

    Its inputs are runs of equal length, as many as `taps`, each padded with zeros to whole steps.
    """
    outputs, inputs = len(weight), weight.shape[1] // taps
    blocks, steps = -(-outputs // WIDTH), steps_of(inputs)
    padded = np.zeros((blocks * WIDTH, taps, steps * DEPTH), np.float32)
    padded[:outputs, :, :inputs] = weight.reshape(outputs, taps, inputs)
    # A tile's row holds, for each of 16 outputs, the weights of two inputs that follow each other.
    parts = to_bfloat16(padded).reshape(blocks, WIDTH // LANES, LANES, taps * steps, DEPTH // 2, 2)
    packed = aligned_room(parts.size).reshape(blocks, taps * steps, WIDTH * DEPTH)
    packed[:] = parts.transpose(0, 3, 1, 4, 2, 5).reshape(packed.shape)
    return packed


_PRODUCTS = """
    tilezero %tmm0
    tilezero %tmm1
    tilezero %tmm2
    tilezero %tmm3
    tilezero %tmm4
    tilezero %tmm5
    movq $$64, %r11
    movq $2, %r10
    movq $3, %rcx
    testq %rcx, %rcx
    jz 2f
1:
    movq (%r10), %rax
    addq $0, %rax
    movq 8(%r10), %rdx
    addq $1, %rdx
    tileloadd (%rdx,%r11,1), %tmm7
    tileloadd (%rax,%r11,1), %tmm6
    tdpbf16ps %tmm7, %tmm6, %tmm0
    tileloadd 1024(%rax,%r11,1), %tmm6
    tdpbf16ps %tmm7, %tmm6, %tmm3
    tileloadd 1024(%rdx,%r11,1), %tmm7
    tdpbf16ps %tmm7, %tmm6, %tmm4
    tileloadd (%rax,%r11,1), %tmm6
    tdpbf16ps %tmm7, %tmm6, %tmm1
    tileloadd 2048(%rdx,%r11,1), %tmm7
    tdpbf16ps %tmm7, %tmm6, %tmm2
    tileloadd 1024(%rax,%r11,1), %tmm6
    tdpbf16ps %tmm7, %tmm6, %tmm5
    addq $$16, %r10
    decq %rcx
    jnz 1b
2:
    movq $4, %rax
    movq $$192, %r11
    tilestored %tmm0, (%rax,%r11,1)
    tilestored %tmm1, 64(%rax,%r11,1)
    tilestored %tmm2, 128(%rax,%r11,1)
    tilestored %tmm3, 3072(%rax,%r11,1)
    tilestored %tmm4, 3136(%rax,%r11,1)
    tilestored %tmm5, 3200(%rax,%r11,1)
"""
"""Operands: addresses of rows, of weights and of pairs of offsets from both, number of pairs, address of sums.

Each pair is a step: two tiles of rows times three tiles of weights, added to six sums. Rows are loaded twice, which the
first cache does meanwhile: of what comes from the second, fewer and larger blocks of sums need less.
"""
_CLOBBERED = "~{rax},~{rcx},~{rdx},~{r10},~{r11},~{memory},~{dirflag},~{fpsr},~{flags}"


def _assembly(builder: Any, text: str, operands: list[Any], constraints: str) -> None:
    signature = ir.FunctionType(ir.VoidType(), [INT64] * len(operands))
    builder.call(ir.InlineAsm(signature, text, constraints, side_effect=True), operands)


@intrinsic
@no_type_check
def _multiply(_context, rows, weights, steps, count, sums):
    """Write into `sums` (32, 48) the products of 32 rows with 48 columns of weights, over `count` of `steps`.

    Each of these (., 2) tells where its block (32, 32) of rows, and its tiles of weights, begin, in bytes.
    """

    def generate(context, builder, signature, args):
        def address(place):
            return builder.ptrtoint(
                context.make_array(signature.args[place])(context, builder, args[place]).data, INT64
            )

        operands = [address(0), address(1), address(2), args[3], address(4)]
        _assembly(builder, _PRODUCTS, operands, ",".join(["r"] * len(operands) + [_CLOBBERED]))
        return context.get_dummy_value()

    return types.void(rows, weights, steps, count, sums), generate


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


def _place(builder: Any, number: Any) -> Any:
    """Where in blocks (steps, 32, 32) a number of the first row stands."""
    step, rest = builder.udiv(number, INT64(DEPTH)), builder.urem(number, INT64(DEPTH))
    return builder.add(builder.mul(step, INT64(EDGE * DEPTH)), rest)


def _rectified(write: Writer, sums: Any, bias: Any, row: Any, column: Any) -> Lanes:
    """Sums plus their part of the bias, or zero, of 16 outputs."""
    place = write.builder.add(write.builder.mul(row, INT64(WIDTH)), column)
    values = write.load_each(sums, place) + write.load_each(bias, column)
    return write.call(f"llvm.maxnum.v{LANES}f32", values, write.repeat(0.0))


# As intrinsics, since where they are called the compiler would not turn loops into vector instructions.
@intrinsic
@no_type_check
def _round(_context, values, gain, begin, blocks):
    """Write rounded multiples of `values` (32, 48) into `blocks` (steps, 32, 32), from number `begin` on."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        values, gain, begin, blocks = write.unpack(signature, args)
        for column in range(0, WIDTH, LANES):
            first = _place(builder, builder.add(begin, INT64(column)))
            with write.steps(INT64(0), INT64(EDGE), 1) as (row, _):
                at = builder.add(builder.mul(row, INT64(WIDTH)), INT64(column))
                to = builder.add(first, builder.mul(row, INT64(DEPTH)))
                write.store_rounded(write.repeat(gain) * write.load_each(values, at), blocks, to)
        return context.get_dummy_value()

    return types.void(values, gain, begin, blocks), generate


@intrinsic
@no_type_check
def _activate(_context, sums, bias, begin, blocks):
    """Write rectified sums plus `bias`, rounded, into `blocks` (steps, 32, 32), from output `begin` on."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        sums, bias, begin, blocks = write.unpack(signature, args)
        for column in range(0, WIDTH, LANES):
            first = _place(builder, builder.add(begin, INT64(column)))
            with write.steps(INT64(0), INT64(EDGE), 1) as (row, _):
                to = builder.add(first, builder.mul(row, INT64(DEPTH)))
                write.store_rounded(_rectified(write, sums, bias, row, INT64(column)), blocks, to)
        return context.get_dummy_value()

    return types.void(sums, bias, begin, blocks), generate


@intrinsic
@no_type_check
def _activate_and_pool(_context, sums, bias, largest, total):
    """Rectified sums plus `bias`, added to what `largest` and `total` (32, 48) hold of all sectors."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        sums, bias, largest, total = write.unpack(signature, args)
        with write.steps(INT64(0), INT64(EDGE), 1) as (row, _):
            for column in range(0, WIDTH, LANES):
                values = _rectified(write, sums, bias, row, INT64(column))
                at = builder.add(builder.mul(row, INT64(WIDTH)), INT64(column))
                most = write.call(f"llvm.maxnum.v{LANES}f32", write.load_each(largest, at), values)
                write.store_each(most, largest, at)
                write.store_each(write.load_each(total, at) + values, total, at)
        return context.get_dummy_value()

    return types.void(sums, bias, largest, total), generate


@njit(nogil=True)
@no_type_check
def _plan(used, stride, steps, counts):
    """The `steps` that the sums of each sector take: those `used` of itself and its two neighbours.

    A sector's rows are `stride` blocks.
    """
    own = used.shape[1]
    for sector in range(AZIMUTH_BINS):
        count = 0
        for tap in range(_TAPS):
            other = (sector + tap + AZIMUTH_BINS - 1) % AZIMUTH_BINS
            for step in range(own):
                if used[other, step]:
                    steps[sector, count, 0] = (other * stride + step) * _ROWS_BYTES
                    steps[sector, count, 1] = (tap * own + step) * _WEIGHTS_BYTES
                    count += 1
        counts[sector] = count


@njit(nogil=True)
@no_type_check
def _room_for(outputs):
    """Blocks (12, steps, 32, 32) for so many numbers of each row."""
    steps = -(-outputs // DEPTH)
    return aligned_room(AZIMUTH_BINS * steps * EDGE * DEPTH).reshape(AZIMUTH_BINS, steps, EDGE, DEPTH)


@njit(nogil=True)
@no_type_check
def _room_for_plan(layer):
    return np.empty((AZIMUTH_BINS, len(layer[0]), 2), np.int64), np.empty(AZIMUTH_BINS, np.int64)


@njit(cache=True, nogil=True)
@no_type_check
def _put_into_tiles(histograms, order, roots, tiles, used):
    """Rounded, in the order of the tiles."""
    for k in range(len(histograms)):
        for sector in range(AZIMUTH_BINS):
            values = histograms[k, sector * len(order) : (sector + 1) * len(order)]
            for place in range(len(order)):
                value = values[order[place]]
                number = rounded(np.sqrt(value) if roots else value)
                tiles[k // EDGE, sector, place // DEPTH, k % EDGE, place % DEPTH] = number
                used[k // EDGE, sector, place // DEPTH] |= number != 0


@njit(cache=True, nogil=True)
@no_type_check
def _fill_hidden(tiles, used, first, second, third, last, biases, configuration, hidden):
    columns, others = _room_for(len(first) * WIDTH), _room_for(len(second) * WIDTH)
    largest = np.empty((len(third), EDGE, WIDTH), np.float32)
    total = np.empty((len(third), EDGE, WIDTH), np.float32)
    pooled = aligned_room(len(last[0]) * EDGE * DEPTH).reshape(len(last[0]), EDGE, DEPTH)
    sums = aligned_room(2 * EDGE * WIDTH).view(np.float32).reshape(EDGE, WIDTH)
    steps, counts = _room_for_plan(first)
    second_steps, second_counts = _room_for_plan(second)
    third_steps, third_counts = _room_for_plan(third)
    _plan(np.ones((AZIMUTH_BINS, len(second[0]) // _TAPS), np.bool_), columns.shape[1], second_steps, second_counts)
    _plan(np.ones((AZIMUTH_BINS, len(third[0]) // _TAPS), np.bool_), others.shape[1], third_steps, third_counts)
    last_steps = np.empty((len(pooled), 2), np.int64)
    for step in range(len(pooled)):
        last_steps[step, 0], last_steps[step, 1] = step * _ROWS_BYTES, step * _WEIGHTS_BYTES
    one, mean = np.float32(1.0), np.float32(1.0 / AZIMUTH_BINS)
    _configure(configuration)
    for start in range(0, len(hidden), EDGE):
        count = min(EDGE, len(hidden) - start)
        inputs = tiles[start // EDGE]
        _plan(used[start // EDGE], inputs.shape[1], steps, counts)
        for sector in range(AZIMUTH_BINS):
            for block in range(len(first)):
                _multiply(inputs, first[block], steps[sector], counts[sector], sums)
                _activate(sums, biases[0][block], block * WIDTH, columns[sector])
        for sector in range(AZIMUTH_BINS):
            for block in range(len(second)):
                _multiply(columns, second[block], second_steps[sector], second_counts[sector], sums)
                _activate(sums, biases[1][block], block * WIDTH, others[sector])
        largest[:], total[:] = np.float32(0.0), np.float32(0.0)
        for sector in range(AZIMUTH_BINS):
            for block in range(len(third)):
                _multiply(others, third[block], third_steps[sector], third_counts[sector], sums)
                _activate_and_pool(sums, biases[2][block], largest[block], total[block])
        for block in range(len(third)):
            _round(largest[block], one, block * WIDTH, pooled)
            _round(total[block], mean, (len(third) + block) * WIDTH, pooled)
        for block in range(len(last)):
            _multiply(pooled, last[block], last_steps, len(last_steps), sums)
            for r in range(count):
                for j in range(min(WIDTH, hidden.shape[1] - block * WIDTH)):
                    hidden[start + r, block * WIDTH + j] = max(sums[r, j] + biases[3][block, j], np.float32(0.0))
    _release()


@dataclass(frozen=True, eq=False)
class TiledNetwork:
    """The weights of an azimuth network up to its hidden layer, packed for the tiles."""

    layers: tuple[UInt16[np.ndarray, "_ _ 1536"], ...]
    biases: tuple[Float32[np.ndarray, "_ 48"], ...]
    """Padded with zeros."""
    width: int
    """Of the hidden layer."""
    histogram: HistogramKind

    def hidden(self, histograms: Float32[np.ndarray, "K B"]) -> Float32[np.ndarray, "K H"]:
        """The hidden layer, given these histograms, or their square roots, times `INPUT_GAIN`."""
        order = histogram_order(histograms.shape[1] // HISTOGRAM_BINS)
        tiles = histogram_room(len(histograms), steps_of(len(order)))
        _put_into_tiles(histograms, order, self.histogram == "roots", *tiles)
        return self.hidden_of_tiles(tiles, len(histograms))

    def hidden_of_tiles(self, tiles: Tiles, count: int) -> Float32[np.ndarray, "{count} H"]:
        """The hidden layer of the first `count` histograms in `tiles`, as `HistogramGrid.fill_tiles` writes them."""
        hidden = np.empty((count, self.width), np.float32)
        _fill_hidden(*tiles, *self.layers, self.biases, _CONFIGURATION, hidden)
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
    weight, width = weights["hidden.weight"], len(layers[2]) * WIDTH
    channels = weight.shape[1] // 2
    both = np.zeros((len(weight), 2 * width), np.float32)
    both[:, :channels], both[:, width : width + channels] = weight[:, :channels], weight[:, channels:]
    layers.append(pack_weights(both, taps=1))
    names = ("columns.0", "columns.1", "columns.2", "hidden")
    biases = [np.zeros((len(layer), WIDTH), np.float32) for layer in layers]
    for name, padded in zip(names, biases, strict=True):
        padded.reshape(-1)[: len(weights[f"{name}.bias"])] = weights[f"{name}.bias"]
    return TiledNetwork(tuple(layers), tuple(biases), len(weight), histogram)

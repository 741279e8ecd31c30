"""Histograms and outputs of a layer, rounded to the bytes that `cgf.descriptors.vnni` multiplies."""

from typing import no_type_check

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from cgf.descriptors.settings import AZIMUTH_BINS, CHANNELS, COLUMN_BINS
from cgf.geometry.lanes import INT32, INT64, LANES, Lanes, Writer

ROWS = 8
"""Points looked at together."""
SECTOR_ROOM = (COLUMN_BINS // LANES + 2) * LANES
"""Numbers kept of a sector's bins: vectors are written whole."""
_LEAST = np.float32(1e-30)
"""Of the largest value: nothing is divided by zero."""


# As intrinsics, since the compiler would not turn these loops into vector instructions.
@intrinsic
@no_type_check
def _largest(_context, values, start, count):
    """The largest absolute value of so many `values` from `start` on, rounded up to whole vectors of 16."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        values, start, count = write.unpack(signature, args)
        found = cgutils.alloca_once(builder, ir.VectorType(ir.FloatType(), LANES))
        builder.store(write.repeat(0.0).value, found)
        with write.steps(start, builder.add(start, count), LANES) as (i, _):
            most = Lanes(builder, builder.load(found))
            most = write.call(f"llvm.maxnum.v{LANES}f32", most, write.absolute(write.load_each(values, i)))
            builder.store(most.value, found)
        kind = ir.FunctionType(ir.FloatType(), [ir.VectorType(ir.FloatType(), LANES)])
        reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fmax.v{LANES}f32")
        return builder.call(reduce, [builder.load(found)])

    return types.float32(values, start, count), generate


@intrinsic
@no_type_check
def _round_sector(_context, values, start, factor, bins, to):
    """Round the four channels (4, 187) of a sector at `values[start]` into `bins[to : to + 187]`; return their sum."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        values, start, factor, bins, to = write.unpack(signature, args)
        factor, byte = write.repeat(factor), write.repeat(255)
        sums = cgutils.alloca_once(builder, ir.VectorType(INT32, LANES))
        builder.store(ir.Constant(ir.VectorType(INT32, LANES), None), sums)

        def round_at(bin_, is_new):
            joined, total = None, Lanes(builder, builder.load(sums))
            for channel in range(CHANNELS):
                at = builder.add(start, builder.add(bin_, INT64(channel * COLUMN_BINS)))
                scaled = write.call(f"llvm.rint.v{LANES}f32", write.load_each(values, at) * factor)
                number = scaled.rounded_down()
                total = total + number.where_true(is_new) if is_new is not None else total + number
                part = (number & byte) << write.repeat(8 * channel)
                joined = part if joined is None else joined | part
            builder.store(total.value, sums)
            write.store_each(joined, bins, builder.add(to, bin_))

        whole = COLUMN_BINS // LANES * LANES
        with write.steps(INT64(0), INT64(whole), LANES) as (bin_, _):
            round_at(bin_, None)
        # The last vector begins among those that are done.
        done = whole - (COLUMN_BINS - LANES)
        is_new = Lanes(
            builder, ir.Constant(ir.VectorType(ir.IntType(1), LANES), [lane >= done for lane in range(LANES)])
        )
        round_at(INT64(COLUMN_BINS - LANES), is_new)
        kind = ir.FunctionType(INT32, [ir.VectorType(INT32, LANES)])
        reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.add.v{LANES}i32")
        return builder.call(reduce, [builder.load(sums)])

    return types.int32(values, start, factor, bins, to), generate


@intrinsic
@no_type_check
def _list_filled(_context, bins, start, filled, to):
    """Write the numbers of those of 187 bins from `start` on that are not zero into `filled[to]` and on; count them."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        bins, start, filled, to = write.unpack(signature, args)
        total = cgutils.alloca_once(builder, INT64)
        builder.store(INT64(0), total)
        step = LANES if write.wide else 1
        with write.steps(INT64(0), INT64(COLUMN_BINS), step) as (i, _):
            count = builder.load(total)
            place, end = builder.add(start, i), builder.add(to, count)
            if write.wide:
                numbers = write.repeat(builder.trunc(i, INT32)) + Lanes(
                    builder, ir.Constant(ir.VectorType(INT32, LANES), list(range(LANES)))
                )
                values = write.load_each(bins, place)
                wanted = Lanes(builder, builder.icmp_signed("!=", values.value, write.repeat(0).value))
                wanted &= write.first_lanes(builder.sub(INT64(COLUMN_BINS), i))
                floats = builder.bitcast(numbers.value, ir.VectorType(ir.FloatType(), LANES))
                together = write.move_together(Lanes(builder, floats), wanted)
                write.store_each(together, builder.bitcast(filled, ir.FloatType().as_pointer()), end)
                taken = write.count_true(wanted)
            else:
                builder.store(builder.trunc(i, INT32), builder.gep(filled, [end]))
                is_filled = builder.icmp_signed("!=", builder.load(builder.gep(bins, [place])), INT32(0))
                taken = builder.zext(is_filled, INT64)
            builder.store(builder.add(count, taken), total)
        return builder.load(total)

    return types.int64(bins, start, filled, to), generate


@intrinsic
@no_type_check
def _round_row(_context, values, start, count, factor, rounded):
    """`rounded[start : start + count]` from `values`, which are not negative; a multiple of 16."""

    def generate(context, builder, signature, args):
        write = Writer(context, builder)
        values, start, count, factor, rounded = write.unpack(signature, args)
        factor = write.repeat(factor)
        with write.steps(start, builder.add(start, count), LANES) as (i, _):
            scaled = write.load_each(values, i) * factor + write.repeat(0.5)
            numbers = scaled.rounded_down()
            small = builder.trunc(numbers.value, ir.VectorType(ir.IntType(8), LANES))
            builder.store(small, builder.bitcast(builder.gep(rounded, [i]), small.type.as_pointer()), align=1)
        return context.get_dummy_value()

    return types.void(values, start, count, factor, rounded), generate


@njit(nogil=True)
@no_type_check
def round_bins(values, bins, filled, counts, sums):
    """Round a histogram (8976,) into `bins`; return the length of a step, and per sector the `sums` of its bytes."""
    largest = _LEAST
    for sector in range(AZIMUTH_BINS):
        # No component of the mean normals is larger than the root that it is multiplied by, the first channel.
        largest = max(largest, _largest(values, sector * CHANNELS * COLUMN_BINS, COLUMN_BINS))
    step = largest / np.float32(127.0)
    for sector in range(AZIMUTH_BINS):
        first = sector * CHANNELS * COLUMN_BINS
        sums[sector] = _round_sector(values, first, np.float32(1.0) / step, bins, sector * SECTOR_ROOM)
        counts[sector] = _list_filled(bins, sector * SECTOR_ROOM, filled, sector * SECTOR_ROOM)
    return step


@njit(nogil=True)
@no_type_check
def round_rows(values, rounded, steps):
    """Round what is not negative, (12, 8, W), a point at a time; `steps` get the length of a step of each."""
    width = values.shape[2]
    for row in range(ROWS):
        largest = _LEAST
        for sector in range(AZIMUTH_BINS):
            largest = max(largest, _largest(values, (sector * ROWS + row) * width, width))
        steps[row] = largest / np.float32(255.0)
        for sector in range(AZIMUTH_BINS):
            _round_row(values, (sector * ROWS + row) * width, width, np.float32(255.0) / largest, rounded)

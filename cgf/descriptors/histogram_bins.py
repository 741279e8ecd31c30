"""The bin of a spherical histogram that each of many neighbours falls into.

No transcendental functions, tables in memory or branches: comparisons with the edges, for 16 neighbours at a time.
"""

from collections.abc import Callable, Sequence
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float32
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from cgf.descriptors.settings import AZIMUTH_BINS, CHANNELS, ELEVATION_BINS, MAX_INSET, RADIAL_BINS, TILT_STEPS
from cgf.descriptors.tile_layout import DEPTH, EDGE
from cgf.geometry.lanes import INT32, INT64, LANES, Lanes, Writer

MAX_EDGES = RADIAL_BINS - 1 + MAX_INSET
"""Edges between shells at most, 31: a look-up within registers has 32 places."""
HALF_SECTORS = 2 * AZIMUTH_BINS
"""Azimuth is told to half a sector. The first begins at -x; they turn from there towards -y."""

_EDGE_COSINES = np.cos(np.arange(1, ELEVATION_BINS // 2 + 1) * np.pi / ELEVATION_BINS).astype(np.float32)
"""Of the elevation edges above the tangent plane; those below are their mirror images."""
_TURNS = np.arange(1, HALF_SECTORS // 4) * np.pi / (HALF_SECTORS // 2)
_TURN_COSINES, _TURN_SINES = np.cos(_TURNS).astype(np.float32), np.sin(_TURNS).astype(np.float32)
"""Of the edges between half sectors in the first quadrant; the others are mirror images."""
_SQ_LEAST = np.float32(1e-15)
"""Nothing as near as this is a neighbour: it is the centre."""
_UNROLLED = 4
_SQ_UPRIGHT = np.float32(1e-30)
"""Added to the squared distance from the axis, so that there is a direction away from it everywhere."""


def padded_edges(sq_edges: Float32[np.ndarray, "E"]) -> Float32[np.ndarray, "P"]:
    """Squared edges as `find_bins` takes them: in ascending order, and infinite from there on."""
    assert len(sq_edges) <= MAX_EDGES, f"{len(sq_edges)} edges between shells"
    return np.append(sq_edges, np.full(MAX_EDGES + 2 * LANES - len(sq_edges), np.inf, np.float32))


@intrinsic
@no_type_check
def find_bins(_context, dx, dy, dz, count, frame, sq_radius, sq_edges, edges, bins):
    """Write the bin of each of `count` offsets, turned into `frame`; of what is no neighbour, one after all others.

    The shell varies fastest, then the elevation, then the half sector. `sq_edges` are the padded squares of so many
    `edges` between shells; a neighbour on one is in the outer shell.
    """

    def generate(context, builder, signature, arguments):
        write = Writer(context, builder)
        *points, count, frame, sq_radius, sq_edges, edges, bins = write.unpack(signature, arguments)
        shells = builder.add(builder.trunc(edges, INT32), INT32(1))
        column = builder.mul(shells, INT32(ELEVATION_BINS))

        def times(size, number):
            return write.repeat(builder.mul(size, INT32(number)))

        with write.steps(INT64(0), count, LANES) as (i, _):
            offsets = [write.load_each(base, i) for base in points]
            sq_distances = write.dot(offsets, offsets)
            distances = write.call(f"llvm.sqrt.v{LANES}f32", sq_distances)
            axes = [[write.load(frame, INT64(3 * row + d)) for d in range(3)] for row in range(3)]
            x, y, z = (write.dot(offsets, axis) for axis in axes)
            zero = write.repeat(0.0)

            found = _find_shells(write, sq_distances, sq_edges, edges)

            height = write.absolute(z)
            steps = _count(write, [height > write.repeat(cosine) * distances for cosine in _EDGE_COSINES], shells)
            middle = times(shells, ELEVATION_BINS // 2)
            found += (z >= zero).where(middle - steps, middle + steps)

            along, across = write.absolute(x), write.absolute(y)
            turns = zip(_TURN_COSINES, _TURN_SINES, strict=True)
            steps = _count(write, [across * write.repeat(c) >= along * write.repeat(s) for c, s in turns], column)
            is_left = y >= zero
            steps = ((x >= zero) ^ is_left).where(times(column, HALF_SECTORS // 2 - 1) - steps, steps)
            found += is_left.where(steps + times(column, HALF_SECTORS // 2), steps)

            is_neighbor = (write.repeat(sq_radius) >= sq_distances) & (sq_distances > write.repeat(_SQ_LEAST))
            write.store_each(is_neighbor.where(found, times(column, HALF_SECTORS)), bins, i)
        return context.get_dummy_value()

    return types.none(dx, dy, dz, count, frame, sq_radius, sq_edges, edges, bins), generate


@intrinsic
@no_type_check
def find_tilts(_context, offsets, normals, count, frame, low, high):
    """Write the components of the normals of `count` neighbours: along z, away from the z axis, and around it.

    Each is counted in steps from 0 for -1 to `2 * TILT_STEPS` for 1. The first stands in the upper half of `low`, above
    a 1, which counts the neighbour; the other two stand in `high`.
    """

    def generate(context, builder, signature, arguments):
        write = Writer(context, builder)
        offsets, normals, count, frame, low, high = write.unpack(signature, arguments)
        with write.steps(INT64(0), count, LANES) as (i, _):
            offset, normal = ([write.load_each(base, i) for base in bases] for bases in (offsets, normals))
            axes = [[write.load(frame, INT64(3 * row + d)) for d in range(3)] for row in range(3)]
            x, y = (write.dot(offset, axis) for axis in axes[:2])
            nx, ny, nz = (write.dot(normal, axis) for axis in axes)
            distance = write.call(f"llvm.sqrt.v{LANES}f32", x * x + y * y + write.repeat(_SQ_UPRIGHT))
            inverse = write.repeat(1.0) / distance
            away, around = (nx * x + ny * y) * inverse, (ny * x - nx * y) * inverse
            along, away, around = (_in_steps(write, component) for component in (nz, away, around))
            half = Lanes(builder, ir.Constant(along.value.type, [32] * LANES))
            write.store_each(write.repeat(1).to_longs() | along << half, low, i)
            write.store_each(away | around << half, high, i)
        return context.get_dummy_value()

    return types.none(offsets, normals, count, frame, low, high), generate


def _store_channels(write: Writer, sums: Any, start: Any, scale: Any, store: Callable[[int, Lanes], None]) -> Any:
    """Store what an oriented histogram holds of the 16 bins whose sums begin at `sums[start]`, channel by channel.

    Gives whether there is anything.
    """
    together = [write.load_each(sums, write.builder.add(start, INT64(LANES * k))) for k in range(CHANNELS)]
    counts = write.every_fourth(together, 0)
    # A surface leaves most of them empty.
    is_filled = write.any_true(counts > write.repeat(0))
    with write.builder.if_else(is_filled) as (some, none):
        with some:
            scale, tiny, step = write.repeat(scale), write.repeat(1e-20), write.repeat(1 / TILT_STEPS)
            count, *tilts = (write.every_fourth(together, channel).to_floats() for channel in range(CHANNELS))
            root = write.call(f"llvm.sqrt.v{LANES}f32", scale * count)
            part = scale / write.call(f"llvm.maxnum.v{LANES}f32", root, tiny)
            for channel, value in enumerate([root, *(part * (step * tilt - count) for tilt in tilts)]):
                store(channel, value)
        with none:
            for channel in range(CHANNELS):
                store(channel, write.repeat(0.0))
    return is_filled


@intrinsic
@no_type_check
def fill_channels(_context, sums, start, scale, row, to, stride):
    """Write what an oriented histogram holds of the 16 bins whose sums begin at `sums[start]`.

    Channels go to `row[to]`, `row[to + stride]` and so on. `scale` makes a bin's count its share of the neighbours.
    """

    def generate(context, builder, signature, arguments):
        write = Writer(context, builder)
        sums, start, scale, row, to, stride = write.unpack(signature, arguments)

        def store(channel, value):
            write.store_each(value, row, builder.add(to, builder.mul(stride, INT64(channel))))

        _store_channels(write, sums, start, scale, store)
        return context.get_dummy_value()

    return types.none(sums, start, scale, row, to, stride), generate


@intrinsic
@no_type_check
def fill_steps(_context, sums, start, scale, tiles, to):
    """As `fill_channels`, rounded to bfloat16, into the row of a block of tiles; two channels take a step.

    Gives whether any of the bins holds anything.
    """

    def generate(context, builder, signature, arguments):
        write = Writer(context, builder)
        sums, start, scale, tiles, to = write.unpack(signature, arguments)

        def store(channel, value):
            step, place = divmod(channel * LANES, DEPTH)
            write.store_rounded(value, tiles, builder.add(to, INT64(step * EDGE * DEPTH + place)))

        return _store_channels(write, sums, start, scale, store)

    return types.boolean(sums, start, scale, tiles, to), generate


def _in_steps(write: Writer, component: Lanes) -> Lanes:
    kept = write.call(f"llvm.minnum.v{LANES}f32", component, write.repeat(1.0))
    kept = write.call(f"llvm.maxnum.v{LANES}f32", kept, write.repeat(-1.0))
    return (kept * write.repeat(float(TILT_STEPS)) + write.repeat(TILT_STEPS + 0.5)).rounded_down().to_longs()


def _find_shells(write: Writer, sq_distances: Lanes, sq_edges: Any, edges: Any) -> Lanes:
    """How many of the edges each distance reaches."""
    shells = write.repeat(0)
    if write.wide:
        # Halving, each lane with edges of its own.
        for step in (16, 8, 4, 2, 1):
            low, high = (write.load_each(sq_edges, INT64(first + step - 1)) for first in (0, LANES))
            is_reached = sq_distances >= write.look_up(low, high, shells)
            shells = is_reached.where(shells + write.repeat(step), shells)
        return shells
    total = cgutils.alloca_once(write.builder, shells.value.type)  # type: ignore[no-untyped-call]
    write.builder.store(shells.value, total)
    with write.steps(INT64(0), edges, _UNROLLED) as (first, _):
        some = [write.load(sq_edges, write.builder.add(first, INT64(k))) for k in range(_UNROLLED)]
        reached = _count(write, [sq_distances >= edge for edge in some], INT32(1))
        write.builder.store((Lanes(write.builder, write.builder.load(total)) + reached).value, total)
    return Lanes(write.builder, write.builder.load(total))


def _count(write: Writer, conditions: Sequence[Lanes], size: Any) -> Lanes:
    """`size` times how many of the conditions hold."""
    total = write.repeat(0)
    if write.wide:
        for condition in conditions:
            total = condition.where(total + write.repeat(size), total)
        return total
    for condition in conditions:
        total += condition.to_ints()
    return total * write.repeat(size)

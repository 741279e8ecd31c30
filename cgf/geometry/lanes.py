"""Loops over 16 points at a time, and how to write their instructions.

From a plain loop Numba would fill only half of each AVX-512 register, and would not find the instructions that look
values up in a register or move some values of a vector together. The compiler fits the vectors below to those of any
processor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
"""Points looked at together. Loops read and write so many values more than they are asked for."""

INT32, INT64 = ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(INT32, LANES)
_LONGS = ir.VectorType(INT64, LANES)


@dataclass(frozen=True)
class Lanes:
    """A value for each of the points, in the code being written, with the operators of an array."""

    builder: Any
    value: Any

    def __add__(self, other: "Lanes") -> "Lanes":
        return self._joined("add", other)

    def __sub__(self, other: "Lanes") -> "Lanes":
        return self._joined("sub", other)

    def __mul__(self, other: "Lanes") -> "Lanes":
        return self._joined("mul", other)

    def __truediv__(self, other: "Lanes") -> "Lanes":
        return Lanes(self.builder, self.builder.fdiv(self.value, other.value))

    def __or__(self, other: "Lanes") -> "Lanes":
        return Lanes(self.builder, self.builder.or_(self.value, other.value))

    def __lshift__(self, other: "Lanes") -> "Lanes":
        return Lanes(self.builder, self.builder.shl(self.value, other.value))

    def __and__(self, other: "Lanes") -> "Lanes":
        return Lanes(self.builder, self.builder.and_(self.value, other.value))

    def __xor__(self, other: "Lanes") -> "Lanes":
        return Lanes(self.builder, self.builder.xor(self.value, other.value))

    def __ge__(self, other: "Lanes") -> "Lanes":
        return self._compared(">=", other)

    def __gt__(self, other: "Lanes") -> "Lanes":
        return self._compared(">", other)

    def where(self, yes: "Lanes", no: "Lanes") -> "Lanes":
        return Lanes(self.builder, self.builder.select(self.value, yes.value, no.value))

    def where_true(self, mask: "Lanes") -> "Lanes":
        """Integers where the mask is true, else 0."""
        return Lanes(self.builder, self.builder.select(mask.value, self.value, ir.Constant(_INTS, None)))

    def to_ints(self) -> "Lanes":
        """1 where true, else 0."""
        return Lanes(self.builder, self.builder.zext(self.value, _INTS))

    def to_longs(self) -> "Lanes":
        return Lanes(self.builder, self.builder.zext(self.value, _LONGS))

    def rounded_down(self) -> "Lanes":
        """Integers, of numbers that are not negative."""
        return Lanes(self.builder, self.builder.fptosi(self.value, _INTS))

    def to_floats(self) -> "Lanes":
        return Lanes(self.builder, self.builder.sitofp(self.value, _FLOATS))

    def _joined(self, name: str, other: "Lanes") -> "Lanes":
        if self.value.type == _FLOATS:
            # A product and a sum may become one instruction.
            return Lanes(self.builder, getattr(self.builder, "f" + name)(self.value, other.value, flags=("contract",)))
        return Lanes(self.builder, getattr(self.builder, name)(self.value, other.value))

    def _compared(self, sign: str, other: "Lanes") -> "Lanes":
        compare = self.builder.fcmp_ordered if self.value.type == _FLOATS else self.builder.icmp_signed
        return Lanes(self.builder, compare(sign, self.value, other.value))


class Writer:
    """Writes the instructions of a loop."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.context, self.builder = context, builder
        self.wide = "+avx512f" in context.codegen().magic_tuple()[2]
        """Whether the processor that is compiled for can look values up in registers, and move some together."""

    def unpack(self, signature: Any, arguments: Any) -> list[Any]:
        """Pointers to the data of arrays, which are contiguous, also of tuples of them; other arguments as they are."""
        return [self._unpacked(kind, value) for kind, value in zip(signature.args, arguments, strict=True)]

    def _unpacked(self, kind: Any, value: Any) -> Any:
        if isinstance(kind, types.UniTuple):
            parts = cgutils.unpack_tuple(self.builder, value)  # type: ignore[no-untyped-call]
            return [self._unpacked(kind.dtype, part) for part in parts]
        if not isinstance(kind, types.Array):
            return value
        assert kind.layout == "C"
        return self.context.make_array(kind)(self.context, self.builder, value).data

    def steps(self, start: Any, end: Any, step: int) -> Any:
        """A loop; entering it gives the index."""
        return cgutils.for_range_slice(self.builder, start, end, INT64(step), INT64)

    def repeat(self, value: Any) -> Lanes:
        """The same value in every lane."""
        if isinstance(value, ir.Value):
            empty = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
            one = self.builder.insert_element(empty, value, INT32(0))
            return Lanes(self.builder, self.builder.shuffle_vector(one, empty, ir.Constant(_INTS, None)))
        constant = [_INTS, [value] * LANES] if isinstance(value, int) else [_FLOATS, [float(value)] * LANES]
        return Lanes(self.builder, ir.Constant(*constant))

    def load(self, base: Any, index: Any) -> Lanes:
        """`base[index]` in every lane."""
        return self.repeat(self.builder.load(self.builder.gep(base, [index])))

    def load_each(self, base: Any, index: Any) -> Lanes:
        """`base[index : index + LANES]`."""
        kind = ir.VectorType(base.type.pointee, LANES)
        return Lanes(self.builder, self.builder.load(self._address(base, index, kind), align=4))

    def store_each(self, lanes: Lanes, base: Any, index: Any) -> None:
        self.builder.store(lanes.value, self._address(base, index, lanes.value.type), align=4)

    def store_rounded(self, lanes: Lanes, base: Any, index: Any) -> None:
        """Store the upper halves of numbers, rounded to the nearest, ties to even: bfloat16."""
        bits = Lanes(self.builder, self.builder.bitcast(lanes.value, _INTS))
        half = self.repeat(16)
        odd = Lanes(self.builder, self.builder.lshr(bits.value, half.value)) & self.repeat(1)
        upper = self.builder.lshr((bits + self.repeat(0x7FFF) + odd).value, half.value)
        shorts = self.builder.trunc(upper, ir.VectorType(ir.IntType(16), LANES))
        self.store_each(Lanes(self.builder, shorts), base, index)

    def call(self, name: str, *arguments: Lanes) -> Lanes:
        """An instruction whose result has the type of its first argument."""
        values = [argument.value for argument in arguments]
        kind = ir.FunctionType(values[0].type, [value.type for value in values])
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)  # type: ignore[no-untyped-call]
        return Lanes(self.builder, self.builder.call(function, values))

    def absolute(self, lanes: Lanes) -> Lanes:
        return self.call(f"llvm.fabs.v{LANES}f32", lanes)

    def dot(self, a: Sequence[Lanes], b: Sequence[Lanes]) -> Lanes:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def first_lanes(self, count: Any) -> Lanes:
        """True in so many of the lanes."""
        return self.repeat(self.builder.trunc(count, INT32)) > Lanes(self.builder, ir.Constant(_INTS, [*range(LANES)]))

    def move_together(self, lanes: Lanes, wanted: Lanes) -> Lanes:
        """The wanted lanes, without gaps between them; only where `wide`."""
        nothing = Lanes(self.builder, ir.Constant(lanes.value.type, None))
        return self.call(f"llvm.x86.avx512.mask.compress.v{LANES}f32", lanes, nothing, wanted)

    def look_up(self, low: Lanes, high: Lanes, indices: Lanes) -> Lanes:
        """Of the 32 numbers in two vectors, those at `indices`; only where `wide`."""
        return self.call("llvm.x86.avx512.vpermi2var.ps.512", low, indices, high)

    def every_fourth(self, together: Sequence[Lanes], first: int) -> Lanes:
        """Of the 64 numbers in four vectors, every fourth from number `first` on."""
        low, high = (
            self.builder.shuffle_vector(
                together[k].value,
                together[k + 1].value,
                ir.Constant(_INTS, [(4 * lane + first) % (2 * LANES) for lane in range(LANES)]),
            )
            for k in (0, 2)
        )
        half = LANES // 2
        both = [*range(half), *range(LANES, LANES + half)]
        return Lanes(self.builder, self.builder.shuffle_vector(low, high, ir.Constant(_INTS, both)))

    def count_true(self, lanes: Lanes) -> Any:
        return self.builder.zext(self.call(f"llvm.ctpop.i{LANES}", self._bits(lanes)).value, INT64)

    def any_true(self, lanes: Lanes) -> Any:
        return self.builder.icmp_unsigned("!=", self._bits(lanes).value, ir.IntType(LANES)(0))

    def _bits(self, lanes: Lanes) -> Lanes:
        return Lanes(self.builder, self.builder.bitcast(lanes.value, ir.IntType(LANES)))

    def _address(self, base: Any, index: Any, kind: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(base, [index]), kind.as_pointer())


@intrinsic
@no_type_check
def gather_offsets(_context, columns, start, end, center, sq_radius, gathered, count):
    """Append the offsets from `center` of points `start` to `end` to the `count` there are; return how many there are.

    Those of points outside the radius are left out where that costs the processor nothing. The first three `columns`
    are x, y and z; others are appended as they are, each to its own array of `gathered`.
    """

    def generate(context, builder, signature, arguments):
        write = Writer(context, builder)
        columns, start, end, center, sq_radius, gathered, count = write.unpack(signature, arguments)
        total = cgutils.alloca_once(builder, INT64)
        builder.store(count, total)
        with write.steps(start, end, LANES) as (i, _):
            values = [write.load_each(base, i) for base in columns]
            values[:3] = [value - write.load(center, INT64(d)) for d, value in enumerate(values[:3])]
            filled, taken = builder.load(total), INT64(LANES)
            if write.wide:
                wanted = write.repeat(sq_radius) >= write.dot(values[:3], values[:3])
                wanted &= write.first_lanes(builder.sub(end, i))
                values = [write.move_together(value, wanted) for value in values]
                taken = write.count_true(wanted)
            for value, base in zip(values, gathered, strict=True):
                write.store_each(value, base, filled)
            builder.store(builder.add(filled, taken), total)
        return builder.load(total) if write.wide else builder.add(count, builder.sub(end, start))

    return types.int64(columns, start, end, center, sq_radius, gathered, count), generate


@intrinsic
@no_type_check
def scale_counts(_context, counts, start, scale, shares, to):
    """`shares[to : to + LANES] = scale * counts[start : start + LANES]`."""

    def generate(context, builder, signature, arguments):
        write = Writer(context, builder)
        counts, start, scale, shares, to = write.unpack(signature, arguments)
        write.store_each(write.load_each(counts, start).to_floats() * write.repeat(scale), shares, to)
        return context.get_dummy_value()

    return types.none(counts, start, scale, shares, to), generate


@intrinsic
@no_type_check
def _bits(_context, value):
    def generate(_context, builder, _signature, args):
        return builder.bitcast(args[0], INT32)

    return types.uint32(value), generate


@njit(inline="always")
@no_type_check
def rounded(value):
    """One number as `Writer.store_rounded` stores many."""
    bits = _bits(value)
    return np.uint16((bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16))

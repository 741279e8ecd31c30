"""Scores of small tiles of feature pairs, and a search that looks at one only if it may hold a nearest neighbour.

A tile's scores stay in registers. The compiler fits the vectors below to those of the processor. From a plain loop
Numba would fill only half of each AVX-512 register, and a library's matrix product sends all scores through memory.
"""

from typing import Any, no_type_check

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

_WIDE = bool(llvm.get_host_cpu_features().get("avx512f", False))
_WIDTH = 16
_VECTORS = 2 if _WIDE else 1
ROWS = 12 if _WIDE else 6
"""Source features of a tile: as many as keep all sums of a tile in registers."""
LANES = _VECTORS * _WIDTH
"""Target features of a tile."""

NEVER = np.float32(-1e30)
"""Score of padding, below that of every feature."""
UNKNOWN = np.float32(-1e29)
"""Bound before anything is known: every feature reaches it, padding does not."""

_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, _WIDTH)
_INT64 = ir.IntType(64)
_MASK = ir.IntType(_WIDTH)


class _Tile:
    """Writes the instructions of `_score_tile`."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder
        signature = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        self.multiply_add = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, signature, f"llvm.fma.v{_WIDTH}f32"
        )

    def address(self, base: Any, index: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(base, [index]), _VECTOR.as_pointer())

    def vectors(self, base: Any, index: Any) -> list[Any]:
        """The target's `LANES` values from `index` on."""
        steps = [self.builder.add(index, _INT64(k * _WIDTH)) for k in range(_VECTORS)]
        return [self.builder.load(self.address(base, step), align=4) for step in steps]

    def repeated(self, base: Any, index: Any) -> Any:
        """One value of the source in every lane."""
        value = self.builder.load(self.builder.gep(base, [index]))
        empty = ir.Constant(_VECTOR, ir.Undefined)
        one = self.builder.insert_element(empty, value, ir.IntType(32)(0))
        return self.builder.shuffle_vector(one, empty, ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), None))

    def largest(self, vectors: list[Any]) -> Any:
        best = vectors[0]
        for other in vectors[1:]:
            best = self.builder.select(self.builder.fcmp_ordered(">", other, best), other, best)
        return best

    def reach(self, values: Any, bounds: Any) -> Any:
        """A bit per lane: whether its value reaches its bound."""
        return self.builder.bitcast(self.builder.fcmp_ordered(">=", values, bounds), _MASK)


@intrinsic
@no_type_check
def _score_tile(_context, source, p, target, q, row_bounds, lane_bounds, scores):
    """Write the scores of a tile; return a bit for each lane, then for each row, in which one reaches the bound.

    The tile is that of panel p of `source` (P, D + 1, ROWS) and panel q of `target` (Q, D + 1, LANES); a score is the
    sum of their products over the first D, plus the last of both. Bounds are those of all panels, one after the other.
    """

    def generate(context, builder, signature, args):
        arrays = [context.make_array(signature.args[k])(context, builder, args[k]) for k in (0, 2, 4, 5, 6)]
        source, target, row_bounds, lane_bounds, scores = [array.data for array in arrays]
        height = builder.extract_value(arrays[0].shape, 1)
        depth = builder.sub(height, _INT64(1))
        # Slices of the arrays would cost the counting of references to them.
        first_row, first_lane = builder.mul(args[1], _INT64(ROWS)), builder.mul(args[3], _INT64(LANES))
        source = builder.gep(source, [builder.mul(first_row, height)])
        target = builder.gep(target, [builder.mul(first_lane, height)])
        row_bounds, lane_bounds = builder.gep(row_bounds, [first_row]), builder.gep(lane_bounds, [first_lane])
        tile = _Tile(builder)
        sums = [[cgutils.alloca_once(builder, _VECTOR) for _ in range(_VECTORS)] for _ in range(ROWS)]
        terms = tile.vectors(target, builder.mul(depth, _INT64(LANES)))
        for r in range(ROWS):
            own = tile.repeated(source, builder.add(builder.mul(depth, _INT64(ROWS)), _INT64(r)))
            for term, total in zip(terms, sums[r], strict=True):
                builder.store(builder.fadd(own, term), total)
        with cgutils.for_range(builder, depth) as loop:
            values = tile.vectors(target, builder.mul(loop.index, _INT64(LANES)))
            for r in range(ROWS):
                own = tile.repeated(source, builder.add(builder.mul(loop.index, _INT64(ROWS)), _INT64(r)))
                for value, total in zip(values, sums[r], strict=True):
                    builder.store(builder.call(tile.multiply_add, [own, value, builder.load(total)]), total)
        rows = [[builder.load(total) for total in row] for row in sums]
        bits = _INT64(0)
        for k, bounds in enumerate(tile.vectors(lane_bounds, _INT64(0))):
            some = tile.reach(tile.largest([row[k] for row in rows]), bounds)
            bits = builder.or_(bits, builder.shl(builder.zext(some, _INT64), _INT64(k * _WIDTH)))
        for r, row in enumerate(rows):
            some = tile.reach(tile.largest(row), tile.repeated(row_bounds, _INT64(r)))
            bit = builder.zext(builder.icmp_unsigned("!=", some, _MASK(0)), _INT64)
            bits = builder.or_(bits, builder.shl(bit, _INT64(LANES + r)))
            for k, value in enumerate(row):
                builder.store(value, tile.address(scores, _INT64(r * LANES + k * _WIDTH)), align=4)
        return bits

    return types.int64(source, p, target, q, row_bounds, lane_bounds, scores), generate


@njit(inline="always")
@no_type_check
def _sq_distance(a, b):
    """In double precision, term by term, so that equal distances come out equal."""
    total = 0.0
    for d in range(len(a)):
        difference = np.float64(a[d]) - np.float64(b[d])
        total += difference * difference
    return total


@njit
@no_type_check
def _is_nearer(points, k, others, rows, candidate, best):
    """Exactly; of equal distances, the lower row is the nearer."""
    sq, sq_best = _sq_distance(points[k], others[candidate]), _sq_distance(points[k], others[best])
    return sq < sq_best or (sq == sq_best and rows[candidate] < rows[best])


@njit(cache=True, nogil=True)
@no_type_check
def sq_distances(a, b, rows_a, rows_b):
    """Squared distances of rows of two arrays, pair by pair."""
    sq = np.empty(len(rows_a))
    for k in range(len(rows_a)):
        sq[k] = _sq_distance(a[rows_a[k]], b[rows_b[k]])
    return sq


@njit(cache=True, nogil=True)
@no_type_check
def search_tiles(source, target, rows, source_panels, target_panels, start, doubt, forward, back, bounds, back_bounds):
    """Search all of the target for a block of the source, and the block for all of the target.

    A bound is the best score so far less `doubt`: a pair below it is farther, a pair above it by more than twice the
    doubt is nearer, and between them exact distances decide.

    Args:
        source: (N, D) features.
        target: (M, D) features.
        rows: Two, (N,) and (M,): of equally near features, that of the lower row counts as nearer.
        source_panels: (P, D + 1, ROWS): of the block, centred, scaled and padded.
        target_panels: (Q, D + 1, LANES): of the target.
        start: Number of the source feature with which the block starts.
        doubt: By how much the scores of two pairs may differ although their distances are in the other order.
        forward: Two of (B,) written: numbers of the target features nearest and second nearest to each of the block's;
            anything where there is none.
        back: Two of (M,) changed: the same of the target, in the source, so far.
        bounds: Two of (P * ROWS,) changed: bounds of `forward`.
        back_bounds: Two of (Q * LANES,) changed: bounds of `back`.
    """
    scores = np.empty((ROWS, LANES), np.float32)
    (first, second), (first_bounds, second_bounds) = forward, bounds
    (back_first, back_second), (back_first_bounds, back_second_bounds) = back, back_bounds
    source_rows, target_rows = rows
    doubts = np.float32(2.0) * doubt
    for q in range(len(target_panels)):
        for p in range(len(source_panels)):
            bits = _score_tile(source_panels, p, target_panels, q, second_bounds, back_second_bounds, scores)
            if bits == 0:
                continue
            # The same twice, since arrays handed to a function here would cost the counting of references to them.
            for r in range(ROWS):
                if not (bits >> (LANES + r)) & 1:
                    continue
                row = p * ROWS + r
                i = start + row
                for lane in range(LANES):
                    score, j, bound = scores[r, lane], q * LANES + lane, second_bounds[row]
                    if score < bound:
                        continue
                    if score <= bound + doubts and not _is_nearer(source, i, target, target_rows, j, second[row]):
                        continue
                    bound = first_bounds[row]
                    if score > bound + doubts or (
                        score >= bound and _is_nearer(source, i, target, target_rows, j, first[row])
                    ):
                        second[row], second_bounds[row] = first[row], bound
                        first[row], first_bounds[row] = j, score - doubt
                    else:
                        second[row], second_bounds[row] = j, score - doubt
            for lane in range(LANES):
                if not (bits >> lane) & 1:
                    continue
                j = q * LANES + lane
                for r in range(ROWS):
                    score, i, bound = scores[r, lane], start + p * ROWS + r, back_second_bounds[j]
                    if score < bound:
                        continue
                    if score <= bound + doubts and not _is_nearer(target, j, source, source_rows, i, back_second[j]):
                        continue
                    bound = back_first_bounds[j]
                    if score > bound + doubts or (
                        score >= bound and _is_nearer(target, j, source, source_rows, i, back_first[j])
                    ):
                        back_second[j], back_second_bounds[j] = back_first[j], bound
                        back_first[j], back_first_bounds[j] = i, score - doubt
                    else:
                        back_second[j], back_second_bounds[j] = i, score - doubt

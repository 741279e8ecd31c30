"""Exact nearest neighbours in both directions, from one pass over all pairs of features."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from cgf.geometry.parallel import for_each_block
from cgf.matching.tiles import LANES, NEVER, ROWS, UNKNOWN, search_tiles, sq_distances
from cgf.types import IsCancelled, Progress, raise_if_cancelled

BLOCK = 40 * 12
"""Source features searched at a time by one thread: 63 kB of 32 dimensions."""
_CHUNK = 1_000_000
"""Values held in double precision at once."""


class Nearest(NamedTuple):
    """What is nearest to each feature of one side."""

    first: Int64[np.ndarray, "N"]
    """Nearest of the other side."""
    sq_first: Float64[np.ndarray, "N"]
    """Squared distance to it."""
    sq_second: Float64[np.ndarray, "N"]
    """Squared distance to the second nearest; infinite where the other side has one only."""

    def in_order(self, rows: Int64[np.ndarray, "N"]) -> "Nearest":
        """The same, of which number k belongs to feature `rows[k]`."""
        back = np.empty_like(rows)
        back[rows] = np.arange(len(rows))
        return Nearest(*(values[back] for values in self))


def search(
    source: Float32[np.ndarray, "N D"],
    target: Float32[np.ndarray, "M D"],
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> tuple[Nearest, Nearest]:
    """Find the two nearest of the other side's features for each feature of both sides; ties go to the lower row.

    The score of source a and target b is -|a - b|^2 / 2, in single precision the product of both less half their
    squared lengths. Where scores differ by less than their rounding errors, distances in double precision decide.
    Scores are not kept: memory beyond the result is a copy of the source, two of the target and, for each thread, four
    values per target.

    Args:
        source: Finite, at least one.
        target: Finite, at least one.
        progress: Told the share done, once a block of the source.
        cancelled: Asked once a block whether to give up.

    Returns:
        For the source, then for the target.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    # In order, features become more and more alike on the way to the nearest, and each would be the nearest so far.
    rows = _shuffled(len(source)), _shuffled(len(target))
    source, target = source[rows[0]], target[rows[1]]
    frame = _Frame.of(source, target)
    panels = frame.panels(target, LANES)
    first, second = np.zeros(len(source), np.int64), np.zeros(len(source), np.int64)
    sq_first, sq_second = np.empty(len(source)), np.full(len(source), np.inf)
    backs: list[_Back] = []
    idle: list[_Back] = []

    def fill(part: slice) -> None:
        raise_if_cancelled(cancelled)
        try:
            back = idle.pop()
        except IndexError:
            back = _Back.of(len(target), len(panels))
            backs.append(back)
        found = first[part], second[part]
        block = frame.panels(source[part], ROWS)
        bounds = np.full(len(block) * ROWS, UNKNOWN), np.full(len(block) * ROWS, UNKNOWN)
        search_tiles(
            source, target, rows, block, panels, part.start, frame.doubt, found, back.nearest, bounds, back.bounds
        )
        idle.append(back)
        own = np.arange(part.start, part.stop)
        sq_first[part] = sq_distances(source, target, own, found[0])
        if len(target) > 1:
            sq_second[part] = sq_distances(source, target, own, found[1])

    def report(done: int) -> None:
        if progress is not None:
            progress(done / len(source), "Matching features")

    for_each_block(fill, len(source), block=BLOCK, finished=report)
    back = _merged(source, target, rows[0], np.concatenate([back.nearest for back in backs]))
    forward = Nearest(rows[1][first], sq_first, sq_second)
    return forward.in_order(rows[0]), back.in_order(rows[1])


@dataclass(frozen=True, eq=False)
class _Frame:
    """Centre and scale that bring all features into the unit ball, where rounding errors have a bound."""

    center: Float64[np.ndarray, "D"]
    scale: float
    doubt: np.float32
    """By how much two scores may differ although the order of the distances is the other one."""

    @classmethod
    def of(cls, source: Float32[np.ndarray, "N D"], target: Float32[np.ndarray, "M D"]) -> "_Frame":
        center = target.mean(axis=0, dtype=np.float64)
        norms = [np.linalg.norm(part - center, axis=1).max() for side in (source, target) for part in _chunks(side)]
        norm = float(max(norms))
        # Both vectors have at most length 1, so partial sums stay below 2 and each of D + 1 additions is off by at most
        # eps; rounded factors and terms add two more, and the comparisons themselves one. Two scores are compared.
        doubt = 2 * (source.shape[1] + 4) * np.finfo(np.float32).eps
        return cls(center, 1 / norm if norm > 0 else 1.0, np.float32(doubt))

    def panels(self, vectors: Float32[np.ndarray, "N D"], width: int) -> Float32[np.ndarray, "P D1 W"]:
        """Features in groups of `width`, transposed, each followed by minus half its squared length.

        Padding in the last group scores lower than every feature.
        """
        count, dim = vectors.shape
        panels = np.zeros((-(-count // width), dim + 1, width), np.float32)
        panels[-1, -1] = NEVER
        done = 0
        for part in _chunks(vectors, multiple=width):
            scaled = (part - self.center) * self.scale
            extended = np.column_stack([scaled, np.square(scaled).sum(axis=1) / -2]).astype(np.float32)
            whole = len(part) // width
            panels[done : done + whole] = extended[: whole * width].reshape(whole, width, dim + 1).transpose(0, 2, 1)
            if whole * width < len(part):
                panels[done + whole, :, : len(part) - whole * width] = extended[whole * width :].T
            done += whole
        return panels


class _Back(NamedTuple):
    """The two nearest sources of each target, of those that one thread has seen."""

    nearest: tuple[Int64[np.ndarray, "M"], Int64[np.ndarray, "M"]]
    """-1 where there is none."""
    bounds: tuple[Float32[np.ndarray, "L"], Float32[np.ndarray, "L"]]

    @classmethod
    def of(cls, count: int, panels: int) -> "_Back":
        bounds = np.full(panels * LANES, UNKNOWN), np.full(panels * LANES, UNKNOWN)
        bounds[1][count:] = np.inf
        return cls((np.full(count, -1), np.full(count, -1)), bounds)


def _merged(
    source: Float32[np.ndarray, "N D"],
    target: Float32[np.ndarray, "M D"],
    rows: Int64[np.ndarray, "N"],
    candidates: Int64[np.ndarray, "C M"],
) -> Nearest:
    """The two nearest of each target, as rows of the source, of those that the threads found."""
    own = np.arange(len(target))
    sq = np.stack([np.where(some < 0, np.inf, sq_distances(target, source, own, some)) for some in candidates])
    found = rows[candidates]
    order = np.lexsort((found, sq), axis=0)
    first, second = order[0], order[1]
    return Nearest(found[first, own], sq[first, own], sq[second, own])


def _shuffled(count: int) -> Int64[np.ndarray, "{count}"]:
    return np.random.default_rng(0).permutation(count)


def _chunks(vectors: Float32[np.ndarray, "N D"], *, multiple: int = 1) -> Iterator[Float32[np.ndarray, "_ D"]]:
    size = max(_CHUNK // max(vectors.shape[1], 1) // multiple, 1) * multiple
    return (vectors[start : start + size] for start in range(0, len(vectors), size))

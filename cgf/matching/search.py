"""Exact nearest neighbours in both directions, from one pass over all pairs of features."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from cgf.geometry.parallel import for_each_block
from cgf.matching.tiles import LANES, NEVER, ROWS, UNKNOWN, search_tiles, sq_distances
from cgf.types import IsCancelled, Progress, raise_if_cancelled

BLOCK = 42 * 12
"""Source features searched at a time by one thread: 66 kB of 32 dimensions."""
_CHUNK = 1_000_000
"""Values held in double precision at once."""


class Nearest(NamedTuple):
    """Both directions of a search."""

    first: Int64[np.ndarray, "N"]
    """Nearest target of each source."""
    sq_first: Float64[np.ndarray, "N"]
    """Squared distance to it."""
    sq_second: Float64[np.ndarray, "N"]
    """Squared distance to the second nearest; infinite where there is one target only."""
    back: Int64[np.ndarray, "M"]
    """Nearest source of each target."""


def search(
    source: Float32[np.ndarray, "N D"],
    target: Float32[np.ndarray, "M D"],
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> Nearest:
    """Find the nearest of the other side's features for each feature; ties go to the lower row.

    The score of source a and target b is -|a - b|^2 / 2, in single precision the product of both less half their
    squared lengths. Where scores differ by less than their rounding errors, distances in double precision decide.
    Scores are not kept: memory beyond the result is one copy of the target and, for each thread, two values per target.

    Args:
        source: Finite, at least one.
        target: Finite, at least one.
        progress: Told the share done, once a block of the source.
        cancelled: Asked once a block whether to give up.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    source, target = np.ascontiguousarray(source), np.ascontiguousarray(target)
    frame = _Frame.of(source, target)
    panels = frame.panels(target, LANES)
    first, second = np.zeros(len(source), np.int64), np.zeros(len(source), np.int64)
    sq_first, sq_second = np.empty(len(source)), np.full(len(source), np.inf)
    backs: list[_Back] = []
    idle: list[_Back] = []

    def fill(rows: slice) -> None:
        raise_if_cancelled(cancelled)
        try:
            back = idle.pop()
        except IndexError:
            back = _Back.of(len(target), len(panels))
            backs.append(back)
        found = first[rows], second[rows]
        block = frame.panels(source[rows], ROWS)
        search_tiles(source, target, block, panels, rows.start, frame.doubt, *found, *back)
        idle.append(back)
        own = np.arange(rows.start, rows.stop)
        sq_first[rows] = sq_distances(source, target, own, found[0])
        if len(target) > 1:
            sq_second[rows] = sq_distances(source, target, own, found[1])

    def report(done: int) -> None:
        if progress is not None:
            progress(done / len(source), "Matching features")

    for_each_block(fill, len(source), block=BLOCK, finished=report)
    return Nearest(first, sq_first, sq_second, _merged(source, target, [back.nearest for back in backs]))


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
    """The nearest source of each target, of those that one thread has seen."""

    nearest: Int64[np.ndarray, "M"]
    bounds: Float32[np.ndarray, "Q L"]

    @classmethod
    def of(cls, count: int, panels: int) -> "_Back":
        bounds = np.full((panels, LANES), UNKNOWN)
        bounds.ravel()[count:] = np.inf
        return cls(np.zeros(count, np.int64), bounds)


def _merged(
    source: Float32[np.ndarray, "N D"], target: Float32[np.ndarray, "M D"], parts: list[Int64[np.ndarray, "M"]]
) -> Int64[np.ndarray, "M"]:
    """The nearest source of each target, of those that the threads found."""
    if len(parts) == 1:
        return parts[0]
    own = np.arange(len(target))
    sq = np.stack([sq_distances(source, target, part, own) for part in parts])
    nearest = np.stack(parts)
    return np.where(sq == sq.min(axis=0), nearest, len(source)).min(axis=0)


def _chunks(vectors: Float32[np.ndarray, "N D"], *, multiple: int = 1) -> Iterator[Float32[np.ndarray, "_ D"]]:
    size = max(_CHUNK // max(vectors.shape[1], 1) // multiple, 1) * multiple
    return (vectors[start : start + size] for start in range(0, len(vectors), size))

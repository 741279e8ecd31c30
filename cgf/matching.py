"""Exact nearest neighbours in feature space, and the two filters people apply to them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from cgf.types import Cancelled, Correspondences, Features, IsCancelled, Progress

TILE_ROWS = 512
TILE_COLUMNS = 2048
ROW_GROUP = 64
"""Source rows whose best score with one target is kept together."""
COLUMN_GROUP = 16
"""Target rows whose best score with one source is kept together."""
EXACT_CHUNK = 1_000_000
"""Values held at once where candidates are measured in float64 (8 MB a temporary)."""
NEVER = np.float32(-1e30)
"""Score of padding: below that of every feature, whose scores are at least -2 after scaling."""

_Candidates = tuple[Int64[np.ndarray, "_"], Int64[np.ndarray, "_"], Float32[np.ndarray, "_"]]
"""Groups of source rows, target rows, and the best scores between them."""


@dataclass(frozen=True, eq=False)
class MatchTable:
    """The nearest target feature of every source feature, before any filter."""

    correspondences: Correspondences
    """One per source feature, in the order of the source's features."""
    mutual: Bool[np.ndarray, "C"]
    """Whether the source feature is also the nearest of its target feature."""

    def __len__(self) -> int:
        return len(self.correspondences)


def match(
    source: Features, target: Features, *, progress: Progress | None = None, cancelled: IsCancelled | None = None
) -> MatchTable:
    """Find the nearest target feature of every source feature, by Euclidean distance.

    The search is exact: a float32 matrix product proposes, with a bound on its own rounding error,
    and every candidate within that bound is measured in float64. Ties go to the lower row. So the
    mutual matches of swapped clouds are the same pairs, transposed.

    Args:
        source: Features of the cloud that will be moved.
        target: Features of the same descriptor and dimension.
        progress: Told the share done, once a block of source features.
        cancelled: Asked once a block whether to give up.

    Returns:
        A row per source feature; no row if either side has none. A ratio is 1 where the two
        nearest are at distance 0, and 0 where there is no second target feature.

    Raises:
        ValueError: The features differ in descriptor or dimension, or have non-finite values.
        Cancelled: `cancelled` returned True.
    """
    _check_comparable(source, target)
    if not len(source) or not len(target):
        return MatchTable(empty_correspondences(), np.zeros(0, dtype=bool))
    search = _Search.over(source.vectors, target.vectors)
    first, sq_first, sq_second, nearest_source = search.run(progress, cancelled)
    indices = np.column_stack([source.indices, target.indices[first]])
    ratios = np.ones(len(source))
    np.divide(np.sqrt(sq_first), np.sqrt(sq_second), out=ratios, where=sq_second > 0)
    correspondences = Correspondences(indices, np.sqrt(sq_first).astype(np.float32), ratios.astype(np.float32))
    return MatchTable(correspondences, nearest_source[first] == np.arange(len(source)))


def filter_rows(table: MatchTable, *, mutual: bool = False, max_ratio: float | None = None) -> Int64[np.ndarray, "R"]:
    """Rows of `table` that pass the filters, ascending.

    Args:
        table: What `match` found.
        mutual: Keep a match only where each of the two is the other's nearest.
        max_ratio: Keep a match only where its distance is at most this share of the distance to
            the second nearest (Lowe's ratio test); in (0, 1], None for no such filter.

    Raises:
        ValueError: `max_ratio` is outside (0, 1].
    """
    if max_ratio is not None and not 0 < max_ratio <= 1:
        raise ValueError(f"max_ratio must be above 0 and at most 1, got {max_ratio:g}")
    keep = table.mutual.copy() if mutual else np.ones(len(table), dtype=bool)
    if max_ratio is not None:
        keep &= table.correspondences.ratios <= np.float32(max_ratio)
    return np.flatnonzero(keep)


def nearest(
    source: Features, target: Features, *, mutual: bool = False, max_ratio: float | None = None
) -> Correspondences:
    """Match and filter in one step; arguments, order and errors as in `match` and `filter_rows`."""
    table = match(source, target)
    return table.correspondences.take(filter_rows(table, mutual=mutual, max_ratio=max_ratio))


def empty_correspondences() -> Correspondences:
    """No correspondence, in the right shapes."""
    return Correspondences(
        np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.float32)
    )


def _check_comparable(source: Features, target: Features) -> None:
    if source.descriptor != target.descriptor:
        raise ValueError(
            f"target must have features of the source's descriptor ({source.descriptor}), got {target.descriptor}"
        )
    if source.dim != target.dim:
        raise ValueError(f"target must have features of the source's dimension ({source.dim}), got {target.dim}")
    for name, features in (("source", source), ("target", target)):
        bad = np.flatnonzero(~np.isfinite(features.vectors).all(axis=1))
        if len(bad):
            raise ValueError(
                f"{name} must have finite features, got {len(bad)} of {len(features)} rows with NaN or inf"
                f" (first at row {bad[0]}); leave them out"
            )


@dataclass(frozen=True, eq=False)
class _Search:
    """Both directions of the search, from one pass over the tiles of the score matrix.

    The score of source a and target b is -|a - b|^2 / 2, which the product of the extended vectors
    [a, 1, -|a|^2 / 2] and [b, -|b|^2 / 2, 1] gives directly. Only the maxima over small groups
    of a tile are kept; a group whose maximum comes within `slack` of the best is a candidate.
    """

    source: Float64[np.ndarray, "N D"]
    target: Float64[np.ndarray, "M D"]
    extended_source: Float32[np.ndarray, "N2 D2"]
    extended_target: Float32[np.ndarray, "M2 D2"]
    tile_columns: int
    slack: float

    @classmethod
    def over(cls, source: Float32[np.ndarray, "N D"], target: Float32[np.ndarray, "M D"]) -> "_Search":
        exact_source, exact_target = source.astype(np.float64), target.astype(np.float64)
        center = exact_target.mean(axis=0)
        norm = max(float(np.linalg.norm(side - center, axis=1).max()) for side in (exact_source, exact_target))
        scale = 1 / norm if norm > 0 else 1.0
        columns = min(TILE_COLUMNS, _round_up(len(target), COLUMN_GROUP))
        # Vectors have at most length 1 here, so |ab| + |a|^2/2 + |b|^2/2 <= 2, and a sum of D + 2 products of rounded
        # factors is off by at most (D + 4) eps times that, in any order; and both scores of a comparison may be off.
        slack = 2 * 2 * (source.shape[1] + 4) * float(np.finfo(np.float32).eps)
        return cls(
            exact_source,
            exact_target,
            _extended((exact_source - center) * scale, _round_up(len(source), ROW_GROUP), one_first=True),
            _extended((exact_target - center) * scale, _round_up(len(target), columns), one_first=False),
            columns,
            slack,
        )

    def run(
        self, progress: Progress | None, cancelled: IsCancelled | None
    ) -> tuple[Int64[np.ndarray, "N"], Float64[np.ndarray, "N"], Float64[np.ndarray, "N"], Int64[np.ndarray, "M"]]:
        """Nearest target of each source, squared distances to the two nearest, nearest source of each target."""
        count = len(self.source)
        first = np.zeros(count, dtype=np.int64)
        sq_first, sq_second = np.full(count, np.inf), np.full(count, np.inf)
        best_of_column = np.full(len(self.extended_target), -np.inf, dtype=np.float32)
        candidates: list[_Candidates] = []
        for start in range(0, count, TILE_ROWS):
            if cancelled is not None and cancelled():
                raise Cancelled
            rows = slice(start, min(start + TILE_ROWS, count))
            block_best = self._score_block(start, best_of_column, candidates)
            first[rows], sq_first[rows], sq_second[rows] = self._two_nearest(
                start, block_best[: rows.stop - rows.start]
            )
            if progress is not None:
                progress(rows.stop / count, "Matching features")
        return first, sq_first, sq_second, self._nearest_source(best_of_column, candidates)

    def _score_block(
        self,
        start: int,
        best_of_column: Float32[np.ndarray, "M2"],
        candidates: list[_Candidates],
    ) -> Float32[np.ndarray, "B G"]:
        """Best score of each row with each group of columns; collects candidates of the other direction."""
        block = self.extended_source[start : start + TILE_ROWS]
        scores = np.empty((len(block), self.tile_columns), dtype=np.float32)
        tiles = []
        for left in range(0, len(self.extended_target), self.tile_columns):
            columns = slice(left, left + self.tile_columns)
            np.matmul(block, self.extended_target[columns].T, out=scores)
            # Columns a stride apart form a group, so that the maximum runs over whole slices of memory.
            tiles.append(scores.reshape(len(block), COLUMN_GROUP, -1).max(axis=1))
            best = scores.reshape(-1, ROW_GROUP, self.tile_columns).max(axis=1)
            np.maximum(best_of_column[columns], best.max(axis=0), out=best_of_column[columns])
            group, column = np.nonzero(best >= best_of_column[columns] - np.float32(self.slack))
            candidates.append((group + start // ROW_GROUP, column + left, best[group, column]))
        return np.concatenate(tiles, axis=1)

    def _two_nearest(
        self, start: int, block_best: Float32[np.ndarray, "B G"]
    ) -> tuple[Int64[np.ndarray, "B"], Float64[np.ndarray, "B"], Float64[np.ndarray, "B"]]:
        # Two groups reach the second largest maximum, so the two nearest score at least that; a group below is out.
        # With one group only, nothing is out.
        if block_best.shape[1] > 1:
            second = -np.partition(-block_best, 1, axis=1)[:, 1]
            row, group = np.nonzero(block_best >= (second - np.float32(self.slack))[:, None])
        else:
            row, group = np.nonzero(block_best > NEVER)
        stride = self.tile_columns // COLUMN_GROUP
        tile, offset = np.divmod(group, stride)
        members = (tile * self.tile_columns + offset)[:, None] + stride * np.arange(COLUMN_GROUP)
        row, column = np.repeat(row, COLUMN_GROUP), members.ravel()
        inside = column < len(self.target)
        row, column = row[inside], column[inside]
        sq = self._sq_distances(row + start, column)
        order = np.lexsort((column, sq, row))
        row, column, sq = row[order], column[order], sq[order]
        begin = np.flatnonzero(np.diff(row, prepend=-1))
        after = np.append(begin[1:], len(row))
        sq_second = np.full(len(begin), np.inf)
        has_second = after - begin > 1
        sq_second[has_second] = sq[begin[has_second] + 1]
        return column[begin], sq[begin], sq_second

    def _nearest_source(
        self,
        best_of_column: Float32[np.ndarray, "M2"],
        candidates: list[_Candidates],
    ) -> Int64[np.ndarray, "M"]:
        group = np.concatenate([item[0] for item in candidates])
        column = np.concatenate([item[1] for item in candidates])
        score = np.concatenate([item[2] for item in candidates])
        keep = (score >= best_of_column[column] - np.float32(self.slack)) & (column < len(self.target))
        group, column = group[keep], column[keep]
        # By group, so that a second product finds the few rows of it that matter.
        order = np.argsort(group, kind="stable")
        group, column = group[order], column[order]
        bounds = np.append(np.flatnonzero(np.diff(group, prepend=-1)), len(group))
        rows, columns = [], []
        for begin, end in pairwise(bounds.tolist()):
            top, some = int(group[begin]) * ROW_GROUP, column[begin:end]
            scores = self.extended_source[top : top + ROW_GROUP] @ self.extended_target[some].T
            row, which = np.nonzero(scores >= best_of_column[some] - np.float32(self.slack))
            rows.append(row + top)
            columns.append(some[which])
        row, column = np.concatenate(rows), np.concatenate(columns)
        sq = self._sq_distances(row, column)
        order = np.lexsort((row, sq, column))
        # Every target row is there, so the first entry of each is its nearest source.
        return row[order[np.flatnonzero(np.diff(column[order], prepend=-1))]]

    def _sq_distances(self, rows: Int64[np.ndarray, "K"], columns: Int64[np.ndarray, "K"]) -> Float64[np.ndarray, "K"]:
        sq = np.empty(len(rows))
        for part in _chunks(len(rows), EXACT_CHUNK // self.source.shape[1]):
            difference = self.source[rows[part]] - self.target[columns[part]]
            # A plain sum, not einsum: the same order of additions for every row, so that ties are exact.
            sq[part] = np.square(difference, out=difference).sum(axis=1)
        return sq


def _extended(vectors: Float64[np.ndarray, "N D"], rows: int, *, one_first: bool) -> Float32[np.ndarray, "N2 D2"]:
    """Append 1 and -|v|^2 / 2 in either order, and padding rows that score lowest with everything."""
    half_sq = -np.square(vectors).sum(axis=1) / 2
    extended = np.zeros((rows, vectors.shape[1] + 2), dtype=np.float32)
    extended[: len(vectors), :-2] = vectors
    one, norm = (-2, -1) if one_first else (-1, -2)
    extended[:, one] = 1
    extended[: len(vectors), norm] = half_sq
    extended[len(vectors) :, norm] = NEVER
    return extended


def _chunks(count: int, size: int) -> Iterator[slice]:
    size = max(size, 1)
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _round_up(count: int, step: int) -> int:
    return -(-count // step) * step

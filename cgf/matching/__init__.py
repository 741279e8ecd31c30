"""Exact nearest neighbours in feature space, and the filters people apply to them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Int64

from cgf.matching.ranking import surest_rows, trust
from cgf.types import Correspondences, Features, IsCancelled, Progress

if TYPE_CHECKING:
    from cgf.matching.search import Nearest


@dataclass(frozen=True, eq=False)
class MatchTable:
    """The nearest target feature of every source feature, before any filter."""

    correspondences: Correspondences
    """One per source feature, in the order of the source's features."""
    mutual: Bool[np.ndarray, "C"]
    """Whether the source feature is also the nearest of its target feature."""
    source_quality: Float32[np.ndarray, "C"] | None = None
    """`Features.quality` of the source features; None where the descriptor does not say."""
    target_quality: Float32[np.ndarray, "C"] | None = None
    """The same of the target features."""

    @property
    def quality(self) -> Float32[np.ndarray, "C"] | None:
        """The product of the qualities of both features of each match; None where the descriptor does not say."""
        if self.source_quality is None or self.target_quality is None:
            return None
        return self.source_quality * self.target_quality

    @property
    def trust(self) -> Float32[np.ndarray, "C"]:
        """The larger, the surer a match: by its distance, and by the qualities of its features where they are known."""
        quality = self.quality
        return trust(self.correspondences, "distance" if quality is None else "combined", quality=quality)

    def __len__(self) -> int:
        return len(self.correspondences)


def match(
    source: Features, target: Features, *, progress: Progress | None = None, cancelled: IsCancelled | None = None
) -> MatchTable:
    """Find the nearest target feature of every source feature, by Euclidean distance.

    The search is exact: single precision decides only where its rounding error cannot matter, double precision
    elsewhere. Ties go to the lower row. So the mutual matches of swapped clouds are the same pairs, transposed.

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
    return match_both(source, target, progress=progress, cancelled=cancelled)[0]


def match_both(
    source: Features, target: Features, *, progress: Progress | None = None, cancelled: IsCancelled | None = None
) -> tuple[MatchTable, MatchTable]:
    """As `match`, from the source to the target, and from the target to the source, in the time of one of the two."""
    _check_comparable(source, target)
    if not len(source) or not len(target):
        return _no_matches(), _no_matches()
    # Numba is imported on first use, so that commands start quickly.
    from cgf.matching.search import search

    forward, back = search(source.vectors, target.vectors, progress=progress, cancelled=cancelled)
    return _table(source, target, forward, back.first), _table(target, source, back, forward.first)


def _table(source: Features, target: Features, found: "Nearest", back: Int64[np.ndarray, "M"]) -> MatchTable:
    """The matches of `source`; `back` is the nearest of it to each of the target's features."""
    indices = np.column_stack([source.indices, target.indices[found.first]])
    distances, second = np.sqrt(found.sq_first), np.sqrt(found.sq_second)
    ratios = np.ones(len(source))
    np.divide(distances, second, out=ratios, where=second > 0)
    return MatchTable(
        Correspondences(indices, distances.astype(np.float32), ratios.astype(np.float32)),
        back[found.first] == np.arange(len(source)),
        source.quality,
        None if target.quality is None else target.quality[found.first],
    )


def _no_matches() -> MatchTable:
    return MatchTable(empty_correspondences(), np.zeros(0, dtype=bool))


def filter_rows(
    table: MatchTable, *, mutual: bool = False, max_ratio: float | None = None, surest: float | None = None
) -> Int64[np.ndarray, "R"]:
    """Rows of `table` that pass the filters, ascending.

    Args:
        table: What `match` found.
        mutual: Keep a match only where each of the two is the other's nearest.
        max_ratio: Keep a match only where its distance is at most this share of the distance to
            the second nearest (Lowe's ratio test); in (0, 1], None for no such filter.
        surest: Keep this share of all matches, those with the largest `trust`; in (0, 1], None for no such filter.

    Raises:
        ValueError: `max_ratio` or `surest` is outside (0, 1].
    """
    if max_ratio is not None and not 0 < max_ratio <= 1:
        raise ValueError(f"max_ratio must be above 0 and at most 1, got {max_ratio:g}")
    keep = table.mutual.copy() if mutual else np.ones(len(table), dtype=bool)
    if max_ratio is not None:
        keep &= table.correspondences.ratios <= np.float32(max_ratio)
    if surest is not None:
        among = np.zeros(len(table), dtype=bool)
        among[surest_rows(table.trust, share=surest)] = True
        keep &= among
    return np.flatnonzero(keep)


def nearest(
    source: Features,
    target: Features,
    *,
    mutual: bool = False,
    max_ratio: float | None = None,
    surest: float | None = None,
) -> Correspondences:
    """Match and filter in one step; arguments, order and errors as in `match` and `filter_rows`."""
    table = match(source, target)
    return table.correspondences.take(filter_rows(table, mutual=mutual, max_ratio=max_ratio, surest=surest))


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

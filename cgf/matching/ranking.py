"""How far to trust each match, for putting the surest first."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, Int64

from cgf.types import Correspondences, Features

Ranking = Literal["distance", "ratio", "quality", "combined"]
RANKINGS: tuple[Ranking, ...] = get_args(Ranking)
"""By distance in feature space; by the ratio to the second nearest (Lowe); by the qualities of both features; by the
product of both qualities and one minus the ratio."""


def match_quality(
    source: Features, target: Features, correspondences: Correspondences
) -> Float32[np.ndarray, "C"] | None:
    """The product of the qualities of the two features of each match; None where the features have none.

    Args:
        source: Features matched.
        target: Those matched with.
        correspondences: Between them.
    """
    if source.quality is None or target.quality is None:
        return None
    indices = correspondences.indices
    of_source = source.quality[_places(source.indices, indices[:, 0])]
    return of_source * target.quality[_places(target.indices, indices[:, 1])]


def trust(
    correspondences: Correspondences, by: Ranking, *, quality: Float32[np.ndarray, "C"] | None = None
) -> Float32[np.ndarray, "C"]:
    """A value for each match that is the larger, the surer it is; only their order means something.

    Args:
        correspondences: As `match` found them.
        by: What to go by.
        quality: What `match_quality` gives.

    Raises:
        ValueError: `by` needs the quality, and there is none.
    """
    if by == "distance":
        return -correspondences.distances
    if by == "ratio":
        return -correspondences.ratios
    if quality is None:
        raise ValueError(f"by must be distance or ratio where features have no quality, got {by}")
    return quality if by == "quality" else quality * (np.float32(1.0) - correspondences.ratios)


def surest_rows(trusted: Float32[np.ndarray, "C"], *, share: float) -> Int64[np.ndarray, "R"]:
    """Rows of the surest matches, surest first; ties in the order of the rows.

    Args:
        trusted: What `trust` gives.
        share: How many of all, in (0, 1]; at least one match is kept where there are any.

    Raises:
        ValueError: `share` is outside (0, 1].
    """
    if not 0 < share <= 1:
        raise ValueError(f"share must be above 0 and at most 1, got {share:g}")
    count = max(round(share * len(trusted)), min(len(trusted), 1))
    return np.argsort(-trusted, kind="stable")[:count]


def _places(indices: Int64[np.ndarray, "K"], rows: Int64[np.ndarray, "C"]) -> Int64[np.ndarray, "C"]:
    """Where each of `rows` stands in `indices`."""
    order = np.argsort(indices, kind="stable")
    return order[np.searchsorted(indices, rows, sorter=order)]

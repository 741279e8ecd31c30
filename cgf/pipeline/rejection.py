"""Where each point of a cloud drops out on the way from points to right matches."""

from typing import Literal, get_args
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Int8, Int64

from cgf.matching import MatchTable, filter_rows
from cgf.pipeline.inspection import frames, uses_frames
from cgf.pipeline.settings import ResolvedSettings
from cgf.types import Features, PointCloud

Rejection = Literal["no_frame", "no_feature", "no_partner", "not_mutual", "above_ratio", "unsure", "outlier", "none"]
REJECTIONS: tuple[Rejection, ...] = get_args(Rejection)
"""In the order of the stages; `none` passes them all. Their places are the codes of `rejections`."""


def rejections(
    cloud: PointCloud,
    features: Features,
    table: MatchTable,
    settings: ResolvedSettings,
    *,
    has_partner: Bool[np.ndarray, "N"] | None = None,
    is_inlier: Bool[np.ndarray, "C"] | None = None,
    mutual: bool = False,
    max_ratio: float | None = None,
    surest: float | None = None,
) -> Int8[np.ndarray, "N"]:
    """The first stage that rejects each point of a prepared cloud, or its match.

    Args:
        cloud: Its rows are those of the result.
        features: Of `cloud`.
        table: The match of each feature, unfiltered, in the order of `features`.
        settings: What `features` were computed with.
        has_partner: Which points of `cloud` the other cloud comes near to under the true pose; None where no pose is
            known, and then no point is rejected for that.
        is_inlier: Which rows of `table` agree with the pose that an estimator found; None without one.
        mutual: Whether matches had to be mutual.
        max_ratio: Largest ratio accepted, None for any.
        surest: Share of the matches that were kept, the surest; None for all.

    Returns:
        Indices into `REJECTIONS`.
    """
    code = {name: np.int8(place) for place, name in enumerate(REJECTIONS)}
    result = np.full(len(cloud), code["no_feature"], dtype=np.int8)
    result[_without_frame(cloud, features, settings)] = code["no_frame"]
    stages = np.full(len(table), code["none"], dtype=np.int8)
    if is_inlier is not None:
        stages[~is_inlier] = code["outlier"]
    # From the last stage to the first, so that the first that rejects is the one that stays.
    stages[_failing(table, filter_rows(table, surest=surest))] = code["unsure"]
    stages[_failing(table, filter_rows(table, max_ratio=max_ratio))] = code["above_ratio"]
    stages[_failing(table, filter_rows(table, mutual=mutual))] = code["not_mutual"]
    rows = table.correspondences.indices[:, 0]
    if has_partner is not None:
        stages[~has_partner[rows]] = code["no_partner"]
    result[rows] = stages
    return result


_WITHOUT_FRAME: WeakKeyDictionary[Features, Int64[np.ndarray, "_"]] = WeakKeyDictionary()
"""Filters change often, features seldom."""


def _without_frame(cloud: PointCloud, features: Features, settings: ResolvedSettings) -> Int64[np.ndarray, "_"]:
    """Rows of `cloud` that are not described for want of neighbours for a local reference frame."""
    if not uses_frames(settings):
        return np.zeros(0, dtype=np.int64)
    if features not in _WITHOUT_FRAME:
        missing = np.setdiff1d(np.arange(len(cloud)), features.indices)
        _WITHOUT_FRAME[features] = missing[~frames(cloud, missing, settings).any(axis=(1, 2))]
    return _WITHOUT_FRAME[features]


def _failing(table: MatchTable, passing: Int64[np.ndarray, "R"]) -> Bool[np.ndarray, "C"]:
    failing = np.ones(len(table), dtype=np.bool_)
    failing[passing] = False
    return failing

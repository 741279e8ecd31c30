"""What a diagnosis is made of: two clouds and all that was computed for them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from cgf import pipeline
from cgf.matching import MatchTable
from cgf.pipeline import PairResult, PairSettings, ResolvedSettings
from cgf.types import Features, Pair, PointCloud

MOST_ASKED = 1_000
"""Matches that are asked for a pose at most; the most distinctive mutual ones."""


@dataclass(frozen=True, eq=False)
class Case:
    """A pair after matching, and after registration where that was done."""

    wanted: PairSettings
    settings: ResolvedSettings
    loaded_source: PointCloud
    """As loaded and corrected."""
    loaded_target: PointCloud
    source: PointCloud
    """Prepared."""
    target: PointCloud
    source_features: Features
    """Of `settings.dim` dimensions, like the target's."""
    target_features: Features
    table: MatchTable
    rows: Int64[np.ndarray, "R"]
    """Rows of `table` that passed the filters, which the estimator was given."""
    truth: Float64[np.ndarray, "4 4"] | None = None
    """`target_from_source`, where it is known."""
    estimate: Float64[np.ndarray, "4 4"] | None = None
    """What an estimator found; None where it found nothing, or none was asked."""

    @classmethod
    def of_result(cls, pair: Pair, wanted: PairSettings, result: PairResult) -> "Case":
        """The case of what `cgf.run_pair` computed for `pair` with the settings `wanted`."""
        source, target = pipeline.correct(wanted, pair.source, pair.target)
        return cls(
            wanted=wanted,
            settings=result.settings,
            loaded_source=source,
            loaded_target=target,
            source=result.source,
            target=result.target,
            source_features=result.source_features,
            target_features=result.target_features,
            table=result.table,
            rows=result.rows,
            truth=pair.target_from_source,
            estimate=None if result.registration is None else result.registration.target_from_source,
        )

    def asked(self) -> Int64[np.ndarray, "C"]:
        """Rows of `table` that are asked for a pose: mutual, the most distinctive first, whatever the filters."""
        mutual = np.flatnonzero(self.table.mutual)
        order = np.argsort(self.table.correspondences.ratios[mutual], kind="stable")
        return mutual[order[:MOST_ASKED]]

    def ends(self, rows: Int64[np.ndarray, "C"]) -> tuple[Float64[np.ndarray, "C 3"], Float64[np.ndarray, "C 3"]]:
        """Source and target points of rows of `table`."""
        indices = self.table.correspondences.indices[rows]
        return self.source.points[indices[:, 0]], self.target.points[indices[:, 1]]

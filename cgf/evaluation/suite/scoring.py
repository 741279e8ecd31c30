"""What is measured of one pair: how near matches come to the truth, for every width of a descriptor."""

import zlib
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from cgf import descriptors, pipeline
from cgf.descriptors.settings import MODEL_DEFAULTS, ModelName
from cgf.evaluation import metrics
from cgf.evaluation.suite.perturbation import Perturbation, perturb
from cgf.evaluation.suite.rows import Row, measured_dims
from cgf.evaluation.suite.sets import PairGroup
from cgf.geometry.neighbors import build_tree
from cgf.geometry.transforms import apply
from cgf.io import PairFiles, read_cloud
from cgf.matching import match
from cgf.matching.ranking import RANKINGS, surest_rows, trust
from cgf.pipeline import ResolvedSettings
from cgf.types import Features, IsCancelled, PointCloud

SAMPLE = 5_000
"""Points of a cloud drawn at random, as in the protocol of the 3DMatch benchmark."""
THRESHOLDS: dict[ModelName, tuple[float, ...]] = {
    "object": (0.0025, 0.005, 0.0075, 0.01, 0.0125, 0.015, 0.02, 0.025, 0.03),
    "indoor": (0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.2, 0.25),
}
"""Of the precision curves: shares of the diameter, metres."""
COVERAGES = (0.1, 0.5)
"""Shares of the matches that are kept, the surest first."""
PairScores = dict[str, Any]
"""What is kept of a pair, as JSON holds it."""


class Scorer:
    """Scores pairs that share clouds, each of which is read, prepared and described once."""

    def __init__(self, *, cancelled: IsCancelled | None = None) -> None:
        self._cancelled = cancelled
        self._raw: dict[Path, PointCloud] = {}
        self._clouds: dict[tuple[object, ...], PointCloud] = {}
        self._features: dict[tuple[object, ...], Features] = {}
        self.described = 0
        """Points described so far."""
        self.describe_s = 0.0
        """Seconds of the processor that it took."""

    def forget_features(self) -> None:
        """Before what shares no features with what came before: another row, or pairs of other lengths."""
        self._features.clear()

    def score(self, pair: PairFiles, group: PairGroup, row: Row) -> PairScores:
        """Measure one pair.

        Precision is that of the matches of 5,000 points of the source to all of the target; the inlier ratio that of
        their matches to 5,000 points of the target.

        Returns:
            `pair`, its name; and for each width under `dims`: `curve`, the precision within `THRESHOLDS` among points
            with a partner within tau; `near`, the same among points with a partner within each threshold; `sure`, for
            each ranking the share of right matches among the surest `COVERAGES` of all; `inlier_ratio`.
        """
        pose, change = pair.target_from_source, group.perturbation
        assert pose is not None
        raw = self._read(pair.source, pair), self._read(pair.target, pair)
        sized = raw
        if group.has_one_scale:
            clouds = (self._read(path, any_) for any_ in group.pairs for path in (any_.source, any_.target))
            sized = (max(clouds, key=lambda cloud: cloud.diameter),) * 2
        settings = _settings(row, *sized, change)
        source = self._prepared(pair.source, settings, change)
        target = self._prepared(pair.target, settings, None)
        rows = sample_rows(source, pair.source)
        target_features = self._described(target, settings)
        # Only now is the sample taken: features may depend on those of the points around.
        some = among(self._described(source, settings), rows), among(target_features, sample_rows(target, pair.target))
        moved = apply(pose, source.points)
        both = np.concatenate([apply(pose, raw[0].points), raw[1].points])
        diameter = float(np.linalg.norm(np.ptp(both, axis=0)))
        measured = {}
        for dim in measured_dims(row, group):
            scores: PairScores = {}
            if group.with_precision:
                sides = prefix(some[0], dim), prefix(target_features, dim)
                scores |= _precision(moved, target.points, *sides, group.model, diameter, self._cancelled)
            if group.with_recall:
                found = match(prefix(some[0], dim), prefix(some[1], dim), cancelled=self._cancelled).correspondences
                errors = _errors(moved, target.points, found.indices)
                threshold = MODEL_DEFAULTS[group.model].scaled(diameter).precision_radius
                scores["inlier_ratio"] = _rounded(metrics.precision(errors, threshold=threshold))
            measured[str(dim)] = scores
        return {"pair": pair.name, "dims": measured}

    def _read(self, path: Path, pair: PairFiles) -> PointCloud:
        if path not in self._raw:
            self._raw[path] = read_cloud(path, viewpoint=pair.viewpoint)
        return self._raw[path]

    def _prepared(self, path: Path, settings: ResolvedSettings, change: Perturbation | None) -> PointCloud:
        if change is not None and change.change in ("none", "radius"):
            change = None
        key = (path, settings.preparation_key, change)
        if key not in self._clouds:
            cloud = self._raw[path]
            if change is not None:
                # The model's lengths, not those of some weights, so that every row sees the same change.
                lengths = MODEL_DEFAULTS[settings.model].scaled(settings.diameter)
                cloud = perturb(
                    cloud,
                    change,
                    voxel_size=lengths.voxel_size,
                    normal_radius=lengths.normal_radius,
                    hole_radius=lengths.support_radius / 3,
                    rng=_rng(path, str(change)),
                )
            self._clouds[key] = pipeline.prepare(cloud, settings)
        return self._clouds[key]

    def _described(self, cloud: PointCloud, settings: ResolvedSettings) -> Features:
        # Prepared clouds are kept as long as features are, so no two of them have one identity.
        key = (id(cloud), settings.description_key)
        if key not in self._features:
            start = process_time()
            self._features[key] = pipeline.describe(cloud, settings, cancelled=self._cancelled)
            self.describe_s += process_time() - start
            self.described += len(cloud)
        return self._features[key]


def sample_rows(cloud: PointCloud, path: Path) -> Int64[np.ndarray, "K"]:
    """The same 5,000 rows, ascending, of a cloud whenever it is asked for; all where it has no more."""
    if len(cloud) <= SAMPLE:
        return np.arange(len(cloud), dtype=np.int64)
    return np.sort(_rng(path, "sample").permutation(len(cloud))[:SAMPLE])


def among(features: Features, rows: Int64[np.ndarray, "K"]) -> Features:
    """The features of those of `rows` that are described."""
    kept = np.isin(features.indices, rows, assume_unique=True)
    quality = None if features.quality is None else features.quality[kept]
    return replace(features, indices=features.indices[kept], vectors=features.vectors[kept], quality=quality)


def prefix(features: Features, dim: int) -> Features:
    """The features in their first `dim` dimensions: of unit length again where a network made them so."""
    if features.dim == dim:
        return features
    if features.descriptor in descriptors.NESTED:
        return descriptors.truncate(features, dim)
    return replace(features, vectors=np.ascontiguousarray(features.vectors[:, :dim]))


def _settings(row: Row, source: PointCloud, target: PointCloud, change: Perturbation | None) -> ResolvedSettings:
    settings = pipeline.resolve(row.settings, source, target)
    factor = row.radius_factor * (change.amount if change is not None and change.change == "radius" else 1.0)
    return replace(settings, support_radius=settings.support_radius * factor, min_radius=settings.min_radius * factor)


def _precision(
    moved: Float64[np.ndarray, "N 3"],
    target_points: Float64[np.ndarray, "M 3"],
    source: Features,
    target: Features,
    model: ModelName,
    diameter: float,
    cancelled: IsCancelled | None,
) -> PairScores:
    limits = MODEL_DEFAULTS[model].scaled(diameter)
    thresholds = np.array(THRESHOLDS[model]) * (diameter if MODEL_DEFAULTS[model].relative else 1.0)
    table = match(source, target, cancelled=cancelled)
    found, quality = table.correspondences, table.quality
    errors = _errors(moved, target_points, found.indices)
    apart, _ = build_tree(target_points).query(moved[found.indices[:, 0]], distance_upper_bound=2 * thresholds[-1])
    partner = apart <= limits.tau
    near = [metrics.precision(errors[apart <= threshold], threshold=threshold) for threshold in thresholds]
    right = errors <= limits.precision_radius
    sure = {}
    for by in RANKINGS if quality is not None else RANKINGS[:2]:
        trusted = trust(found, by, quality=quality)
        shares = [right[surest_rows(trusted, share=share)] for share in COVERAGES]
        sure[by] = [_rounded(float(share.mean())) if len(share) else None for share in shares]
    return {
        "partners": int(partner.sum()),
        "curve": [_rounded(float(value)) for value in metrics.precision_curve(errors[partner], thresholds)],
        "near": [_rounded(value) for value in near],
        "sure": sure,
    }


def _errors(
    moved: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "M 3"], indices: Int64[np.ndarray, "C 2"]
) -> Float64[np.ndarray, "C"]:
    return np.asarray(np.linalg.norm(moved[indices[:, 0]] - target[indices[:, 1]], axis=1))


def _rounded(value: float) -> float | None:
    """For JSON, which has no word for what is not a number."""
    return None if np.isnan(value) else round(value, 5)


def _rng(path: Path, purpose: str) -> np.random.Generator:
    """Draws that depend on nothing but the cloud and the purpose."""
    return np.random.default_rng(zlib.crc32(f"{path.parent.name}/{path.name} {purpose}".encode()))

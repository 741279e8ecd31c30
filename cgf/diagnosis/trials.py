"""Trying a remedy on a sample of the points, before it is recommended."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cgf import descriptors, pipeline
from cgf.checks import InputError
from cgf.descriptors.settings import DescriptorSettings
from cgf.diagnosis.case import Case
from cgf.diagnosis.consensus import find_consensus
from cgf.diagnosis.surfaces import even_rows
from cgf.matching import match
from cgf.pipeline import PairSettings, ResolvedSettings
from cgf.types import Features, IsCancelled, PointCloud

SOURCE_SAMPLE, TARGET_SAMPLE = 700, 1_400
ASKED = 500
"""Matches asked for a pose."""
CONVINCING = 30
"""Matches that agree after the remedy, at least; between halves of a room that share nothing, up to 29 of 500 did."""
BETTER = 2.0
"""Times as many agree with the remedy as without."""


@dataclass(frozen=True)
class Trial:
    """How many matches agree on one pose, with some settings changed and with those as they are."""

    changes: dict[str, Any]
    asked: int
    agreeing: int
    before: int
    """Of the same number of matches of the same points."""

    @property
    def share(self) -> float:
        """Of the asked matches that agree."""
        return self.agreeing / max(self.asked, 1)

    @property
    def is_better(self) -> bool:
        """Whether the changes help beyond chance."""
        return self.agreeing >= max(CONVINCING, BETTER * self.before)


def attempt(case: Case, changes: dict[str, Any], *, cancelled: IsCancelled | None = None) -> Trial | None:
    """Describe and match a sample of both clouds with some settings changed; half a second.

    Args:
        case: The pair.
        changes: Settings of `PairSettings` to try.
        cancelled: Asked between blocks of points whether to give up.

    Returns:
        None if the settings cannot be used with these clouds.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    after = try_settings(
        replace(case.wanted, **changes),
        case.loaded_source,
        case.loaded_target,
        scaled_by=case.wanted.source_scale,
        described=case,
        cancelled=cancelled,
    )
    if after is None:
        return None
    few = [_part(case.source_features, SOURCE_SAMPLE), _part(case.target_features, after.target_features)]
    before, _ = _agreeing(case.source, case.target, few[0], few[1], case.settings, cancelled)
    return Trial(changes, after.asked, after.agreeing, before)


@dataclass(frozen=True)
class Sampled:
    """What some settings give on a sample."""

    agreeing: int
    asked: int
    target_features: int


def try_settings(
    wanted: PairSettings,
    source: PointCloud,
    target: PointCloud,
    *,
    scaled_by: float = 1.0,
    described: Case | None = None,
    cancelled: IsCancelled | None = None,
) -> Sampled | None:
    """Describe and match a sample of both clouds.

    Args:
        wanted: What to try.
        source: As loaded.
        target: As loaded.
        scaled_by: The scale that `source` has been given already.
        described: Target features of this case are taken where they would be the same.
        cancelled: Asked between blocks of points whether to give up.

    Returns:
        None if the settings cannot be used with these clouds.
    """
    try:
        source, target = pipeline.correct(replace(wanted, source_scale=wanted.source_scale / scaled_by), source, target)
        settings = pipeline.resolve(wanted, source, target)
        source = pipeline.prepare(source, settings, "source")
        source_features = _described(source, settings, SOURCE_SAMPLE, cancelled)
        if described is not None and _only_source_changes(described, settings):
            target, target_features = described.target, described.target_features
        else:
            target = pipeline.prepare(target, settings, "target")
            target_features = _described(target, settings, TARGET_SAMPLE, cancelled)
    except InputError:
        return None
    agreeing, asked = _agreeing(source, target, source_features, target_features, settings, cancelled)
    return Sampled(agreeing, asked, len(target_features))


def _only_source_changes(case: Case, settings: ResolvedSettings) -> bool:
    """Whether the target would be described as it was."""
    was, now = case.settings.corrections, settings.corrections
    kept = replace(settings, corrections=was).description_key == case.settings.description_key
    return kept and was.flips("target") == now.flips("target") and was.normals == now.normals


def _agreeing(
    source: PointCloud,
    target: PointCloud,
    source_features: Features,
    target_features: Features,
    settings: ResolvedSettings,
    cancelled: IsCancelled | None,
) -> tuple[int, int]:
    """How many of the best matches between samples of both clouds agree on a pose, and how many were asked."""
    if not len(source_features) or not len(target_features):
        return 0, 0
    table = match(source_features, target_features, cancelled=cancelled).correspondences
    best = np.argsort(table.ratios, kind="stable")[:ASKED]
    indices = table.indices[best]
    # Samples lie farther apart than the points: a right match may miss by as much.
    spacing = settings.spacing * np.sqrt(len(target) / len(target_features))
    found = find_consensus(
        source.points[indices[:, 0]],
        target.points[indices[:, 1]],
        distance=max(settings.inlier_distance, float(spacing)),
        most=1,
        cancelled=cancelled,
    )
    return (len(found[0].rows) if found else 0), len(best)


def _described(cloud: PointCloud, settings: ResolvedSettings, most: int, cancelled: IsCancelled | None) -> Features:
    """Features of an even sample of a prepared cloud."""
    descriptor = descriptors.make_descriptor(
        settings.descriptor,
        DescriptorSettings(
            support_radius=settings.support_radius,
            min_radius=settings.min_radius,
            lrf_radius=settings.lrf_radius,
            dim=settings.computed_dim,
            model=settings.model,
            weights=settings.weights,
        ),
    )
    rows = even_rows(len(cloud), most)
    return pipeline.at_dim(descriptor.describe(cloud, rows, cancelled=cancelled), settings)


def usual_lengths(wanted: PairSettings) -> dict[str, Any]:
    """The changes that give up every length and model that the person chose; empty if there are none."""
    usual = PairSettings()
    names = ("support_radius", "min_radius", "lrf_radius", "voxel_size", "model")
    return {name: getattr(usual, name) for name in names if getattr(wanted, name) != getattr(usual, name)}


def _part(features: Features, most: int) -> Features:
    chosen = even_rows(len(features), most)
    quality = None if features.quality is None else features.quality[chosen]
    return replace(features, indices=features.indices[chosen], vectors=features.vectors[chosen], quality=quality)

"""The stages between two clouds and a motion, one function each, and `run_pair` for all of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int64

from cgf import descriptors
from cgf.checks import InputError
from cgf.descriptors.settings import DescriptorSettings
from cgf.matching import MatchTable, filter_rows, match_both
from cgf.pipeline.registering import RegistrationSettings, register_pair, registration_warning
from cgf.pipeline.settings import PairSettings, ResolvedSettings, correct, resolve
from cgf.types import (
    Cancelled,
    Correspondences,
    Features,
    Indices,
    IsCancelled,
    Pair,
    PointCloud,
    Progress,
    RegistrationResult,
)

FEWEST_POINTS = 10


@dataclass(frozen=True, eq=False)
class PairResult:
    """Everything that was computed for a pair."""

    settings: ResolvedSettings
    source: PointCloud
    """Prepared: its rows are what `correspondences` counts."""
    target: PointCloud
    source_features: Features
    """Of `settings.dim` dimensions."""
    target_features: Features
    table: MatchTable
    """Every match, before the filters."""
    rows: Int64[np.ndarray, "R"]
    """Rows of `table` that passed the filters."""
    registration: RegistrationResult | None
    """None where it was not asked for; its inliers are rows of `correspondences`."""
    warnings: tuple[str, ...]
    """One readable line each."""

    @property
    def correspondences(self) -> Correspondences:
        """The matches that passed the filters."""
        return self.table.correspondences.take(self.rows)


def load_pair(
    source_path: Path,
    target_path: Path,
    *,
    gt: Path | None = None,
    viewpoint: tuple[float, float, float] | None = None,
    drop_invalid: bool = False,
) -> Pair:
    """Read two clouds and, where `gt` is given, the file with their true pose.

    Args:
        source_path: Cloud that is moved.
        target_path: Cloud that stays.
        gt: A 4x4 matrix that maps the source onto the target, or a trajectory log that holds the pair.
        viewpoint: Position of the sensor, in each cloud's own frame.
        drop_invalid: Leave out rows with NaN or inf instead of refusing them.

    Raises:
        InputError: A file cannot be used.
    """
    from cgf import io

    position = None if viewpoint is None else np.array(viewpoint, dtype=np.float64)
    source = io.read_cloud(source_path, viewpoint=position, drop_invalid=drop_invalid)
    target = io.read_cloud(target_path, viewpoint=position, drop_invalid=drop_invalid)
    pose = None
    if gt is not None:
        pose = io.read_transform(gt, source_name=source_path.name, target_name=target_path.name)
    return Pair(f"{source.name} - {target.name}", source, target, pose)


def prepare(cloud: PointCloud, settings: ResolvedSettings, side: Literal["source", "target"] = "source") -> PointCloud:
    """Downsample, and estimate normals, turned to the viewpoint, where the cloud brings none.

    Args:
        cloud: As `correct` gives it.
        settings: Say the voxel size, and of which side the normals are turned round.
        side: Which of the two clouds it is.

    Raises:
        InputError: Fewer than 10 points are left.
    """
    from cgf.geometry.normals import estimate_normals
    from cgf.geometry.sampling import voxel_downsample

    prepared = cloud
    if settings.voxel_size > 0:
        try:
            prepared = voxel_downsample(cloud, settings.voxel_size)
        except ValueError as error:
            raise InputError(f"--voxel: {error}") from error
    if len(prepared) < FEWEST_POINTS:
        smaller = min(settings.voxel_size / 4, cloud.diameter / 50)
        raise InputError(
            f"--voxel must leave {FEWEST_POINTS} points or more, got {len(prepared)} of the {len(cloud):,} of "
            f"{cloud.name or 'the cloud'} with {settings.voxel_size:.3g}; try {smaller:.2g}"
        )
    if prepared.normals is None:
        prepared = estimate_normals(prepared, radius=settings.normal_radius)
    if settings.corrections.flips(side):
        assert prepared.normals is not None
        prepared = replace(prepared, normals=-prepared.normals)
    return prepared


def describe(
    cloud: PointCloud,
    settings: ResolvedSettings,
    *,
    indices: Indices | None = None,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> Features:
    """Describe points of a prepared cloud by `settings.computed_dim` values.

    Args:
        cloud: What `prepare` gives.
        settings: What and how to describe.
        indices: Rows of `cloud`; None describes every point.
        progress: Told the share done.
        cancelled: Asked now and then whether to give up.

    Raises:
        InputError: No point can be described.
        Cancelled: `cancelled` returned True.
    """
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
    if indices is None:
        indices = np.arange(len(cloud), dtype=np.int64)
    features = descriptor.describe(cloud, indices, progress=progress, cancelled=cancelled)
    if not len(features):
        raise InputError(
            f"--radius and --lrf-radius must hold neighbours, but none of the {len(indices):,} points of "
            f"{cloud.name or 'the cloud'} can be described with {settings.support_radius:.3g} and "
            f"{settings.lrf_radius:.3g}; try {2 * settings.support_radius:.2g} and {2 * settings.lrf_radius:.2g}"
        )
    return features


def match_features(
    source_features: Features,
    target_features: Features,
    settings: ResolvedSettings,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> MatchTable:
    """Match what `describe` gave in `settings.dim` dimensions, unfiltered.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    return match_both_features(source_features, target_features, settings, progress=progress, cancelled=cancelled)[0]


def match_both_features(
    source_features: Features,
    target_features: Features,
    settings: ResolvedSettings,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> tuple[MatchTable, MatchTable]:
    """As `match_features`, and from the target to the source, in the same time."""
    source, target = at_dim(source_features, settings), at_dim(target_features, settings)
    return match_both(source, target, progress=progress, cancelled=cancelled)


def at_dim(features: Features, settings: ResolvedSettings) -> Features:
    """The features in `settings.dim` dimensions, of those that `describe` gave."""
    return features if features.dim == settings.dim else descriptors.truncate(features, settings.dim)


def filtered_rows(table: MatchTable, settings: ResolvedSettings) -> Int64[np.ndarray, "R"]:
    """Rows of `table` that pass the filters that `settings` ask for."""
    return filter_rows(table, mutual=settings.mutual, max_ratio=settings.max_ratio, surest=settings.surest)


def run_pair(
    source: PointCloud,
    target: PointCloud,
    settings: PairSettings,
    *,
    register: bool = False,
    registration: RegistrationSettings | None = None,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> PairResult:
    """Do every stage for two clouds as loaded.

    Args:
        source: Cloud that is moved.
        target: Cloud that stays.
        settings: What the user chose.
        register: Whether to estimate the motion as well.
        registration: How; None takes RANSAC, then ICP.
        progress: Told the share done of the whole, and the stage.
        cancelled: Asked between chunks whether to give up.

    Raises:
        InputError: A setting cannot be used with these clouds.
        Cancelled: `cancelled` returned True.
    """
    source, target = correct(settings, source, target)
    resolved = resolve(settings, source, target)
    _stage(progress, cancelled, 0.0, "Preparing the clouds")
    source, target = prepare(source, resolved, "source"), prepare(target, resolved, "target")
    _stage(progress, cancelled, 0.05, "Describing the source")
    source_features = describe(source, resolved, progress=_part(progress, 0.05, 0.45), cancelled=cancelled)
    _stage(progress, cancelled, 0.45, "Describing the target")
    target_features = describe(target, resolved, progress=_part(progress, 0.45, 0.85), cancelled=cancelled)
    _stage(progress, cancelled, 0.85, "Matching features")
    table = match_features(
        source_features, target_features, resolved, progress=_part(progress, 0.85, 0.95), cancelled=cancelled
    )
    rows = filtered_rows(table, resolved)
    found = None
    warnings = [resolved.choice.warning]
    if register:
        _stage(progress, cancelled, 0.95, "Registering")
        correspondences = table.correspondences.take(rows)
        found = register_pair(
            source, target, correspondences, resolved, registration, progress=_part(progress, 0.95, 1.0),
            cancelled=cancelled,
        )  # fmt: skip
        warnings.append(registration_warning(found, correspondences, resolved))
    _stage(progress, cancelled, 1.0, "Done")
    return PairResult(
        settings=resolved,
        source=source,
        target=target,
        source_features=at_dim(source_features, resolved),
        target_features=at_dim(target_features, resolved),
        table=table,
        rows=rows,
        registration=found,
        warnings=tuple(warning for warning in warnings if warning is not None),
    )


def _stage(progress: Progress | None, cancelled: IsCancelled | None, share: float, text: str) -> None:
    if cancelled is not None and cancelled():
        raise Cancelled
    if progress is not None:
        progress(share, text)


def _part(progress: Progress | None, start: float, end: float) -> Callable[[float, str], None] | None:
    """Progress of a stage that takes from `start` to `end` of the whole."""
    if progress is None:
        return None
    return lambda share, text: progress(start + (end - start) * share, text)

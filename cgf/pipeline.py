"""From two clouds to correspondences and a motion: the only file that knows every stage.

The stages in order: `resolve` settings, `prepare` each cloud, `describe` each, `match_features`, filter,
`register_pair`. `run_pair` does them all; the viewer calls them one by one and keeps what has not changed, by the
keys of `ResolvedSettings`. Errors that a user can mend are `InputError`s and name the option of the command line.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Int64

from cgf import descriptors
from cgf.checks import InputError
from cgf.descriptors.settings import MODEL_DEFAULTS, DescriptorSettings, ModelDefaults, ModelName
from cgf.matching import MatchTable, filter_rows, match
from cgf.types import (
    Cancelled,
    Correspondences,
    Features,
    IsCancelled,
    Pair,
    PointCloud,
    Progress,
    RegistrationResult,
)

ROOM = (2.0, 30.0)
"""Diagonals of indoor fragments in metres, smallest and largest."""
ROOM_IN_MILLIMETRES = (1_000.0, 60_000.0)
FEWEST_POINTS = 10
FRAME_SPACINGS = 3.0
"""A frame needs 5 neighbours, which this many times the point spacing holds amply on a surface."""
LOW_FITNESS = 0.1
LOW_AGREEMENT = 0.01
"""Share of correspondences that agree on the best of many motions by chance alone: 0.3 % on shuffled ones."""


@dataclass(frozen=True)
class PairSettings:
    """What a person chooses; None takes the default of the model."""

    model: Literal["auto", "object", "indoor"] = "auto"
    """Weights and defaults: for single objects, or for rooms in metres."""
    descriptor: str = "cgf"
    """One of `cgf.descriptors.available()`."""
    dim: int | None = None
    """Number of values of a feature; None is 32, or the only one that the descriptor has."""
    support_radius: float | None = None
    """Radius of the neighbourhood described, in cloud units."""
    min_radius: float | None = None
    """Radius of the innermost shell; None keeps the model's share of `support_radius`."""
    lrf_radius: float | None = None
    """Radius of the neighbourhood that gives the local reference frame."""
    voxel_size: float | None = None
    """Edge of the voxels for downsampling; 0 keeps every point."""
    mutual: bool = False
    """Keep only matches that are each other's nearest."""
    max_ratio: float | None = None
    """Keep only matches at most this share of the second nearest's distance away."""
    seed: int = 0
    """Of the registration's random samples."""


@dataclass(frozen=True)
class ModelChoice:
    """Which model, and why, in a line each."""

    name: ModelName
    reason: str
    warning: str | None = None


@dataclass(frozen=True)
class ResolvedSettings:
    """Every value the stages use; lengths in cloud units."""

    choice: ModelChoice
    diameter: float
    """The larger of the two clouds' own diameters."""
    spacing: float
    """Median distance between neighbouring points once the clouds are prepared, about."""
    descriptor: str
    dim: int
    computed_dim: int
    """Dimension that is computed: that of the whole network where smaller ones are prefixes of it, else `dim`."""
    support_radius: float
    min_radius: float
    lrf_radius: float
    normal_radius: float
    voxel_size: float
    tau: float
    """A point has a true partner if the other cloud comes at least this near."""
    precision_radius: float
    error_scale: float
    inlier_distance: float
    """Of the registration."""
    mutual: bool
    max_ratio: float | None
    seed: int

    @property
    def model(self) -> ModelName:
        """The name of the chosen model."""
        return self.choice.name

    @property
    def preparation_key(self) -> tuple[float, float]:
        """All that `prepare` depends on besides the cloud."""
        return (self.voxel_size, self.normal_radius)

    @property
    def description_key(self) -> tuple[object, ...]:
        """All that `describe` depends on besides the raw cloud."""
        lengths = (self.support_radius, self.min_radius, self.lrf_radius)
        return (*self.preparation_key, self.descriptor, self.model, self.computed_dim, *lengths)

    @property
    def match_key(self) -> tuple[object, ...]:
        """All that `match_features` depends on besides the raw clouds; the filters come after it."""
        return (*self.description_key, self.dim)


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


def choose_model(source: PointCloud, target: PointCloud, requested: str = "auto") -> ModelChoice:
    """Take the indoor model for clouds of a room's extent in metres, else the one of relative scale.

    Raises:
        InputError: `requested` is no model.
    """
    if requested not in ("auto", *MODEL_DEFAULTS):
        raise InputError(f"--model must be auto, {' or '.join(MODEL_DEFAULTS)}, got {requested}")
    small, large = sorted((source.diameter, target.diameter))
    room = ROOM[0] <= large <= ROOM[1]
    warning = None
    if requested != "object" and ROOM_IN_MILLIMETRES[0] <= large <= ROOM_IN_MILLIMETRES[1]:
        warning = f"The clouds span {large:,.0f} units; if this is a room in millimetres, divide by 1000."
    elif requested == "indoor" and not room:
        warning = f"The indoor model expects rooms in metres, but the clouds span {large:.3g} units."
    elif small * 50 < large:
        warning = f"One cloud is {large / small:,.0f} times as large as the other; do their units agree?"
    if requested == "indoor":
        return ModelChoice("indoor", "Model indoor, as requested.", warning)
    if requested == "object":
        return ModelChoice("object", "Model object, as requested: lengths are shares of the diameter.", warning)
    if room:
        return ModelChoice("indoor", f"Model indoor: the larger cloud spans {large:.3g} m, as rooms do.", warning)
    reason = f"Model object: the clouds span {large:.3g} units, not the 2 to 30 m of a room, so scale is relative."
    return ModelChoice("object", reason, warning)


def resolve(settings: PairSettings, source: PointCloud, target: PointCloud) -> ResolvedSettings:
    """Fill in defaults for these clouds (as loaded, not prepared) and refuse what contradicts them.

    Raises:
        InputError: A setting cannot be used; the text names the option, the value and one that works.
    """
    choice = choose_model(source, target, settings.model)
    diameter = max(source.diameter, target.diameter)
    defaults = MODEL_DEFAULTS[choice.name].scaled(diameter)
    dim, computed_dim = _dimensions(settings, choice.name)
    voxel_size = _voxel_size(settings.voxel_size, defaults)
    spacing = max(_spacing(source), _spacing(target), voxel_size)
    support_radius = defaults.support_radius if settings.support_radius is None else settings.support_radius
    if settings.voxel_size is not None and voxel_size >= support_radius > 0:
        raise InputError(
            f"--voxel must be below the radius ({support_radius:.3g}), got {voxel_size:.3g}; "
            f"try {support_radius / 30:.2g}"
        )
    _check_radius(settings, support_radius, defaults, spacing, diameter)
    share = defaults.min_radius / defaults.support_radius
    min_radius = support_radius * share if settings.min_radius is None else settings.min_radius
    if not 0 < min_radius < support_radius:
        raise InputError(
            f"--min-radius must be above 0 and below the radius ({support_radius:.3g}), got {min_radius:.3g}; "
            f"try {support_radius * share:.2g}"
        )
    least = FRAME_SPACINGS * spacing
    lrf_radius = max(defaults.lrf_radius, least) if settings.lrf_radius is None else settings.lrf_radius
    if not spacing < lrf_radius <= diameter:
        raise InputError(
            f"--lrf-radius must be above the point spacing ({spacing:.3g}) and at most the diameter "
            f"({diameter:.3g}), got {lrf_radius:.3g}; try {max(defaults.lrf_radius, least):.2g}"
        )
    if settings.max_ratio is not None and not 0 < settings.max_ratio <= 1:
        raise InputError(f"--ratio must be above 0 and at most 1, got {settings.max_ratio:g}; try 0.9")
    if settings.seed < 0:
        raise InputError(f"--seed must be 0 or more, got {settings.seed}")
    return ResolvedSettings(
        choice=choice,
        diameter=diameter,
        spacing=spacing,
        descriptor=settings.descriptor,
        dim=dim,
        computed_dim=computed_dim,
        support_radius=support_radius,
        min_radius=min_radius,
        lrf_radius=lrf_radius,
        normal_radius=defaults.normal_radius,
        voxel_size=voxel_size,
        tau=defaults.tau,
        precision_radius=defaults.precision_radius,
        error_scale=defaults.error_scale,
        # Points of two scans of one surface lie up to about a spacing apart however good the motion is.
        inlier_distance=max(defaults.tau, 1.5 * spacing),
        mutual=settings.mutual,
        max_ratio=settings.max_ratio,
        seed=settings.seed,
    )


def prepare(cloud: PointCloud, settings: ResolvedSettings) -> PointCloud:
    """Downsample, and estimate normals, turned to the viewpoint, where the cloud brings none.

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
    return prepared if prepared.normals is not None else estimate_normals(prepared, radius=settings.normal_radius)


def describe(
    cloud: PointCloud,
    settings: ResolvedSettings,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> Features:
    """Describe every point of a prepared cloud by `settings.computed_dim` values.

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
        ),
    )
    indices = np.arange(len(cloud), dtype=np.int64)
    features = descriptor.describe(cloud, indices, progress=progress, cancelled=cancelled)
    if not len(features):
        raise InputError(
            f"--radius and --lrf-radius must hold neighbours, but none of the {len(cloud):,} points of "
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
    source, target = at_dim(source_features, settings), at_dim(target_features, settings)
    return match(source, target, progress=progress, cancelled=cancelled)


def at_dim(features: Features, settings: ResolvedSettings) -> Features:
    """The features in `settings.dim` dimensions, of those that `describe` gave."""
    return features if features.dim == settings.dim else descriptors.truncate(features, settings.dim)


def filtered_rows(table: MatchTable, settings: ResolvedSettings) -> Int64[np.ndarray, "R"]:
    """Rows of `table` that pass the filters that `settings` ask for."""
    return filter_rows(table, mutual=settings.mutual, max_ratio=settings.max_ratio)


def register_pair(
    source: PointCloud, target: PointCloud, correspondences: Correspondences, settings: ResolvedSettings
) -> RegistrationResult:
    """Find the motion most correspondences agree with (RANSAC), and refine it on the surfaces (ICP).

    Args:
        source: Prepared cloud.
        target: Prepared cloud.
        correspondences: Between their rows, filtered as the user likes.
        settings: Gives the inlier distance and the seed.

    Returns:
        `target_from_source` is None where no motion is agreed on.
    """
    from cgf.registration.icp import Icp, IcpConfig
    from cgf.registration.ransac import Ransac, RansacConfig

    distance = settings.inlier_distance
    coarse = Ransac(RansacConfig(distance, seed=settings.seed)).estimate(source, target, correspondences)
    if coarse.target_from_source is None:
        return coarse
    fine = Icp(IcpConfig(distance), coarse.target_from_source).estimate(source, target, correspondences)
    # A refinement that loses the surfaces has gone astray.
    return fine if fine.fitness >= 0.9 * coarse.fitness else coarse


def registration_warning(
    result: RegistrationResult, correspondences: Correspondences, settings: ResolvedSettings
) -> str | None:
    """A line for the user where the motion is missing or doubtful, else None."""
    if result.target_from_source is None:
        return (
            f"No motion was found that enough of the {len(correspondences):,} correspondences agree with; "
            "do the clouds overlap?"
        )
    near, agree = f"{settings.inlier_distance:.2g}", len(result.inliers)
    if agree < LOW_AGREEMENT * len(correspondences):
        return (
            f"Only {agree:,} of {len(correspondences):,} correspondences agree with the motion found (within {near}), "
            "as many as chance gives; do the clouds overlap?"
        )
    if result.fitness < LOW_FITNESS:
        return (
            f"Only {result.fitness:.0%} of the source's points come within {near} of the target after moving; "
            "do the clouds overlap?"
        )
    return None


def run_pair(
    source: PointCloud,
    target: PointCloud,
    settings: PairSettings,
    *,
    register: bool = False,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> PairResult:
    """Do every stage for two clouds as loaded.

    Args:
        source: Cloud that is moved.
        target: Cloud that stays.
        settings: What the user chose.
        register: Whether to estimate the motion as well.
        progress: Told the share done of the whole, and the stage.
        cancelled: Asked between chunks whether to give up.

    Raises:
        InputError: A setting cannot be used with these clouds.
        Cancelled: `cancelled` returned True.
    """
    resolved = resolve(settings, source, target)
    _stage(progress, cancelled, 0.0, "Preparing the clouds")
    source, target = prepare(source, resolved), prepare(target, resolved)
    _stage(progress, cancelled, 0.05, "Describing the source")
    source_features = describe(source, resolved, progress=_part(progress, 0.05, 0.45), cancelled=cancelled)
    _stage(progress, cancelled, 0.45, "Describing the target")
    target_features = describe(target, resolved, progress=_part(progress, 0.45, 0.85), cancelled=cancelled)
    _stage(progress, cancelled, 0.85, "Matching features")
    table = match_features(
        source_features, target_features, resolved, progress=_part(progress, 0.85, 0.95), cancelled=cancelled
    )
    rows = filtered_rows(table, resolved)
    registration = None
    warnings = [resolved.choice.warning]
    if register:
        _stage(progress, cancelled, 0.95, "Registering")
        correspondences = table.correspondences.take(rows)
        registration = register_pair(source, target, correspondences, resolved)
        warnings.append(registration_warning(registration, correspondences, resolved))
    _stage(progress, cancelled, 1.0, "Done")
    return PairResult(
        settings=resolved,
        source=source,
        target=target,
        source_features=at_dim(source_features, resolved),
        target_features=at_dim(target_features, resolved),
        table=table,
        rows=rows,
        registration=registration,
        warnings=tuple(warning for warning in warnings if warning is not None),
    )


_SPACINGS: WeakKeyDictionary[PointCloud, float] = WeakKeyDictionary()
"""Clouds never change, and a setting changes often."""


def _spacing(cloud: PointCloud) -> float:
    from cgf.geometry.neighbors import median_spacing

    if cloud not in _SPACINGS:
        _SPACINGS[cloud] = median_spacing(cloud.points)
    return _SPACINGS[cloud]


def _dimensions(settings: PairSettings, model: ModelName) -> tuple[int, int]:
    """The dimension asked for, and the one to compute."""
    if settings.descriptor not in descriptors.available():
        raise InputError(f"--descriptor must be one of {', '.join(descriptors.available())}, got {settings.descriptor}")
    choices = descriptors.dimensions(settings.descriptor, model)
    dim = settings.dim
    if dim is None:
        dim = 32 if 32 in choices else choices[-1]
    if dim not in choices:
        known = ", ".join(str(choice) for choice in choices)
        raise InputError(f"--dim must be one of {known} with --descriptor {settings.descriptor}, got {dim}")
    return dim, max(choices) if settings.descriptor in descriptors.NESTED else dim


def _voxel_size(requested: float | None, defaults: ModelDefaults) -> float:
    if requested is None:
        return defaults.voxel_size
    if not (np.isfinite(requested) and requested >= 0):
        raise InputError(
            f"--voxel must be 0 (keep every point) or more, got {requested:g}; try {defaults.voxel_size:.2g}"
        )
    return requested


def _check_radius(
    settings: PairSettings, radius: float, defaults: ModelDefaults, spacing: float, diameter: float
) -> None:
    usual = defaults.support_radius
    if not spacing < usual <= diameter:
        usual = min(max(0.17 * diameter, 5 * spacing), diameter)
    remedy = f"try {usual:.2g}"
    if settings.support_radius is None and radius > diameter:
        remedy = "choose --model object or give --radius"
    if not radius > spacing:
        raise InputError(f"--radius must be above the point spacing ({spacing:.3g}), got {radius:.3g}; {remedy}")
    if radius > diameter:
        raise InputError(
            f"--radius must be at most the diameter of the clouds ({diameter:.3g}), got {radius:.3g}; {remedy}"
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

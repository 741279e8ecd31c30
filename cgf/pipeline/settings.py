"""What a person chooses, and every value that follows from it for two clouds."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np

from cgf import descriptors
from cgf.checks import InputError
from cgf.descriptors.network import NetworkCard, load_network
from cgf.descriptors.settings import MODEL_DEFAULTS, ModelDefaults, ModelName
from cgf.types import PointCloud

ROOM = (2.75, 30.0)
"""Diagonals of the larger of two indoor fragments in metres, smallest and largest.

Fragments of 3DMatch scenes measure 2.4 to 4.8 m; common object scans, scaled to about 1.7 units an axis, up to 2.7.
"""
ROOM_IN_MILLIMETRES = (1_000.0, 60_000.0)
Unit = Literal["m", "cm", "mm", "ft", "in"]
METRES: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
"""Length of each unit."""
FRAME_SPACINGS = 3.0
"""A frame needs 5 neighbours, which this many times the point spacing holds amply on a surface."""


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
    surest: float | None = None
    """Keep only this share of all matches: surest by feature distance, and by quality where features have it."""
    seed: int = 0
    """Of the registration's random samples."""
    weights: Path | None = None
    """Of the descriptor `cgf`, written by `cgf train`; None takes those that come with the package."""
    unit: Unit = "m"
    """Of the clouds' coordinates; the indoor model needs to know it."""
    source_scale: float = 1.0
    """The source's coordinates are multiplied by this before anything else; every pose maps the scaled source."""
    normals: Literal["stored", "estimated"] = "stored"
    """`estimated` ignores the normals that the clouds bring."""
    flip_normals: Literal["none", "source", "target", "both"] = "none"
    """Clouds whose normals are turned round."""


@dataclass(frozen=True)
class Corrections:
    """What is mended in the clouds before they are described."""

    source_scale: float = 1.0
    normals: Literal["stored", "estimated"] = "stored"
    flip_normals: Literal["none", "source", "target", "both"] = "none"

    def flips(self, side: Literal["source", "target"]) -> bool:
        """Whether the normals of that cloud are turned round."""
        return self.flip_normals in (side, "both")


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
    surest: float | None
    seed: int
    weights: Path | None
    unit_m: float = 1.0
    """Metres that one unit of the clouds is long."""
    corrections: Corrections = Corrections()

    @property
    def model(self) -> ModelName:
        """The name of the chosen model."""
        return self.choice.name

    @property
    def preparation_key(self) -> tuple[object, ...]:
        """All that `prepare` depends on besides the cloud as loaded."""
        return (self.voxel_size, self.normal_radius, self.corrections)

    @property
    def description_key(self) -> tuple[object, ...]:
        """All that `describe` depends on besides the raw cloud."""
        lengths = (self.support_radius, self.min_radius, self.lrf_radius)
        return (*self.preparation_key, self.descriptor, self.model, self.weights, self.computed_dim, *lengths)

    @property
    def match_key(self) -> tuple[object, ...]:
        """All that `match_features` depends on besides the raw clouds; the filters come after it."""
        return (*self.description_key, self.dim)


def choose_model(source: PointCloud, target: PointCloud, requested: str = "auto", *, unit: Unit = "m") -> ModelChoice:
    """Take the indoor model for clouds of a room's extent, else the one of relative scale.

    Raises:
        InputError: `requested` is no model.
    """
    if requested not in ("auto", *MODEL_DEFAULTS):
        raise InputError(f"--model must be auto, {' or '.join(MODEL_DEFAULTS)}, got {requested}")
    small, large = sorted((source.diameter, target.diameter))
    span = large * METRES[unit]
    room = ROOM[0] <= span <= ROOM[1]
    warning = None
    if requested != "object" and unit == "m" and ROOM_IN_MILLIMETRES[0] <= large <= ROOM_IN_MILLIMETRES[1]:
        warning = f"The clouds span {large:,.0f} units; if this is a room in millimetres, say so with --unit mm."
    elif requested == "indoor" and not room:
        warning = f"The indoor model expects rooms, but the clouds span {large:.3g} {unit}; choose --unit or --model."
    elif small * 50 < large:
        warning = f"One cloud is {large / small:,.0f} times as large as the other; do their units agree?"
    if requested == "indoor":
        return ModelChoice("indoor", "Model indoor, as requested.", warning)
    if requested == "object":
        return ModelChoice("object", "Model object, as requested: lengths are shares of the diameter.", warning)
    if room:
        return ModelChoice("indoor", f"Model indoor: the larger cloud spans {span:.3g} m, as rooms do.", warning)
    reason = (
        f"Model object: the clouds span {span:.3g} units, not the {ROOM[0]:g} to {ROOM[1]:g} m of a room, "
        "so scale is relative."
    )
    return ModelChoice("object", reason, warning)


def correct(settings: PairSettings, source: PointCloud, target: PointCloud) -> tuple[PointCloud, PointCloud]:
    """Both clouds with the scale and the normals that `settings` ask for; normals are turned round by `prepare`.

    Raises:
        InputError: `settings.source_scale` is not positive.
    """
    scale = settings.source_scale
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"--source-scale must be positive, got {scale:g}")
    if scale != 1:
        source = replace(source, points=source.points * scale, viewpoint=source.viewpoint * scale)
    if settings.normals == "estimated":
        source, target = replace(source, normals=None), replace(target, normals=None)
    return source, target


def resolve(settings: PairSettings, source: PointCloud, target: PointCloud) -> ResolvedSettings:
    """Fill in defaults for these clouds (corrected, not prepared) and refuse what contradicts them.

    Raises:
        InputError: A setting cannot be used; the text names the option, the value and one that works.
    """
    card = None if settings.weights is None else _card(settings)
    if settings.unit not in METRES:
        raise InputError(f"--unit must be one of {', '.join(METRES)}, got {settings.unit}")
    unit_m = METRES[settings.unit]
    choice = choose_model(source, target, settings.model if card is None else card.model, unit=settings.unit)
    diameter = max(source.diameter, target.diameter)
    defaults = (MODEL_DEFAULTS[choice.name] if card is None else card.defaults()).scaled(diameter, unit_m)
    dim, computed_dim = _dimensions(settings, choice.name)
    voxel_size = _voxel_size(settings.voxel_size, defaults)
    points_apart = max(_spacing(source), _spacing(target))
    spacing = max(points_apart, voxel_size)
    support_radius = defaults.support_radius if settings.support_radius is None else settings.support_radius
    if settings.voxel_size is not None and voxel_size >= support_radius > points_apart:
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
    if settings.surest is not None and not 0 < settings.surest <= 1:
        raise InputError(f"--surest must be above 0 and at most 1, got {settings.surest:g}; try 0.5")
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
        surest=settings.surest,
        seed=settings.seed,
        weights=settings.weights,
        unit_m=unit_m,
        corrections=Corrections(settings.source_scale, settings.normals, settings.flip_normals),
    )


_SPACINGS: WeakKeyDictionary[PointCloud, float] = WeakKeyDictionary()
"""Clouds never change, and a setting changes often."""


def _spacing(cloud: PointCloud) -> float:
    from cgf.geometry.neighbors import median_spacing

    if cloud not in _SPACINGS:
        _SPACINGS[cloud] = median_spacing(cloud.points)
    return _SPACINGS[cloud]


def _card(settings: PairSettings) -> NetworkCard:
    """What the user's own weights were trained with, which their defaults follow."""
    assert settings.weights is not None
    if settings.descriptor != "cgf":
        raise InputError(f"--weights must go with --descriptor cgf, got {settings.descriptor}")
    try:
        card = load_network("cgf", None, settings.weights).card
    except ValueError as error:
        raise InputError(f"--weights: {error}") from error
    if settings.model not in ("auto", card.model):
        raise InputError(f"--model must fit --weights, which are for {card.model}, got {settings.model}; leave it out")
    return card


def _dimensions(settings: PairSettings, model: ModelName) -> tuple[int, int]:
    """The dimension asked for, and the one to compute."""
    if settings.descriptor not in descriptors.available():
        raise InputError(f"--descriptor must be one of {', '.join(descriptors.available())}, got {settings.descriptor}")
    choices = descriptors.dimensions(settings.descriptor, model, weights=settings.weights)
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

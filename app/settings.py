"""What a person can choose in the page, and how it is kept within what makes sense."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from cgf.pipeline import METRES, PairSettings, Side, Unit

LineChoice = Literal["stratified", "random", "best", "worst"]
Layout = Literal["side_by_side", "overlaid"]
Pose = Literal["loaded", "ground_truth", "estimate"]
Reference = Literal["ground_truth", "estimate"]
Coloring = Literal["error", "features", "original", "stage", "distance", "quality", "residual"]
Palette = Literal["paper", "viridis", "blue_orange"]
Normals = Literal["stored", "estimated"]
Flip = Literal["none", "source", "target", "both"]
StepOrder = Literal["worst", "best", "random"]
ModelRequest = Literal["auto", "object", "indoor"]

BarKind = Literal["error", "distance"]

MAX_LINES = 5_000
MAX_COLUMNS = 3
MAX_SELECTED = 1_000
POINT_SIZES = (0.25, 4.0)


_POSE = re.compile(r"loaded|ground_truth|estimate|automatic|run-[1-9][0-9]{0,5}")
"""Names of poses: the three that `ViewSettings.pose` offers, the estimate that nobody chose, and runs by number."""


@dataclass(frozen=True)
class Bar:
    """One bar of a histogram of the matches."""

    kind: BarKind
    """What the bars count matches by: their error, or the distance of their features."""
    low: float
    high: float


@dataclass(frozen=True)
class Column:
    """What one of several compared pictures is made with; all else is as in the page."""

    descriptor: str
    dim: int | None = None
    support_radius: float | None = None


@dataclass(frozen=True)
class Picked:
    """One point of a prepared cloud."""

    side: Side
    index: int


@dataclass(frozen=True)
class Selected:
    """Some points of a prepared cloud."""

    side: Side
    indices: tuple[int, ...]
    """At most `MAX_SELECTED`."""


@dataclass(frozen=True)
class ViewSettings:
    """Every control of the page; None takes what suits the pair."""

    pair: int = 0
    """Which of the pairs that were opened."""
    model: ModelRequest = "auto"
    weights: Path | None = None
    """Of the descriptor `cgf`, from the command line; the page does not choose files."""
    descriptor: str = "cgf"
    dim: int | None = None
    """Number of values of a feature; None is the descriptor's usual one."""
    support_radius: float | None = None
    """Radius of the neighbourhood described, in cloud units."""
    min_radius: float | None = None
    """Radius of its innermost shell; None keeps the model's share of `support_radius`."""
    lrf_radius: float | None = None
    """Radius of the neighbourhood that gives the local frame, in cloud units."""
    voxel_size: float | None = None
    """Edge of the voxels for downsampling, in cloud units; 0 keeps every point."""
    unit: Unit = "m"
    """Of the clouds' coordinates."""
    source_scale: float = 1.0
    """The source's coordinates are multiplied by this first."""
    normals: Normals = "stored"
    """`estimated` ignores those that the clouds bring."""
    flip_normals: Flip = "none"
    """Clouds whose normals are turned round."""
    mutual: bool = False
    """Keep only matches that are each other's nearest."""
    max_ratio: float | None = None
    """Keep only matches at most this share of the second nearest's distance away; None keeps all."""
    surest: float | None = None
    """Keep only this share of all matches, the surest by feature distance and quality; None keeps all."""
    line_count: int = 300
    """How many matches are drawn as lines."""
    line_choice: LineChoice = "stratified"
    """Which matches are drawn: evenly by error, at random, or the best or the worst."""
    error_scale: float | None = None
    """Error from which on the colour is the last of the palette, in cloud units."""
    palette: Palette = "paper"
    """Colours of errors."""
    point_size: float = 1.0
    """Relative to the size that just closes the surface."""
    layout: Layout = "side_by_side"
    pose: Pose | None = None
    """Where the source is drawn; None is the best pose known."""
    pose_from: str | None = None
    """Name of a pose from which the source is on its way to the one above, or to `pose_to`."""
    pose_to: str | None = None
    """Name of a pose that is drawn in place of `pose`."""
    pose_share: float = 1.0
    """How much of that way is gone."""
    reference: Reference | None = None
    """What errors are measured against; None is the ground truth where there is one."""
    coloring: Coloring = "error"
    right_within: float | None = None
    """Error up to which a match counts as right, in cloud units."""
    bar: Bar | None = None
    """Lines and colours are those of the matches in this bar only."""
    highlight: str | None = None
    """Kind of the finding whose points are highlighted in place of the colours above."""
    columns: tuple[Column, ...] = ()
    """What is compared; empty shows the pair itself."""
    compare_pair: bool = False
    """Whether every column shows the target as well, overlaid."""
    picked: Picked | None = None
    """The point looked into."""
    selected: Selected | None = None
    """Lines are drawn from these points only; None draws from all."""
    isolate: bool = False
    """Draw nothing but the picked point and its match, and dim all other points."""
    support_sphere: bool = False
    """Draw the sphere that the picked point's feature describes."""
    step_order: StepOrder = "worst"
    """In which order to go through the matches one by one."""
    follow: bool = False
    """Move the camera to the point that is picked."""

    @classmethod
    def of_pair(cls, wanted: PairSettings) -> "ViewSettings":
        """What the command line asked for, and every other control at its default."""
        return cls(**{name: getattr(wanted, name) for name in _OF_PAIR})

    def pair_settings(self) -> PairSettings:
        """The part the computation depends on."""
        chosen: dict[str, Any] = {name: getattr(self, name) for name in _OF_PAIR}
        if self.descriptor != "cgf":
            chosen["weights"] = None
        return PairSettings(**chosen)

    @property
    def work_key(self) -> tuple[object, ...]:
        """All that needs the worker when it changes; the rest is drawn again at once."""
        return (self.pair, self.pair_settings())

    @property
    def match_key(self) -> tuple[object, ...]:
        """All that needs new matches when it changes; filters choose among those that there are."""
        return (self.pair, replace(self.pair_settings(), mutual=False, max_ratio=None, surest=None))

    def changed(self, changes: Mapping[str, Any], *, pairs: int) -> "ViewSettings":
        """These settings with some replaced and every number clamped to what can be drawn.

        Args:
            changes: New values by name.
            pairs: How many pairs there are to choose from.

        Raises:
            ValueError: There is no such setting, or a choice that is not offered.
        """
        known = {field.name for field in fields(self)}
        for name in changes:
            if name not in known:
                raise ValueError(f"settings must be known, got {name}")
        new = replace(self, **changes)
        for name, choices in _CHOICES.items():
            if getattr(new, name) not in choices:
                shown = ", ".join(str(choice) for choice in choices if choice is not None)
                raise ValueError(f"{name} must be one of {shown}, got {getattr(new, name)}")
        if not 0 <= new.pair < pairs:
            raise ValueError(f"pair must be from 0 to {pairs - 1}, got {new.pair}")
        if "descriptor" in changes and "dim" not in changes and new.descriptor != self.descriptor:
            # Descriptors differ in the dimensions they offer.
            new = replace(new, dim=None)
        if "support_radius" in changes and "min_radius" not in changes:
            new = replace(new, min_radius=None)
        if new.pair != self.pair:
            # Lengths belong to one pair's units and extent.
            lengths: dict[str, Any] = {name: changes.get(name) for name in _LENGTHS}
            lengths |= {name: changes.get(name) for name in ("highlight", "bar", "pose_from", "pose_to")}
            new = replace(
                new,
                **lengths,
                source_scale=changes.get("source_scale", 1.0),
                flip_normals=changes.get("flip_normals", "none"),
            )
        if "pose" in changes or "pose_to" in changes:
            # A pose that is chosen is shown, not a place on some way to it.
            way: dict[str, Any] = {"pose_from": changes.get("pose_from"), "pose_to": changes.get("pose_to")}
            new = replace(new, **way, pose_share=changes.get("pose_share", 1.0))
        for name in ("error_scale", "right_within"):
            value = getattr(new, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value:g}")
        for name in ("pose_from", "pose_to"):
            pose = getattr(new, name)
            if pose is not None and not _POSE.fullmatch(pose):
                raise ValueError(f"{name} must be the name of a pose, such as loaded or run-1, got {pose}")
        if len(new.columns) > MAX_COLUMNS:
            raise ValueError(f"columns must be {MAX_COLUMNS} at most, got {len(new.columns)}")
        if any(getattr(new, name) != getattr(self, name) for name in _OF_THE_ROWS):
            points: dict[str, Any] = {name: changes.get(name) for name in ("picked", "selected")}
            new = replace(new, **points)
        if new.picked is None:
            new = replace(new, isolate=False)
        return replace(
            new,
            pose_share=min(max(new.pose_share, 0.0), 1.0),
            line_count=min(max(new.line_count, 0), MAX_LINES),
            point_size=min(max(new.point_size, POINT_SIZES[0]), POINT_SIZES[1]),
        )


_OF_PAIR = tuple({field.name for field in fields(PairSettings)} & {field.name for field in fields(ViewSettings)})
_LENGTHS = ("support_radius", "min_radius", "lrf_radius", "voxel_size", "error_scale", "right_within")
_OF_THE_ROWS = ("pair", "model", "voxel_size", "unit", "source_scale")
"""What the prepared clouds depend on, whose rows are what points are named by."""
_CHOICES: dict[str, tuple[object, ...]] = {
    "model": get_args(ModelRequest),
    "unit": tuple(METRES),
    "normals": get_args(Normals),
    "flip_normals": get_args(Flip),
    "line_choice": get_args(LineChoice),
    "layout": get_args(Layout),
    "pose": (None, *get_args(Pose)),
    "reference": (None, *get_args(Reference)),
    "coloring": get_args(Coloring),
    "palette": get_args(Palette),
    "step_order": get_args(StepOrder),
}

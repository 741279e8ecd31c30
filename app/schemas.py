"""What the page may send, checked before anything else sees it."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from app.settings import (
    MAX_COLUMNS,
    MAX_LINES,
    MAX_SELECTED,
    Bar,
    BarKind,
    Coloring,
    Column,
    Flip,
    Layout,
    LineChoice,
    ModelRequest,
    Normals,
    Palette,
    Picked,
    Pose,
    Reference,
    Selected,
    StepOrder,
)
from cgf.pipeline import RegistrationSettings, Side, Unit
from cgf.registration import IcpMetric

Length = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
Row = Annotated[int, Field(ge=0, le=1_000_000_000)]


class PickedPoint(BaseModel):
    """A point of a prepared cloud, by its row."""

    model_config = ConfigDict(extra="forbid")

    side: Side
    index: Row


class SelectedPoints(BaseModel):
    """Points of a prepared cloud, by their rows."""

    model_config = ConfigDict(extra="forbid")

    side: Side
    indices: Annotated[list[Row], Field(min_length=1, max_length=MAX_SELECTED)]


class HistogramBar(BaseModel):
    """A bar of a histogram of the matches."""

    model_config = ConfigDict(extra="forbid")

    kind: BarKind
    low: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
    high: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]


class ComparedColumn(BaseModel):
    """What one of the compared pictures is made with."""

    model_config = ConfigDict(extra="forbid")

    descriptor: Annotated[str, Field(max_length=40)]
    dim: Annotated[int, Field(ge=1, le=100_000)] | None = None
    support_radius: Length | None = None


class SettingsPatch(BaseModel):
    """Settings to change; what is left out stays, null takes the default for the pair."""

    model_config = ConfigDict(extra="forbid", strict=False)

    pair: Annotated[int, Field(ge=0)] = 0
    model: ModelRequest = "auto"
    descriptor: Annotated[str, Field(max_length=40)] = "cgf"
    dim: Annotated[int, Field(ge=1, le=100_000)] | None = None
    support_radius: Length | None = None
    min_radius: Length | None = None
    lrf_radius: Length | None = None
    voxel_size: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)] | None = None
    unit: Unit = "m"
    source_scale: Length = 1.0
    normals: Normals = "stored"
    flip_normals: Flip = "none"
    mutual: bool = False
    max_ratio: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] | None = None
    surest: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] | None = None
    line_count: Annotated[int, Field(ge=0, le=MAX_LINES)] = 300
    line_choice: LineChoice = "stratified"
    error_scale: Length | None = None
    palette: Palette = "paper"
    point_size: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    layout: Layout = "side_by_side"
    pose: Pose | None = None
    reference: Reference | None = None
    coloring: Coloring = "error"
    highlight: Annotated[str, Field(pattern=r"^[a-z_]{1,20}$")] | None = None
    pose_from: Annotated[str, Field(max_length=20)] | None = None
    pose_to: Annotated[str, Field(max_length=20)] | None = None
    pose_share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 1.0
    right_within: Length | None = None
    bar: HistogramBar | None = None
    columns: Annotated[list[ComparedColumn], Field(max_length=MAX_COLUMNS)] = []
    compare_pair: bool = False
    picked: PickedPoint | None = None
    selected: SelectedPoints | None = None
    isolate: bool = False
    support_sphere: bool = False
    step_order: StepOrder = "worst"
    follow: bool = False

    def changes(self) -> dict[str, Any]:
        """The settings that were sent."""
        changes = self.model_dump(exclude_unset=True)
        if self.bar is not None:
            changes["bar"] = Bar(**self.bar.model_dump())
        if "columns" in changes:
            changes["columns"] = tuple(Column(**column.model_dump()) for column in self.columns)
        if self.picked is not None:
            changes["picked"] = Picked(self.picked.side, self.picked.index)
        if self.selected is not None:
            changes["selected"] = Selected(self.selected.side, tuple(self.selected.indices))
        return changes


class RunRequest(BaseModel):
    """How to look for the pose; what is left out takes what suits the pair or the method."""

    model_config = ConfigDict(extra="forbid")

    method: Literal["ransac", "fgr", "icp"] = "ransac"
    inlier_distance: Length | None = None
    iterations: Annotated[int, Field(ge=1, le=10_000_000)] | None = None
    refine: bool = True
    metric: IcpMetric = "plane"
    start: Annotated[str, Field(max_length=20)] | None = None
    """Name of the pose that ICP starts from; null is the one shown."""

    def settings(self) -> RegistrationSettings:
        """What the library calls it."""
        return RegistrationSettings(**self.model_dump(exclude={"start"}))


class EstimateChoice(BaseModel):
    """Which pose stands for the estimate."""

    model_config = ConfigDict(extra="forbid")

    name: Annotated[str, Field(max_length=20)]


class Step(BaseModel):
    """To another match of those that are gone through one by one."""

    model_config = ConfigDict(extra="forbid")

    by: Literal[-1, 1] = 1
    """Forwards or backwards."""


class Problem(BaseModel):
    """Why a request could not be fulfilled, in a line for the person."""

    message: str


class SharedState(BaseModel):
    """Settings as one line of text, as links carry them."""

    model_config = ConfigDict(extra="forbid")

    text: Annotated[str, Field(max_length=4000)]


class OpenRequest(BaseModel):
    """Files of a pair, as paths on the viewer's machine."""

    model_config = ConfigDict(extra="forbid")

    source: Annotated[str, Field(min_length=1, max_length=4096)]
    target: Annotated[str, Field(min_length=1, max_length=4096)]
    gt: Annotated[str, Field(max_length=4096)] | None = None
    """Of the true pose."""
    drop_invalid: bool = False
    """Leave out points with NaN or inf instead of refusing them."""


class Uploaded(BaseModel):
    """Where a file was put that came from the page."""

    path: str


class SaveRequest(BaseModel):
    """Whether a file that is there already may be replaced."""

    model_config = ConfigDict(extra="forbid")

    overwrite: bool = False


class PosePlace(BaseModel):
    """Where the estimate goes beside the clouds."""

    path: str
    exists: bool


def in_words(errors: Sequence[Any]) -> str:
    """The first of the errors that pydantic found, in one line."""
    first = errors[0]
    names = [part for part in first["loc"] if isinstance(part, str) and part not in ("body", "path", "query")]
    where = names[0].replace("_", " ").capitalize() if names else "The request"
    message = str(first["msg"]).replace("Input should", "should").replace("Extra inputs are", "is")
    return f"{where} {message}." if message[:1].islower() else f"{where}: {message}."

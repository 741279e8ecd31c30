"""What the page may send, checked before anything else sees it."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from app.settings import (
    MAX_LINES,
    Coloring,
    Flip,
    Layout,
    LineChoice,
    ModelRequest,
    Normals,
    Palette,
    Pose,
    Reference,
)
from cgf.pipeline import Unit

Length = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]


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
    line_count: Annotated[int, Field(ge=0, le=MAX_LINES)] = 300
    line_choice: LineChoice = "stratified"
    error_scale: Length | None = None
    palette: Palette = "paper"
    point_size: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    layout: Layout = "side_by_side"
    pose: Pose | None = None
    reference: Reference | None = None
    coloring: Coloring = "error"

    def changes(self) -> dict[str, Any]:
        """The settings that were sent."""
        return self.model_dump(exclude_unset=True)


class Problem(BaseModel):
    """Why a request could not be fulfilled, in a line for the person."""

    message: str

"""What is drawn: points, lines and camera of an analysis, as plain arrays in the frame of the picture.

The picture is centred and scaled to a fixed size, so that float32 and the viewer's clipping planes suit millimetres,
metres and UTM coordinates alike. Clouds are moved by the pose of their node: a new pose or layout sends no point again.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Scores
from app.coloring import error_scale, point_colors
from app.colors import Colors
from app.explorer import NO_FINDINGS, Findings
from app.lines import lines
from app.overlays import SIDES, Overlays, Placement, draw_overlays, isolated
from app.placing import EXTENT, GAP, Floats, Placed, Single, View, rightward, view_of
from app.poses import shown_pose
from app.settings import ViewSettings
from cgf.geometry import transforms
from cgf.pipeline import Side
from cgf.types import PointCloud, Transform

POINT_RADIUS = 0.55
"""Of drawn points, in spacings: nearly closes the surface, and still tells one point from the next."""
LINE_PIXELS = 1.6
THIN_LINE_PIXELS = 0.7
"""Of matches beside those of a picked point."""


@dataclass(frozen=True, eq=False)
class CloudPicture:
    """One cloud as it is drawn."""

    points: Single
    """About its own centre; the same array as long as the points do not change."""
    prepared_rows: npt.NDArray[np.int64]
    """Row of the prepared cloud that each point borrows its colour from."""
    colors: Colors
    rotation: Floats
    position: Floats


@dataclass(frozen=True, eq=False)
class ColumnPicture:
    """One of several pictures beside each other."""

    source: CloudPicture
    target: CloudPicture | None
    """None shows the source alone."""
    label: str
    label_position: Floats


@dataclass(frozen=True, eq=False)
class Picture:
    """Everything the viewer draws."""

    source: CloudPicture
    target: CloudPicture
    overlaid_position: Floats
    """Of the source, where it is not moved aside."""
    point_size: float
    line_points: Single
    """(L, 2, 3), from source to target."""
    line_colors: Colors
    """(L, 3), as they shall look on the screen."""
    line_pixels: float
    overlays: Overlays
    view: View
    scene: tuple[object, ...]
    """Changes when the camera should be set anew."""
    columns: tuple[ColumnPicture, ...] = ()
    """Drawn in place of the clouds and lines above, where there are any."""
    followed: object = None
    """Changes when the camera should fly to the focus of `overlays`; None where it should stay."""


def draw(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, placed: Placed, findings: Findings = NO_FINDINGS
) -> Picture:
    """Draw an analysis as far as it has come."""
    shown = shown_pose(analysis, settings)
    pose = shown.matrix
    source_colors, target_colors = point_colors(analysis, scores, settings, findings)
    moved, rotation, position = _placed_at(placed, pose)
    overlaid_position = position
    right = rightward(placed.up, placed.direction)
    if settings.layout == "side_by_side":
        shift = (placed.target_prepared @ right).min() - GAP * EXTENT - (moved @ right).max()
        position = position + shift * right
        moved = moved + shift * right
    # On the way between two poses, the view holds both of them from the start.
    others = [_placed_at(placed, end)[0] for end in shown.ends if end is not pose] if len(shown.ends) > 1 else []
    ends, colors = lines(analysis, scores, settings, findings)
    starts = placed.source_prepared[ends[:, 0]] @ rotation.T + position
    line_points = np.stack([starts, placed.target_prepared[ends[:, 1]]], axis=1)
    placements: dict[Side, Placement] = {
        "source": Placement(
            placed.source_prepared, placed.scale, _raised(analysis.source, analysis, placed), rotation, position
        ),
        "target": Placement(
            placed.target_prepared, placed.scale, _raised(analysis.target, analysis, placed), np.eye(3), np.zeros(3)
        ),
    }
    source_rows, target_rows = analysis.source_shown.prepared_rows, analysis.target_shown.prepared_rows
    source = CloudPicture(placed.source_points, source_rows, source_colors, rotation, position)
    target = CloudPicture(placed.target_points, target_rows, target_colors, np.eye(3), np.zeros(3))
    if settings.isolate and findings.picked is not None:
        radius = analysis.resolved.support_radius
        source, target = (
            replace(cloud, colors=isolated(cloud.colors, cloud.points, side, placements[side], findings.picked, radius))
            for side, cloud in zip(SIDES, (source, target), strict=True)
        )
    return Picture(
        source=source,
        target=target,
        overlaid_position=overlaid_position,
        point_size=POINT_RADIUS * placed.spacing * settings.point_size,
        line_points=line_points.astype(np.float32),
        line_colors=colors,
        line_pixels=LINE_PIXELS if findings.picked is None else THIN_LINE_PIXELS,
        overlays=draw_overlays(
            findings.picked, placements, analysis.resolved, settings, error_scale=error_scale(analysis, settings),
        ),
        view=view_of(placed, np.concatenate([moved, *others, placed.target_prepared])),
        scene=(analysis.index, settings.layout, *shown.key, placed.frame),
        followed=settings.picked if settings.follow else None,
    )  # fmt: skip


def _raised(cloud: PointCloud, analysis: Analysis, placed: Placed) -> Floats:
    """From each prepared point towards the sensor, by what discs of the picture reach over each other."""
    normals = np.zeros_like(cloud.points) if cloud.normals is None else cloud.normals
    raised: Floats = normals * (2 * analysis.resolved.spacing * placed.scale)
    return raised


def _placed_at(placed: Placed, pose: Transform) -> tuple[Floats, Floats, Floats]:
    """The prepared source points in the picture under a pose, and rotation and position of their node."""
    rotation = pose[:3, :3]
    position = (transforms.apply(pose, placed.source_centre[None])[0] - placed.target_centre) * placed.scale
    return placed.source_prepared @ rotation.T + position, rotation, position

"""Where clouds lie in the picture, which way is up there, and where it is seen from.

The picture is centred and scaled to a fixed size, so that float32 and the viewer's clipping planes suit millimetres,
metres and UTM coordinates alike.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis
from cgf.types import PointCloud

EXTENT = 4.0
"""The larger cloud's diameter in the picture."""
FIELD_OF_VIEW = np.radians(40.0)
GAP = 0.06
"""Between clouds side by side, as a share of `EXTENT`."""
_UP_TOLERANCE = np.cos(np.radians(50.0))
_MARGIN = 1.05
_CENTRING_STEPS = 6
_FRAMED = 99.9
"""Percentile of points that the first view holds: a few strays shall not make everything small."""

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
_NOTHING: Single = np.zeros((0, 3), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class View:
    """Where the scene is seen from at first."""

    direction: Floats
    """From the scene to the camera, length 1."""
    up: Floats
    corners: Floats
    """Points that should be in sight."""

    def camera(self, aspect: float) -> tuple[Floats, Floats]:
        """Position and target of a camera that has all corners in the middle of its window, as large as they fit.

        Args:
            aspect: Width over height of the window.
        """
        right = rightward(self.up, self.direction)
        axes = np.stack([right, np.cross(self.direction, right), self.direction])
        corners = self.corners @ axes.T
        slopes = np.tan(FIELD_OF_VIEW / 2) * np.array([aspect, 1.0])
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        distance = 0.0
        for _ in range(_CENTRING_STEPS):
            offsets = corners - middle
            distance = float(np.max(np.abs(offsets[:, :2]) / slopes + offsets[:, 2:])) * _MARGIN
            # What is near looks larger, so the middle of the picture is not that of the corners.
            seen = offsets[:, :2] / (distance - offsets[:, 2:])
            middle[:2] += (seen.min(axis=0) + seen.max(axis=0)) / 2 * distance
        look_at = middle @ axes
        return look_at + self.direction * distance, look_at


@dataclass(frozen=True, eq=False)
class Placed:
    """The parts of a picture that depend on the clouds alone."""

    frame: object
    """The same one as long as the same points are drawn in the same place."""
    clouds: tuple[PointCloud, PointCloud]
    """Source and target as they are drawn."""
    source_points: Single
    """Those drawn."""
    target_points: Single
    source_prepared: Single
    """Those that matches connect, and that the layout goes by."""
    target_prepared: Single
    source_centre: Floats
    target_centre: Floats
    scale: float
    spacing: float
    up: Floats
    direction: Floats


def place(analysis: Analysis, before: Placed | None = None) -> Placed:
    """Centre and scale the clouds, and find how a person would hold them.

    What was placed `before` is taken over as far as it shows the same points, so that nothing is sent again.
    """
    source, target = analysis.source, analysis.target
    clouds = (analysis.source_shown.cloud, analysis.target_shown.cloud)
    if before is not None and all(old.points is new.points for old, new in zip(before.clouds, clouds, strict=True)):
        kept = before
    else:
        scale = EXTENT / max(source.diameter, target.diameter)
        centres = [(cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2 for cloud in (source, target)]
        up = up_direction(target, room=analysis.resolved.model == "indoor")
        kept = Placed(
            frame=object(),
            clouds=clouds,
            source_points=_centred(clouds[0], centres[0], scale),
            target_points=_centred(clouds[1], centres[1], scale),
            source_prepared=_NOTHING,
            target_prepared=_NOTHING,
            source_centre=centres[0],
            target_centre=centres[1],
            scale=scale,
            spacing=max(analysis.source_shown.spacing, analysis.target_shown.spacing) * scale,
            up=up,
            direction=view_direction(target, up),
        )
    return replace(
        kept,
        source_prepared=_centred(source, kept.source_centre, kept.scale),
        target_prepared=_centred(target, kept.target_centre, kept.scale),
    )


def _centred(cloud: PointCloud, centre: Floats, scale: float) -> Single:
    return ((cloud.points - centre) * scale).astype(np.float32)


def up_direction(cloud: PointCloud, *, room: bool) -> Floats:
    """Which way is up: for a room from its floor and table tops, for objects +y, as scanners and modellers have it.

    A room's frame is that of a camera, held about upright, whose y axis points down. Surfaces within 50 degrees of
    that which face up are averaged until the direction settles.
    """
    if not room:
        return np.array([0.0, 1.0, 0.0])
    up = np.array([0.0, -1.0, 0.0])
    if cloud.normals is None:
        return up
    cosine = _UP_TOLERANCE
    for _ in range(8):
        facing = cloud.normals[cloud.normals @ up > cosine]
        if len(facing) < 20:
            break
        # The principal direction of the flattest group: walls and clutter spread, a floor does not.
        mean = facing.mean(axis=0)
        up = mean / np.linalg.norm(mean)
        cosine = min(0.98, cosine + 0.06)
    return up


def view_direction(cloud: PointCloud, up: Floats) -> Floats:
    """From the cloud to a camera on the side that was scanned, a little above it."""
    facing = np.zeros(3) if cloud.normals is None else cloud.normals.mean(axis=0)
    level = facing - (facing @ up) * up
    if np.linalg.norm(level) < 1e-3:
        level = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    direction: Floats = level * np.cos(np.radians(22)) + up * np.sin(np.radians(22))
    return direction


def rightward(up: Floats, direction: Floats) -> Floats:
    """To the right for one who looks against `direction`, length 1."""
    right: Floats = np.cross(up, direction)
    return right / np.linalg.norm(right)


def view_of(placed: Placed, points: Floats) -> View:
    """The view that holds `points`, but for a few strays."""
    # A part of the points spans nearly the same at a fraction of the time, of which sliders have little.
    points = points[:: max(1, len(points) // 10_000)]
    low, high = np.percentile(points, (100 - _FRAMED, _FRAMED), axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    if len(inside) < 10:
        inside = points
    # A part of the points spans nearly the same view at a fraction of the time.
    return View(placed.direction, placed.up, inside[:: max(1, len(inside) // 4000)])

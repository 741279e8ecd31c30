"""What is drawn over the clouds for the picked point: markers, lines to its candidates, frames and the support."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.colors import AXES, PARTNER, PICKED, UNJUDGED, Colors, error_colors
from app.settings import ViewSettings
from cgf.pipeline import PointInspection, ResolvedSettings, Side, Surroundings

CIRCLE_STEPS = 48
MARKER = 2.6
"""Size of markers in spacings of the prepared points."""
SIDES: tuple[Side, Side] = ("source", "target")

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Overlays:
    """Drawn over both clouds; plain arrays in the frame of the picture."""

    marker_points: Single
    """(M, 3)."""
    marker_colors: Colors
    marker_size: float
    line_points: Single
    """(L, 2, 3)."""
    line_colors: Colors
    """(L, 3), as they shall look on the screen."""
    label_points: Single
    """(T, 3), where words stand, in front of everything."""
    label_texts: tuple[str, ...]
    focus: Floats
    """(F, 3), what a camera that looks at the picked point should have in sight; none where nothing is picked."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the points of one prepared cloud are in the picture."""

    points: Single
    """About the cloud's centre, in the scale of the picture."""
    scale: float
    """Of the picture over that of the cloud."""
    raised: Floats
    """(N, 3), by how much to draw over each point, so that the discs around it do not hide what is drawn."""
    rotation: Floats
    position: Floats

    def at(self, rows: npt.ArrayLike) -> Floats:
        """Positions of prepared rows, a little towards the sensor."""
        wanted = np.asarray(rows, dtype=np.int64)
        placed: Floats = (self.points[wanted] + self.raised[wanted]) @ self.rotation.T + self.position
        return placed


NOTHING = Overlays(
    np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 1.0, np.zeros((0, 2, 3), np.float32),
    np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32), (), np.zeros((0, 3)),
)  # fmt: skip


def draw_overlays(
    picked: PointInspection | None,
    placements: dict[Side, Placement],
    resolved: ResolvedSettings,
    settings: ViewSettings,
    *,
    error_scale: float,
) -> Overlays:
    """Draw what is known of the picked point.

    Args:
        picked: None draws nothing.
        placements: Of both clouds.
        resolved: Gives the radii of frames and of the support.
        settings: Whether to draw the support, and the runners-up.
        error_scale: Error at the end of the palette, in cloud units.
    """
    if picked is None:
        return NOTHING
    own = placements[picked.side]
    other = placements[_other(picked.side)]
    here = own.at([picked.point.row])
    candidates = picked.nearest[:1] if settings.isolate else picked.nearest
    rows = candidates if picked.partner is None else np.append(candidates, picked.partner.row)
    there = other.at(rows)
    if np.isnan(picked.errors).any():
        colors = np.tile(np.asarray(UNJUDGED, dtype=np.uint8), (len(candidates), 1))
    else:
        colors = error_colors(picked.errors[: len(candidates)], scale=error_scale, palette=settings.palette)
    if picked.partner is not None:
        colors = np.concatenate([colors, np.array([PARTNER], dtype=np.uint8)])
    fan = np.stack([np.broadcast_to(here, there.shape), there], axis=1)
    seen = [(picked.point, own, "picked")]
    if picked.match is not None:
        seen.append((picked.match, other, "match"))
    if picked.partner is not None and (picked.match is None or picked.partner.row != picked.match.row):
        seen.append((picked.partner, other, "true partner"))
    parts = [(fan, colors)]
    for surroundings, placement, _ in seen:
        parts.append(_axes(surroundings, placement, resolved.lrf_radius))
        if settings.support_sphere:
            parts.append(_sphere(surroundings, placement, resolved.support_radius))
    ends = np.concatenate([placement.at([item.row]) for item, placement, _ in seen])
    reach = resolved.support_radius * own.scale * np.concatenate([np.eye(3), -np.eye(3)])
    return Overlays(
        # The picked point comes last, so that it lies over a marker at the same place.
        marker_points=np.concatenate([there[::-1], here]).astype(np.float32),
        marker_colors=np.concatenate([colors[::-1], np.array([PICKED], dtype=np.uint8)]),
        marker_size=MARKER * resolved.spacing * own.scale,
        line_points=np.concatenate([points for points, _ in parts]).astype(np.float32),
        line_colors=np.concatenate([part for _, part in parts]),
        label_points=ends.astype(np.float32),
        label_texts=tuple(text for _, _, text in seen),
        focus=(ends[:, None] + reach).reshape(-1, 3),
    )


def isolated(
    colors: Colors, points: Single, side: Side, placement: Placement, picked: PointInspection, radius: float
) -> Colors:
    """Colours of one cloud, faded but around the picked point, its match and its true partner.

    Args:
        colors: Of `points`.
        points: Those that are drawn, about the cloud's centre and in the scale of the picture.
        side: Which cloud it is.
        placement: Of the prepared cloud.
        picked: What to leave as it is.
        radius: Of the surroundings that keep their colours, in cloud units.
    """
    items = (picked.point,) if side == picked.side else (picked.match, picked.partner)
    near = np.zeros(len(points), dtype=np.bool_)
    for item in items:
        if item is not None:
            near |= np.square(points - placement.points[item.row]).sum(axis=1) <= np.float32(
                (radius * placement.scale) ** 2
            )
    faded = np.rint(0.16 * colors + 0.84 * np.asarray(_GROUND)).astype(np.uint8)
    return np.where(near[:, None], colors, faded)


def _other(side: Side) -> Side:
    return "target" if side == "source" else "source"


_GROUND = (58, 67, 82)
"""About what lies behind the scene."""


def _axes(surroundings: Surroundings, placement: Placement, length: float) -> tuple[Floats, Colors]:
    if surroundings.frame is None:
        return np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8)
    start = placement.at([surroundings.row])
    ends = start + length * placement.scale * surroundings.frame @ placement.rotation.T
    return np.stack([np.broadcast_to(start, ends.shape), ends], axis=1), AXES


def _sphere(surroundings: Surroundings, placement: Placement, radius: float) -> tuple[Floats, Colors]:
    """Three circles, in the planes of the frame."""
    frame = np.eye(3) if surroundings.frame is None else surroundings.frame
    axes = frame @ placement.rotation.T
    angles = np.linspace(0, 2 * np.pi, CIRCLE_STEPS + 1)[:, None]
    circles = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        circle = np.cos(angles) * axes[first] + np.sin(angles) * axes[second]
        circles.append(np.stack([circle[:-1], circle[1:]], axis=1))
    segments = np.concatenate(circles) * radius * placement.scale + placement.at([surroundings.row])
    return segments, np.tile(np.asarray(PICKED, dtype=np.uint8), (len(segments), 1))

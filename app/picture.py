"""What is drawn: points, lines and camera of an analysis, as plain arrays in the frame of the picture.

The picture is centred and scaled to a fixed size, so that float32 and the viewer's clipping planes suit millimetres,
metres and UTM coordinates alike. Clouds are moved by the pose of their node: a new pose or layout sends no point again.
"""

import weakref
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, Scores, kept_rows
from app.colors import (
    NO_MATCH,
    SOURCE_TINT,
    TARGET_TINT,
    UNJUDGED,
    Colors,
    are_colors_usable,
    distance_colors,
    error_colors,
    feature_basis,
    feature_colors,
    quality_colors,
    shaded_colors,
    stage_colors,
)
from app.explorer import NO_FINDINGS, Findings, distance_range
from app.overlays import SIDES, Overlays, Placement, draw_overlays, isolated
from app.poses import residuals, shown_pose
from app.settings import Coloring, ViewSettings
from app.shown import Shown
from cgf.evaluation.matches import MatchErrors
from cgf.geometry import transforms
from cgf.matching import MatchTable
from cgf.pipeline import Side
from cgf.types import Features, PointCloud, Transform

EXTENT = 4.0
"""The larger cloud's diameter in the picture."""
FIELD_OF_VIEW = np.radians(40.0)
POINT_RADIUS = 0.55
"""Of drawn points, in spacings: nearly closes the surface, and still tells one point from the next."""
LINE_PIXELS = 1.6
THIN_LINE_PIXELS = 0.7
"""Of matches beside those of a picked point."""
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


def shown_coloring(analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings) -> Coloring:
    """The colouring chosen, or what comes closest before the stages for that are done."""
    wanted = settings.coloring
    if wanted == "residual":
        return "residual"
    if wanted == "original" or analysis.source_features is None:
        return "original"
    if wanted == "stage" and findings.stages is not None:
        return "stage"
    if wanted == "distance" and distance_range(findings.picked) is not None:
        return "distance"
    if wanted == "quality" and has_quality(analysis):
        return "quality"
    return "error" if wanted != "features" and scores is not None and scores.reference is not None else "features"


def has_quality(analysis: Analysis) -> bool:
    """Whether the features say how distinctive they are."""
    both = (analysis.source_features, analysis.target_features)
    return all(features is not None and features.quality is not None for features in both)


def point_colors(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[Colors, Colors]:
    """Colours of the points drawn."""
    prepared = _prepared_colors(analysis, scores, settings, findings)
    if prepared is None:
        return (
            _own_colors(analysis.source_shown, analysis.source, SOURCE_TINT),
            _own_colors(analysis.target_shown, analysis.target, TARGET_TINT),
        )
    return prepared[0][analysis.source_shown.prepared_rows], prepared[1][analysis.target_shown.prepared_rows]


def _prepared_colors(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[Colors, Colors] | None:
    """Colours of the prepared points; None where the points' own are to be shown."""
    source_features, target_features = analysis.source_features, analysis.target_features
    coloring = shown_coloring(analysis, scores, settings, findings)
    if coloring == "residual":
        scale = residual_scale(analysis, settings)
        both = residuals(analysis, shown_pose(analysis, settings).matrix, limit=scale)
        source, target = (error_colors(distances, scale=scale, palette=settings.palette) for distances in both)
        return source, target
    if coloring == "original" or source_features is None or target_features is None:
        return None
    if coloring == "stage":
        assert findings.stages is not None
        return stage_colors(findings.stages.source), stage_colors(findings.stages.target)
    if coloring == "distance":
        return _distances_of_points(findings)
    if coloring == "error":
        assert scores is not None
        assert analysis.matches is not None
        assert analysis.back_matches is not None
        scale = error_scale(analysis, settings)
        return (
            _errors_of_points(len(analysis.source), analysis.matches, scores.forward, scores.source_partner,
                              settings, scale),
            _errors_of_points(len(analysis.target), analysis.back_matches, scores.back, scores.target_partner,
                              settings, scale),
        )  # fmt: skip
    if source_features.quality is not None and target_features.quality is not None and coloring == "quality":
        source, target = quality_colors(source_features.quality), quality_colors(target_features.quality)
    else:
        source, target = _colors_of_features(source_features, target_features)
    return (
        _spread(source_features, source, len(analysis.source)),
        _spread(target_features, target, len(analysis.target)),
    )


_FEATURE_COLORS: WeakKeyDictionary[Features, tuple[weakref.ref[Features], tuple[Colors, Colors]]] = WeakKeyDictionary()
"""Of source features, with the target features that share their basis: pictures change more often than features."""


def _colors_of_features(source: Features, target: Features) -> tuple[Colors, Colors]:
    kept = _FEATURE_COLORS.get(source)
    if kept is None or kept[0]() is not target:
        basis = feature_basis(source.vectors, target.vectors)
        colors = feature_colors(source.vectors, basis), feature_colors(target.vectors, basis)
        kept = _FEATURE_COLORS[source] = (weakref.ref(target), colors)
    return kept[1]


def _distances_of_points(findings: Findings) -> tuple[Colors, Colors]:
    picked, ends = findings.picked, distance_range(findings.picked)
    assert picked is not None
    assert ends is not None
    own, other = (
        distance_colors(distances, low=ends[0], high=ends[1]) for distances in (picked.own_distances, picked.distances)
    )
    return (own, other) if picked.side == "source" else (other, own)


def error_scale(analysis: Analysis, settings: ViewSettings) -> float:
    """Error from which on the colour is the last of the palette, in cloud units."""
    return analysis.resolved.error_scale if settings.error_scale is None else settings.error_scale


def residual_scale(analysis: Analysis, settings: ViewSettings) -> float:
    """Distance between the surfaces from which on the colour is the last of the palette, in cloud units."""
    return analysis.resolved.inlier_distance if settings.error_scale is None else settings.error_scale


def in_bar(
    rows: npt.NDArray[np.int64], table: MatchTable, measured: MatchErrors, settings: ViewSettings
) -> npt.NDArray[np.int64]:
    """Those of `rows` that fall in the bar of a histogram that was chosen, if one was."""
    bar = settings.bar
    if bar is None:
        return rows
    values = (measured.errors if bar.kind == "error" else table.correspondences.distances)[rows]
    return rows[(values >= bar.low) & (values <= bar.high) & measured.has_partner[rows]]


def _own_colors(shown: Shown, prepared: PointCloud, tint: tuple[int, int, int]) -> Colors:
    if shown.cloud.colors is not None and are_colors_usable(shown.cloud.colors):
        return shown.cloud.colors
    shades = shaded_colors(tint, prepared.points, prepared.normals, viewpoint=prepared.viewpoint)
    return shades[shown.prepared_rows]


def _spread(features: Features, colors: Colors, count: int) -> Colors:
    """Colours of the described points among all points of a cloud."""
    all_colors = np.tile(np.asarray(NO_MATCH, dtype=np.uint8), (count, 1))
    all_colors[features.indices] = colors
    return all_colors


def _errors_of_points(
    count: int, table: MatchTable, measured: MatchErrors, partner: npt.NDArray[np.bool_], settings: ViewSettings,
    scale: float,
) -> Colors:  # fmt: skip
    errors = np.full(count, np.nan)
    rows = in_bar(kept_rows(table, settings), table, measured, settings)
    errors[table.correspondences.indices[rows, 0]] = measured.errors[rows]
    return error_colors(errors, scale=scale, palette=settings.palette, has_partner=partner)


def lines(
    analysis: Analysis, scores: Scores | None, settings: ViewSettings, findings: Findings
) -> tuple[npt.NDArray[np.int64], Colors]:
    """The matches to draw: their two rows, and their colours."""
    nothing = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.uint8)
    if analysis.matches is None or scores is None:
        return nothing
    coloring = shown_coloring(analysis, scores, settings, findings)
    # A heat map shows one point only, and so does what is isolated; between surfaces that are compared by their
    # distance, lines would only hide them.
    if coloring in ("distance", "residual") or (settings.isolate and findings.picked is not None):
        return nothing
    indices = analysis.matches.correspondences.indices
    by_stage = coloring == "stage"
    # Where the colours say which stage rejects a match, the rejected ones are drawn too.
    rows = np.arange(len(indices)) if by_stage else kept_rows(analysis.matches, settings)
    rows = in_bar(rows, analysis.matches, scores.forward, settings)
    if settings.selected is not None:
        column = 0 if settings.selected.side == "source" else 1
        rows = rows[np.isin(indices[rows, column], settings.selected.indices)]
    is_judged = scores.reference is not None
    chosen = choose_lines(
        rows,
        # Without a pose nothing is known but how alike the features are.
        scores.forward.errors if is_judged else analysis.matches.correspondences.distances,
        scores.forward.has_partner if is_judged and not by_stage else np.ones(len(indices), dtype=bool),
        settings,
    )
    if by_stage:
        assert findings.stages is not None
        return indices[chosen], stage_colors(findings.stages.source[indices[chosen, 0]])
    quality = analysis.matches.quality
    if coloring == "quality" and quality is not None:
        return indices[chosen], quality_colors(quality[chosen])
    scale = error_scale(analysis, settings)
    colors = error_colors(
        scores.forward.errors[chosen], scale=scale, palette=settings.palette,
        has_partner=scores.forward.has_partner[chosen],
    )  # fmt: skip
    if not is_judged:
        colors = np.tile(np.asarray(UNJUDGED, dtype=np.uint8), (len(chosen), 1))
    return indices[chosen], colors


def choose_lines(
    rows: npt.NDArray[np.int64],
    badness: npt.NDArray[np.floating],
    has_partner: npt.NDArray[np.bool_],
    settings: ViewSettings,
) -> npt.NDArray[np.int64]:
    """Pick `settings.line_count` of `rows`.

    Args:
        rows: Of the table of matches, those that passed the filters.
        badness: Of every match of the table: its error.
        has_partner: Whether a match of the table could be right; the others are drawn only at random.
        settings: How many, and which.

    Returns:
        Rows of the table; the same ones for the same arguments.
    """
    count = settings.line_count
    if settings.line_choice == "random":
        order = np.random.default_rng(0).permutation(len(rows))
        return np.sort(rows[order[:count]])
    rows = rows[has_partner[rows]]
    rows = rows[np.argsort(badness[rows], kind="stable")]
    if settings.line_choice == "best":
        return rows[:count]
    if settings.line_choice == "worst":
        return rows[max(len(rows) - count, 0) :]
    # Evenly by error, so that a hundred lines show the shares that all matches have.
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(np.int64))]

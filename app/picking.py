"""Which point of a picture is under the pointer, or inside a box on the screen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from app.overlays import SIDES
from app.picture import CloudPicture, Picture
from app.settings import MAX_SELECTED, Picked, Selected
from cgf.pipeline import Side

PIXELS = 4.0
"""How far from the pointer a point may be."""
BEHIND = 2.0
"""Points this many point sizes behind the frontmost one are on the same surface."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in the frame of the picture."""

    position: Floats
    rotation: Floats
    """Columns are its axes: right, down, forward."""
    field_of_view: float
    """Vertical, in radians."""
    width: int
    height: int

    @property
    def pixel(self) -> float:
        """Size of a pixel at distance 1."""
        return float(2 * np.tan(self.field_of_view / 2) / self.height)


def point_at_ray(picture: Picture, origin: Floats, direction: Floats, *, pixel: float) -> tuple[Side, int] | None:
    """The drawn point under the pointer: the frontmost within a few pixels, or of those beside it the nearest.

    Args:
        picture: What is drawn.
        origin: Where the ray begins.
        direction: Where it goes, of any length but zero.
        pixel: Size of a pixel at distance 1.

    Returns:
        The cloud, and the prepared row that the point stands for; None where the pointer is beside all points.
    """
    axes = _axes(direction)
    found = []
    for side in SIDES:
        along, aside = _along_and_aside(getattr(picture, side), origin, axes)
        reach = np.maximum(PIXELS * pixel * along, picture.point_size / 2)
        rows = np.flatnonzero((along > 0) & (aside <= reach))
        found.append((side, rows, along[rows], aside[rows] / along[rows]))
    depths = [along.min() for _, _, along, _ in found if len(along)]
    if not depths:
        return None
    last = min(depths) + BEHIND * picture.point_size
    in_front = [
        (float(angle), side, int(row))
        for side, rows, along, angles in found
        for row, angle in zip(rows[along <= last], angles[along <= last], strict=True)
    ]
    _, side, row = min(in_front)
    return side, int(getattr(picture, side).prepared_rows[row])


def points_in_box(
    picture: Picture, camera: Camera, low: tuple[float, float], high: tuple[float, float]
) -> tuple[Side, npt.NDArray[np.int64]] | None:
    """The points that are seen inside a box on the screen, of the cloud that has more of them there.

    Args:
        picture: What is drawn.
        camera: That looks at it.
        low: Left upper corner, as shares of the window's width and height.
        high: Right lower corner.

    Returns:
        The cloud, and the prepared rows that its points there stand for, from the middle of the box outwards; None
        where the box is empty.
    """
    slope = np.tan(camera.field_of_view / 2) * np.array([camera.width / camera.height, 1.0])
    middle = (np.asarray(low) + np.asarray(high)) / 2
    seen = []
    for side in SIDES:
        cloud = getattr(picture, side)
        inside = _local(cloud, camera.position, camera.rotation)
        depth = np.maximum(inside[:, 2], 1e-9)
        screen = (inside[:, :2] / depth[:, None] / slope + 1) / 2
        rows = np.flatnonzero((inside[:, 2] > 0) & (screen >= low).all(axis=1) & (screen <= high).all(axis=1))
        seen.append((side, rows, depth[rows], screen[rows]))
    # What lies behind other points is not seen: of a cell of the screen as large as a drawn point, the front only.
    depths = np.concatenate([depth for _, _, depth, _ in seen])
    if not len(depths):
        return None
    size = max(PIXELS * camera.pixel, picture.point_size / float(np.median(depths))) / slope
    cells = np.concatenate([np.floor(screen / size) for _, _, _, screen in seen]).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    front = np.full(cell.max() + 1, np.inf)
    np.minimum.at(front, cell.ravel(), depths)
    visible = depths <= front[cell.ravel()] + BEHIND * picture.point_size
    border = len(seen[0][1])
    parts = [
        (side, rows[part], np.linalg.norm(screen[part] - middle, axis=1))
        for (side, rows, _, screen), part in zip(seen, (visible[:border], visible[border:]), strict=True)
    ]
    side, rows, distances = max(parts, key=lambda part: len(part[1]))
    prepared = getattr(picture, side).prepared_rows[rows[np.argsort(distances, kind="stable")]]
    _, first = np.unique(prepared, return_index=True)
    return side, prepared[np.sort(first)]


def changes_at(picture: Picture | None, origin: Floats, direction: Floats, *, pixel: float) -> dict[str, Any]:
    """Settings that pick the point under the pointer, arguments as of `point_at_ray`; beside all points, none."""
    if picture is None or picture.columns:
        return {}
    found = point_at_ray(picture, origin, direction, pixel=pixel)
    return {"picked": None if found is None else Picked(*found), "selected": None}


def changes_in(
    picture: Picture | None, camera: Camera, low: tuple[float, float], high: tuple[float, float]
) -> dict[str, Any]:
    """Settings that pick the point in the middle of a box, arguments as of `points_in_box`, and select those in it."""
    found = None if picture is None or picture.columns else points_in_box(picture, camera, low, high)
    if found is None:
        return {"picked": None, "selected": None}
    side, rows = found
    # Evenly thinned from the middle outwards.
    some = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_SELECTED)).astype(np.int64))]
    return {"picked": Picked(side, int(rows[0])), "selected": Selected(side, tuple(some.tolist()))}


def _axes(direction: Floats) -> Floats:
    """Columns: two directions across the ray, and its own."""
    forward = direction / np.linalg.norm(direction)
    across = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(forward, across), forward], axis=1)


def _local(cloud: CloudPicture, origin: Floats, axes: Floats) -> npt.NDArray[np.float32]:
    """The points of a cloud in the frame at `origin` whose axes are the columns of `axes`."""
    turn = (cloud.rotation.T @ axes).astype(np.float32)
    shift = ((cloud.position - origin) @ axes).astype(np.float32)
    moved: npt.NDArray[np.float32] = cloud.points @ turn + shift
    return moved


def _along_and_aside(
    cloud: CloudPicture, origin: Floats, axes: Floats
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    local = _local(cloud, origin, axes)
    return local[:, 2], np.hypot(local[:, 0], local[:, 1])

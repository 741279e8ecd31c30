from dataclasses import replace

import numpy as np
import pytest

from app.overlays import NOTHING
from app.picking import Camera, point_at_ray, points_in_box
from app.picture import CloudPicture, Picture
from app.placing import View

EYE = np.array([0.0, 0.0, 5.0])
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(EYE, np.diag([1.0, -1.0, -1.0]), np.radians(40), 800, 600)
"""Above the origin, looking down, with y upwards on the screen."""
PIXEL = CAMERA.pixel


def wall(depth: float, *, side: int = 21) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    return np.column_stack([x.ravel(), y.ravel(), np.full(side * side, depth)]).astype(np.float32)


def picture(source: np.ndarray, target: np.ndarray, *, point_size: float = 0.02) -> Picture:
    clouds = [
        # Drawn points stand for prepared ones, here in opposite order.
        CloudPicture(points, np.arange(len(points))[::-1], np.zeros_like(points, np.uint8), np.eye(3), np.zeros(3))
        for points in (source, target)
    ]
    view = View(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.zeros((1, 3)))
    nothing = np.zeros((0, 2, 3), np.float32)
    return Picture(
        source=clouds[0], target=clouds[1], overlaid_position=np.zeros(3), point_size=point_size, line_points=nothing,
        line_colors=np.zeros((0, 3), np.uint8), line_pixels=1.6, overlays=NOTHING, view=view, scene=(),
    )  # fmt: skip


def test_of_two_walls_the_front_one_is_picked() -> None:
    drawn = picture(wall(0.0), wall(-1.0))
    assert point_at_ray(drawn, EYE, drawn.source.points[30] - EYE, pixel=PIXEL) == ("source", 440 - 30)
    behind = replace(drawn, source=replace(drawn.source, position=np.array([0.0, 0.0, -2.0])))
    assert point_at_ray(behind, EYE, behind.target.points[30] - EYE, pixel=PIXEL) == ("target", 440 - 30)


def test_a_moved_cloud_is_picked_where_it_is_drawn() -> None:
    drawn = picture(wall(0.0), np.zeros((0, 3), np.float32))
    moved = replace(drawn, source=replace(drawn.source, rotation=TURNED, position=np.array([3.0, 0.0, 0.0])))
    place = TURNED @ drawn.source.points[100] + [3.0, 0.0, 0.0]
    assert point_at_ray(moved, EYE, place - EYE, pixel=PIXEL) == ("source", 440 - 100)


def test_beside_all_points_nothing_is_picked() -> None:
    drawn = picture(wall(0.0), wall(-1.0))
    assert point_at_ray(drawn, EYE, np.array([2.0, 0.0, -5.0]), pixel=PIXEL) is None
    # Behind the camera.
    assert point_at_ray(drawn, EYE, np.array([0.0, 0.0, 1.0]), pixel=PIXEL) is None


@pytest.mark.parametrize(("pixels", "hit"), [(3.0, True), (6.0, False)])
def test_a_click_may_miss_by_a_few_pixels(pixels: float, hit: bool) -> None:
    drawn = picture(np.zeros((1, 3), np.float32), np.zeros((0, 3), np.float32), point_size=1e-6)
    direction = np.array([pixels * PIXEL, 0.0, -1.0])
    assert (point_at_ray(drawn, EYE, direction, pixel=PIXEL) is not None) == hit


def test_a_box_holds_what_is_seen_in_it_from_the_middle_outwards() -> None:
    # The points of the front wall close it.
    drawn = picture(wall(0.0), wall(-1.0), point_size=0.15)
    found = points_in_box(drawn, CAMERA, (0.3, 0.3), (0.7, 0.6))
    assert found is not None
    side, rows = found
    assert side == "source"
    # x and y at the depth of the wall, whose screen is 5 tan 20 degrees high to each side.
    height = 5 * np.tan(np.radians(20))
    points = drawn.source.points
    screen = np.column_stack([points[:, 0] / (height * 4 / 3), -points[:, 1] / height]) / 2 + 0.5
    inside = ((screen >= [0.3, 0.3]) & (screen <= [0.7, 0.6])).all(axis=1)
    assert sorted(440 - rows) == np.flatnonzero(inside).tolist()
    distances = np.linalg.norm(screen[440 - rows] - [0.5, 0.45], axis=1)
    assert (np.diff(distances) > -1e-6).all()


def test_a_box_over_nothing_selects_nothing() -> None:
    assert points_in_box(picture(wall(0.0), wall(-1.0)), CAMERA, (0.0, 0.0), (0.05, 0.05)) is None

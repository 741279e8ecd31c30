from dataclasses import replace

import numpy as np
import pytest

from app.analysis import Analysis
from app.lines import choose_lines
from app.picture import draw
from app.placing import EXTENT, FIELD_OF_VIEW, View, place, rightward, up_direction
from app.settings import LineChoice, ViewSettings
from app.shown import choose_shown
from cgf.geometry.transforms import apply, move, rigid, rotation_about
from cgf.pipeline import PairSettings, prepare, resolve
from cgf.types import Pair, PointCloud
from tests.app.scenes import bumpy_cloud, hills

SETTINGS = ViewSettings()


def analysis_of(pair: Pair) -> Analysis:
    resolved = resolve(PairSettings(), pair.source, pair.target)
    source, target = prepare(pair.source, resolved), prepare(pair.target, resolved)
    shown = choose_shown(pair.source, source), choose_shown(pair.target, target)
    return Analysis(0, pair, resolved, source, target, *shown)


def drawn(analysis: Analysis, settings: ViewSettings) -> tuple[np.ndarray, np.ndarray]:
    picture = draw(analysis, None, settings, place(analysis))
    return tuple(
        cloud.points.astype(np.float64) @ cloud.rotation.T + cloud.position
        for cloud in (picture.source, picture.target)
    )


def test_overlaid_in_the_true_pose_the_clouds_lie_where_the_pose_says() -> None:
    analysis = analysis_of(hills())
    source, target = drawn(analysis, replace(SETTINGS, layout="overlaid", pose="ground_truth"))
    assert analysis.truth is not None
    moved = apply(analysis.truth, analysis.source_shown.cloud.points)
    # One scale and one shift for both.
    scale = EXTENT / max(analysis.source.diameter, analysis.target.diameter)
    np.testing.assert_allclose(source - target[0], (moved - analysis.target_shown.cloud.points[0]) * scale, atol=1e-5)


def test_clouds_in_survey_coordinates_keep_their_shape() -> None:
    far = rigid(np.eye(3), [4_500_000.0, 450_000.0, 120.0])
    pair = hills()
    there = Pair("utm", move(far, pair.source), move(far, pair.target))
    near, distant = (drawn(analysis_of(one), SETTINGS) for one in (Pair("here", pair.source, pair.target), there))
    for here, away in zip(near, distant, strict=True):
        np.testing.assert_allclose(np.ptp(away, axis=0), np.ptp(here, axis=0), atol=1e-4)


def test_side_by_side_the_source_lies_left_of_the_target() -> None:
    analysis = analysis_of(hills())
    settings = replace(SETTINGS, layout="side_by_side")
    placed = place(analysis)
    right = rightward(placed.up, placed.direction)
    source, target = drawn(analysis, settings)
    assert (source @ right).max() < (target @ right).min()


def test_without_truth_and_estimate_the_pose_is_as_loaded() -> None:
    pair = hills()
    analysis = analysis_of(Pair("pair", pair.source, pair.target))
    picture = draw(analysis, None, replace(SETTINGS, pose="ground_truth"), place(analysis))
    np.testing.assert_array_equal(picture.source.rotation, np.eye(3))


@pytest.mark.parametrize("aspect", [0.7, 1.0, 1.7, 3.0])
def test_the_first_view_holds_every_corner(aspect: float) -> None:
    rng = np.random.default_rng(0)
    direction = np.array([0.3, 0.4, 0.866])
    direction /= np.linalg.norm(direction)
    view = View(direction, np.array([0.0, 1.0, 0.0]), rng.normal(size=(200, 3)) * [3.0, 1.0, 1.0] + [5.0, 0.0, 0.0])
    camera, look_at = view.camera(aspect)
    np.testing.assert_allclose((camera - look_at) / np.linalg.norm(camera - look_at), direction)
    right = np.cross(view.up, direction)
    right /= np.linalg.norm(right)
    upward = np.cross(direction, right)
    offsets = view.corners - camera
    depth = -offsets @ direction
    slope = np.tan(FIELD_OF_VIEW / 2)
    assert (depth > 0).all()
    height, width = offsets @ upward / (depth * slope), offsets @ right / (depth * slope * aspect)
    assert max(np.abs(height).max(), np.abs(width).max()) == pytest.approx(0.95, abs=0.05)
    # In the middle, both ways.
    assert height.max() + height.min() == pytest.approx(0, abs=0.02)
    assert width.max() + width.min() == pytest.approx(0, abs=0.02)


def test_up_in_a_room_is_against_its_floor() -> None:
    rng = np.random.default_rng(0)
    floor_normal = rotation_about([1.0, 0.0, 0.0], np.radians(25)) @ [0.0, -1.0, 0.0]
    normals = np.concatenate(
        [np.tile(floor_normal, (400, 1)), np.tile([0.0, 0.0, -1.0], (300, 1)), rng.normal(size=(100, 3))]
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PointCloud(rng.normal(size=(800, 3)), normals=normals)
    assert up_direction(cloud, room=True) @ floor_normal > np.cos(np.radians(2))


def test_up_of_an_object_is_y() -> None:
    assert up_direction(bumpy_cloud(), room=False).tolist() == [0.0, 1.0, 0.0]


def test_up_in_a_room_without_floor_is_that_of_the_camera() -> None:
    wall = PointCloud(np.zeros((50, 3)), normals=np.tile([0.0, 0.0, -1.0], (50, 1)))
    assert up_direction(wall, room=True).tolist() == [0.0, -1.0, 0.0]


ERRORS = np.array([0.5, 0.1, 0.9, 0.3, 0.7, 0.0])
PARTNER = np.array([True, True, True, True, True, False])


@pytest.mark.parametrize(("choice", "expected"), [("best", [1, 3]), ("worst", [4, 2]), ("stratified", [1, 2])])
def test_lines_are_chosen_by_error_among_matches_that_could_be_right(choice: LineChoice, expected: list[int]) -> None:
    settings = ViewSettings(line_count=2, line_choice=choice)
    assert choose_lines(np.arange(6), ERRORS, PARTNER, settings).tolist() == expected


def test_a_fair_sample_has_the_shares_of_all_matches() -> None:
    rng = np.random.default_rng(0)
    errors = rng.exponential(size=5_000)
    chosen = choose_lines(np.arange(5_000), errors, np.ones(5_000, dtype=bool), ViewSettings(line_count=200))
    assert len(chosen) == 200
    for quantile in (0.1, 0.5, 0.9):
        assert np.quantile(errors[chosen], quantile) == pytest.approx(np.quantile(errors, quantile), rel=0.05)


def test_random_lines_are_the_same_every_time_and_no_more_than_there_are() -> None:
    settings = ViewSettings(line_count=4, line_choice="random")
    chosen = choose_lines(np.arange(6), ERRORS, PARTNER, settings)
    assert len(set(chosen.tolist())) == 4
    assert chosen.tolist() == choose_lines(np.arange(6), ERRORS, PARTNER, settings).tolist()
    assert len(choose_lines(np.arange(3), ERRORS, PARTNER, settings)) == 3


@pytest.mark.parametrize("choice", ["stratified", "random", "best", "worst"])
def test_no_lines_from_no_matches(choice: LineChoice) -> None:
    rows = np.zeros(0, dtype=np.int64)
    assert choose_lines(rows, ERRORS, PARTNER, ViewSettings(line_choice=choice)).shape == (0,)


def test_no_lines_are_drawn_where_none_are_wanted() -> None:
    assert len(choose_lines(np.arange(6), ERRORS, PARTNER, ViewSettings(line_count=0))) == 0

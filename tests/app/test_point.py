"""A point picked in a session: what is found out about it, drawn, and told to the page."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.colors import DISTANCE_TABLE, NO_MATCH, STAGE_COLORS
from app.picking import changes_at
from app.session import Session
from app.settings import Picked, Selected
from cgf.checks import InputError
from cgf.pipeline import REJECTIONS
from cgf.types import Pair
from tests.app.scenes import LONG_S, SETTINGS, hills, source_of


def noisy_hills() -> Pair:
    """The hills, scanned anew: no feature is exactly that of another point."""
    pair = hills()
    noise = np.random.default_rng(0).normal(scale=0.01, size=pair.source.points.shape)
    return replace(pair, source=replace(pair.source, points=pair.source.points + noise))


@pytest.fixture(scope="module")
def opened() -> Iterator[Session]:
    session = Session([source_of(noisy_hills())], SETTINGS)
    session.start()
    assert session.wait_until_idle(LONG_S)
    yield session
    session.close()


@pytest.fixture
def session(opened: Session) -> Iterator[Session]:
    """The opened session, put back afterwards as it was."""
    yield opened
    opened.change({name: getattr(SETTINGS, name) for name in SETTINGS.__dataclass_fields__})
    assert opened.wait_until_idle(LONG_S)


def picture_of(session: Session) -> Any:
    picture = session.picture()
    assert picture is not None
    return picture


@pytest.mark.parametrize("side", ["source", "target"])
def test_a_picked_point_is_told_of_and_marked(session: Session, side: str) -> None:
    before = picture_of(session)
    snapshot = session.change({"picked": Picked(side, 200)})
    assert snapshot.picked is not None
    assert (snapshot.picked.side, snapshot.picked.index) == (side, 200)
    details = session.point()
    assert (details.side, details.index) == (side, 200)
    assert details.stage == snapshot.picked.stage
    assert len(details.candidates) == 8
    assert details.partner is not None
    assert details.partner.rank is not None
    listed = [candidate.row for candidate in details.candidates]
    assert (details.partner.row in listed) == (details.partner.rank <= 8)
    assert details.candidates[0].right == (details.candidates[0].error <= snapshot.numbers.precision_radius)
    after = picture_of(session)
    # The match, seven runners-up, the partner, and the point itself.
    assert after.overlays.marker_points.shape == (10, 3)
    # Nothing but the markers is drawn again.
    assert after.source.points is before.source.points
    np.testing.assert_array_equal(after.source.colors, before.source.colors)
    assert len(before.overlays.marker_points) == 0


def test_the_fan_goes_from_the_point_to_its_candidates(session: Session) -> None:
    session.change({"picked": Picked("source", 200), "layout": "overlaid"})
    picture, details = picture_of(session), session.point()
    fan = picture.overlays.line_points[:9]
    # Overlaid in the true pose, a line is as long as the error of its match, but for the ends, which are raised by
    # twice the spacing along their normals so that no disc hides them.
    errors = np.array([*(candidate.error for candidate in details.candidates), details.partner.gap])
    scale = np.linalg.norm(np.ptp(picture.target.points, axis=0)) / hills().target.diameter
    lengths = np.linalg.norm(fan[:, 1] - fan[:, 0], axis=1)
    spacing = 3 / 31
    assert (np.abs(lengths - errors * scale) <= 4 * spacing * scale).all()
    np.testing.assert_allclose(fan[:, 1], picture.overlays.marker_points[-2::-1])
    np.testing.assert_allclose(fan[:, 0], picture.overlays.marker_points[[-1] * 9])


def test_isolating_hides_the_other_lines_and_dims_what_is_far(session: Session) -> None:
    session.change({"picked": Picked("source", 200)})
    before = picture_of(session)
    assert len(before.line_points) == 300
    session.change({"isolate": True})
    after = picture_of(session)
    assert len(after.line_points) == 0
    assert len(after.overlays.marker_points) == 3
    kept = (after.source.colors == before.source.colors).all(axis=1)
    assert 0 < np.count_nonzero(kept) < len(kept)
    # Nothing is isolated without a point.
    assert not session.change({"picked": None}).settings.isolate


def test_a_box_limits_the_lines_to_its_points(session: Session) -> None:
    chosen = (200, 201, 202, 230, 231)
    session.change({"selected": Selected("source", chosen), "line_choice": "random"})
    picture = picture_of(session)
    # The drawn points that stand for them.
    rows = np.flatnonzero(np.isin(picture.source.prepared_rows, chosen))
    places = picture.source.points[rows] @ picture.source.rotation.T + picture.source.position
    starts = picture.line_points[:, 0]
    assert len(starts) == len(rows) == len(chosen)
    assert np.linalg.norm(starts[:, None] - places, axis=2).min(axis=1).max() < 1e-5


def test_colours_by_distance_are_those_of_the_features(session: Session) -> None:
    snapshot = session.change({"picked": Picked("source", 200), "coloring": "distance"})
    assert snapshot.legend is not None
    assert snapshot.legend.coloring == "distance"
    labels = [float(tick.label) for tick in snapshot.legend.ticks]
    assert labels == sorted(labels)
    assert [snapshot.legend.ticks[0].at, snapshot.legend.ticks[-1].at] == [0, 1]
    details = session.point()
    assert labels[0] == pytest.approx(details.candidates[0].feature_distance, rel=0.01)
    colors = picture_of(session).target.colors
    assert colors[details.candidates[0].row].tolist() == DISTANCE_TABLE[0].tolist()
    assert len(picture_of(session).line_points) == 0
    # Without a point there is no distance to show.
    assert session.change({"picked": None}).legend.coloring == "error"


def test_every_point_has_the_colour_of_its_stage_and_the_funnel_counts_them(session: Session) -> None:
    snapshot = session.change({"coloring": "stage", "mutual": True, "max_ratio": 0.95})
    assert snapshot.legend is not None
    explained = {swatch.label: swatch.color for swatch in snapshot.legend.swatches}
    assert "not mutual" in explained
    colors = picture_of(session).source.colors
    counts = {name: int((colors == STAGE_COLORS[name]).all(axis=1).sum()) for name in REJECTIONS}
    assert sum(counts.values()) == len(colors)
    funnel = {step.name: step for step in snapshot.funnel}
    passed = len(colors) - counts["no_frame"]
    assert funnel["With a frame"].count == passed
    for stage, name in (
        ("no_partner", "Overlapping"),
        ("not_mutual", "Mutual"),
        ("above_ratio", "Ratio"),
        ("outlier", "Inliers"),
    ):
        passed -= counts[stage]
        assert funnel[name].count == passed
        assert funnel[name].precision == pytest.approx(funnel[name].right / passed)
    assert snapshot.numbers is not None
    assert funnel["Ratio"].count == snapshot.numbers.with_partner
    assert funnel["Ratio"].precision == snapshot.numbers.precision


def test_filters_show_at_once_while_the_pose_is_still_to_be_estimated(session: Session) -> None:
    everything = session.snapshot().numbers
    snapshot = session.change({"mutual": True})
    assert not snapshot.settled
    assert snapshot.numbers is not None
    assert everything is not None
    assert snapshot.numbers.matches < everything.matches
    assert session.wait_until_idle(LONG_S)
    assert session.snapshot().numbers == snapshot.numbers


def test_steps_go_through_the_matches_by_error_and_around(session: Session) -> None:
    errors = []
    for place in (1, 2, 3):
        snapshot = session.step(1)
        assert snapshot.settings.isolate
        assert snapshot.picked.step == place
        errors.append(session.point().candidates[0].error)
    assert errors == sorted(errors, reverse=True)
    assert session.step(-1).picked.step == 2
    session.change({"step_order": "best", "picked": None})
    last = session.step(-1).picked
    assert last.step == last.steps == snapshot.picked.steps
    assert session.point().candidates[0].error == max(errors)


def test_random_steps_visit_every_match_once(session: Session) -> None:
    session.change({"step_order": "random", "mutual": True, "max_ratio": 0.55})
    count = session.step(1).picked.steps
    assert count > 3
    seen = [session.step(1).picked.index for _ in range(count)]
    assert len(set(seen)) == count == session.snapshot().numbers.matches


def test_without_a_match_there_is_nothing_to_step_to(session: Session) -> None:
    session.change({"max_ratio": 1e-6})
    with pytest.raises(InputError, match="No match passes the filters"):
        session.step(1)


def test_nothing_picked_is_said(session: Session) -> None:
    with pytest.raises(InputError, match="Nothing is picked; click a point in the scene"):
        session.point()


@pytest.mark.parametrize(
    "changes", [{"picked": Picked("source", 5000)}, {"selected": Selected("source", (3, 5000))}], ids=str
)
def test_a_point_that_does_not_exist_is_refused(session: Session, changes: dict[str, Any]) -> None:
    before = session.snapshot()
    last = before.source.prepared - 1
    with pytest.raises(
        InputError, match=f"{next(iter(changes))} must be a row of the source from 0 to {last}, got 5000"
    ):
        session.change(changes)
    assert session.snapshot() == before


def test_another_voxel_size_forgets_the_point(session: Session) -> None:
    session.change({"picked": Picked("source", 200), "isolate": True})
    snapshot = session.change({"voxel_size": 0.1})
    assert snapshot.settings.picked is None
    assert not snapshot.settings.isolate
    # Unless it comes with the change, as from an address that was shared.
    again = session.change({"voxel_size": 0.0, "picked": Picked("target", 7)})
    assert again.settings.picked == Picked("target", 7)


def test_a_click_picks_the_point_under_it_and_one_beside_all_points_none(session: Session) -> None:
    picture = picture_of(session)
    place = picture.target.points[300] + picture.target.position
    eye = place + 20 * picture.view.direction
    session.change(changes_at(picture, eye, place - eye, pixel=1e-4))
    picked = session.settings.picked
    assert picked is not None
    assert picked.side == "target"
    session.change(changes_at(picture, eye, eye - place, pixel=1e-4))
    assert session.settings.picked is None


def test_a_point_without_a_feature_says_so(session: Session) -> None:
    missing = np.flatnonzero((picture_of(session).source.colors == NO_MATCH).all(axis=1))
    if len(missing):
        snapshot = session.change({"picked": Picked("source", int(missing[0]))})
        assert snapshot.picked.stage in ("no_frame", "no_feature")
        assert session.point().candidates == ()

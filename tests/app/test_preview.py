"""What is shown of new settings while most points are still to be described."""

from collections.abc import Iterator

import numba
import numpy as np
import pytest

from app import analysis as analyses
from app.picture import Picture
from app.preview import borrowing, choose_rows
from app.session import Session
from app.settings import ViewSettings
from app.shown import choose_shown
from app.snapshot import Snapshot
from cgf import pipeline
from cgf.geometry.transforms import apply
from cgf.types import Features
from tests.app.scenes import LONG_S, hills, source_of


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Iterator[Session]:
    """A session that describes 100 points of each cloud first, whatever the machine."""
    monkeypatch.setattr(analyses, "PREVIEWS", ((1.0, 0.4),))
    monkeypatch.setattr(analyses, "USUAL_POINTS_PER_S", 200.0)
    session = Session([source_of(hills())], ViewSettings(support_radius=0.8))
    yield session
    session.close()


def heard(session: Session) -> list[tuple[Snapshot, Picture | None]]:
    """Every state and picture from now on; the worker tells of each before it goes on."""
    states: list[tuple[Snapshot, Picture | None]] = []
    session.listen(lambda: states.append((session.snapshot(), session.picture())))
    return states


def test_half_of_the_chosen_points_are_partners_of_the_other_half() -> None:
    pair = hills()
    assert pair.target_from_source is not None
    rows = choose_rows(pair.source, pair.target, count=60, target_from_source=pair.target_from_source)
    for chosen, cloud in zip(rows, (pair.source, pair.target), strict=True):
        assert 40 < len(chosen) <= 60
        assert len(set(chosen.tolist())) == len(chosen) <= len(cloud)
    moved = apply(pair.target_from_source, pair.source.points[rows[0]])
    gaps = np.linalg.norm(moved[:, None] - pair.target.points[rows[1]][None], axis=2).min(axis=1)
    # The clouds share their points but for a corner.
    assert np.mean(gaps < 1e-9) > 0.8


def test_without_a_pose_the_chosen_points_are_spread_evenly() -> None:
    pair = hills()
    rows, _ = choose_rows(pair.source, pair.target, count=50, target_from_source=None)
    assert 25 < len(rows) <= 50
    gaps = np.linalg.norm(pair.source.points[:, None] - pair.source.points[rows][None], axis=2).min(axis=1)
    assert gaps.max() < 3 * 3 / np.sqrt(len(rows))


def test_all_points_borrow_from_the_nearest_described_one() -> None:
    cloud = hills().target
    shown = choose_shown(cloud, cloud)
    few = Features(np.array([3, 500, 900]), np.zeros((3, 2), np.float32), "cgf")
    rows = borrowing(shown, cloud, few).prepared_rows
    distances = np.linalg.norm(cloud.points[:, None] - cloud.points[few.indices][None], axis=2)
    np.testing.assert_array_equal(rows, few.indices[distances.argmin(axis=1)])


def test_a_new_radius_is_previewed_and_the_numbers_wait_for_all_points(session: Session) -> None:
    session.start()
    assert session.wait_until_idle(LONG_S)
    before, picture = session.snapshot(), session.picture()
    assert picture is not None
    session._analyst._points_per_s = 200.0
    states = heard(session)
    session.change({"support_radius": 1.0})
    assert session.wait_until_idle(LONG_S)
    previews = [(state, shown) for state, shown in states if state.previewed is not None]
    assert previews
    for state, shown in previews:
        assert shown is not None
        assert not state.settled
        assert state.numbers == before.numbers
        assert state.previewed is not None
        assert 60 < state.previewed <= 200
        assert shown.source.points is picture.source.points
        assert not np.array_equal(shown.source.colors, picture.source.colors)
        # All have a colour of one of the few.
        assert len(np.unique(shown.source.prepared_rows)) <= 110
    after, last = session.snapshot(), session.picture()
    assert after.settled
    assert after.previewed is None
    assert last is not None
    assert last.source.points is picture.source.points
    assert len(np.unique(last.source.prepared_rows)) == len(picture.source.points)


def test_what_is_known_already_is_not_previewed(session: Session) -> None:
    session.start()
    assert session.wait_until_idle(LONG_S)
    states = heard(session)
    for changes in ({"dim": 8}, {"mutual": True}, {"coloring": "features"}):
        session.change(changes)
        assert session.wait_until_idle(LONG_S)
    assert [state for state, _ in states if state.previewed is not None] == []


def test_stopping_during_a_preview_shows_the_last_good_result_again(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.start()
    assert session.wait_until_idle(LONG_S)
    picture = session.picture()
    assert picture is not None
    session._analyst._points_per_s = 200.0

    def stop_at_preview() -> None:
        if session.snapshot().previewed is not None:
            session.cancel()

    session.listen(stop_at_preview)
    session.change({"support_radius": 1.0})
    assert session.wait_until_idle(LONG_S)
    state, shown = session.snapshot(), session.picture()
    assert shown is not None
    assert state.previewed is None
    assert not state.settled
    np.testing.assert_array_equal(shown.source.colors, picture.source.colors)


def test_another_voxel_size_draws_the_same_points(session: Session) -> None:
    session.start()
    assert session.wait_until_idle(LONG_S)
    before = session.picture()
    session.change({"voxel_size": 0.2})
    assert session.wait_until_idle(LONG_S)
    after = session.picture()
    assert before is not None
    assert after is not None
    assert after.source.points is before.source.points
    assert after.scene == before.scene


def test_compiling_is_told_while_the_clouds_are_shown_already(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = numba.njit(lambda value: value + 1)
    describe = pipeline.describe

    def compile_first(*arguments: object, **named: object) -> object:
        kernel(1)
        return describe(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(pipeline, "describe", compile_first)
    states = heard(session)
    session.start()
    assert session.wait_until_idle(LONG_S)
    pictures = [picture for state, picture in states if state.status.text == "Compiling (first start only)"]
    assert pictures
    assert pictures[0] is not None

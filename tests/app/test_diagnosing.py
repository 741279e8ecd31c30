"""The diagnosis beside the main work of a session."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from app.colors import NO_MATCH, SOURCE_TINT
from app.session import Session
from app.settings import ViewSettings
from cgf.checks import InputError
from tests.app.scenes import LONG_S, SETTINGS, hills, source_of


@pytest.fixture(scope="module")
def diagnosed() -> Iterator[Session]:
    session = Session([source_of(hills())], SETTINGS)
    session.start()
    assert session.wait_until_idle(LONG_S)
    yield session
    session.close()


def test_the_state_has_the_diagnosis_in_short(diagnosed: Session) -> None:
    info = diagnosed.snapshot().diagnosis
    assert info is not None
    whole = diagnosed.diagnosing.plain()
    assert (info.number, info.outcome, info.verdict) == (whole["number"], whole["outcome"], whole["verdict"])
    assert info.problems == sum(finding["severity"] == "problem" for finding in whole["findings"])
    assert whole["is_judged_by_truth"]


def test_what_only_changes_the_picture_is_not_diagnosed_again(diagnosed: Session) -> None:
    before = diagnosed.snapshot().diagnosis
    diagnosed.change({"layout": "overlaid"})
    assert diagnosed.wait_until_idle(LONG_S)
    assert diagnosed.snapshot().diagnosis == before


def test_the_points_of_a_finding_are_highlighted(diagnosed: Session) -> None:
    diagnosed.change({"highlight": "overlap"})
    picture, legend = diagnosed.picture(), diagnosed.snapshot().legend
    assert picture is not None
    assert legend is not None
    assert legend.title == "Highlighted: points with a partner"
    colored = (picture.source.colors == SOURCE_TINT).all(axis=1)
    assert (picture.source.colors[~colored] == NO_MATCH).all()
    overlap = next(finding for finding in diagnosed.diagnosing.plain()["findings"] if finding["kind"] == "overlap")
    assert colored.mean() == pytest.approx(overlap["evidence"][0]["value"], abs=0.02)
    usual = diagnosed.change({"highlight": None}).legend
    assert usual is not None
    assert usual.ramp


def test_a_finding_without_points_highlights_nothing(diagnosed: Session) -> None:
    before = diagnosed.snapshot().legend
    assert diagnosed.change({"highlight": "scale"}).legend == before
    diagnosed.change({"highlight": None})


def test_a_pair_in_two_units_is_explained_and_mended() -> None:
    pair = hills(with_truth=False)
    pair = replace(pair, source=replace(pair.source, points=1000 * pair.source.points))
    session = Session([source_of(pair)], ViewSettings(descriptor="fpfh"))
    with pytest.raises(InputError, match="no diagnosis yet"):
        session.diagnosing.plain()
    session.start()
    assert session.wait_until_idle(LONG_S)
    state = session.snapshot()
    assert state.controls is None
    assert state.diagnosis is not None
    assert "The clouds differ in scale" in state.messages[0].text
    (finding,) = session.diagnosing.plain()["findings"]
    assert finding["changes"] == {"source_scale": 0.001}
    session.change(finding["changes"])
    assert session.wait_until_idle(LONG_S)
    state = session.snapshot()
    assert state.source is not None
    assert state.diagnosis is not None
    assert state.diagnosis.outcome == "registered"
    assert not [message for message in state.messages if message.level == "error"]
    picture = session.picture()
    assert picture is not None
    assert np.isfinite(picture.source.points).all()
    session.close()

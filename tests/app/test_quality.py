"""The quality of features in the viewer: colours, legend, the filter by it, and what is said of a point."""

import io
import json
from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np
import pytest

from app.colors import DISTANCE_TABLE, NO_MATCH, quality_colors
from app.match_file import matches_file
from app.picture import CloudPicture
from app.routes.state import _event
from app.session import Session
from app.settings import Picked, ViewSettings
from tests.app.scenes import LONG_S, hills, source_of
from tests.judging import write_judging

SETTINGS = ViewSettings(model="indoor", support_radius=0.8)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    weights = write_judging(tmp_path_factory.mktemp("weights") / "judging.safetensors")
    session = Session([source_of(hills(), command=("a.ply", "b.ply"))], replace(SETTINGS, weights=weights))
    session.start()
    assert session.wait_until_idle(LONG_S)
    yield session
    session.close()


@pytest.fixture
def session(opened: Session) -> Iterator[Session]:
    """The opened session, put back afterwards as it was."""
    yield opened
    opened.change({"coloring": "error", "surest": None, "picked": None, "descriptor": "cgf"})
    assert opened.wait_until_idle(LONG_S)


def drawn(session: Session) -> CloudPicture:
    picture = session.picture()
    assert picture is not None
    return picture.source


def test_better_features_are_lighter() -> None:
    colors = quality_colors([0.0, 0.5, 1.0, 2.0])
    assert colors[0].tolist() == DISTANCE_TABLE[-1].tolist()
    assert colors[2].tolist() == colors[3].tolist() == DISTANCE_TABLE[0].tolist()
    assert colors[0].sum() < colors[1].sum() < colors[2].sum()


def test_points_and_lines_have_the_colour_of_their_quality(session: Session) -> None:
    snapshot = session.change({"coloring": "quality"})
    analysis = session.shown()[0]
    assert analysis is not None
    assert analysis.source_features is not None
    assert analysis.matches is not None
    expected = np.tile(np.array(NO_MATCH, np.uint8), (len(analysis.source), 1))
    expected[analysis.source_features.indices] = quality_colors(analysis.source_features.quality)
    np.testing.assert_array_equal(drawn(session).colors, expected[analysis.source_shown.prepared_rows])
    picture = session.picture()
    assert picture is not None
    # A line has the colour of the product of both ends' qualities.
    quality = analysis.matches.quality
    assert quality is not None
    assert {*map(tuple, picture.line_colors.tolist())} <= {*map(tuple, quality_colors(quality).tolist())}
    assert snapshot.legend is not None
    assert snapshot.legend.coloring == "quality"
    assert [tick.at for tick in snapshot.legend.ticks] == [float(tick.label) for tick in snapshot.legend.ticks]
    painted = {"#{:02x}{:02x}{:02x}".format(*color) for color in drawn(session).colors.tolist()}
    assert painted <= {*snapshot.legend.ramp, *(swatch.color for swatch in snapshot.legend.swatches)}


def test_without_quality_the_colours_are_others_and_the_page_knows(session: Session) -> None:
    snapshot = session.change({"coloring": "quality"})
    assert snapshot.controls is not None
    assert "quality" in snapshot.controls.colorings
    session.change({"descriptor": "pca"})
    assert session.wait_until_idle(LONG_S)
    snapshot = session.snapshot()
    assert snapshot.controls is not None
    assert snapshot.controls.colorings == ("error", "features", "original", "stage", "distance", "residual")
    assert snapshot.legend is not None
    assert snapshot.legend.coloring == "error"


def test_the_surest_matches_are_a_stage_of_their_own(session: Session) -> None:
    everything = session.snapshot().numbers
    snapshot = session.change({"surest": 0.25, "coloring": "stage"})
    analysis = session.shown()[0]
    assert analysis is not None
    assert analysis.matches is not None
    assert everything is not None
    assert snapshot.numbers is not None
    assert snapshot.numbers.matches == round(0.25 * everything.matches)
    funnel = {step.name: step for step in snapshot.funnel}
    assert funnel["Surest"].count == snapshot.numbers.with_partner
    assert funnel["Surest"].precision == snapshot.numbers.precision
    assert snapshot.legend is not None
    assert "not among the surest" in [swatch.label for swatch in snapshot.legend.swatches]
    assert "--surest 0.25" in snapshot.command
    assert "surest=0.25" in snapshot.shared
    lowest = np.sort(analysis.matches.trust)[-snapshot.numbers.matches]
    exported = np.load(io.BytesIO(matches_file(session, ".npz")))
    assert len(exported["source_quality"]) == len(exported["target_quality"]) == snapshot.numbers.matches
    assert np.count_nonzero(analysis.matches.trust >= lowest) == snapshot.numbers.matches


def test_the_quality_of_a_picked_point_is_said(session: Session) -> None:
    analysis = session.shown()[0]
    assert analysis is not None
    assert analysis.target_features is not None
    assert analysis.target_features.quality is not None
    session.change({"picked": Picked("target", int(analysis.target_features.indices[7]))})
    details = session.point()
    assert details.quality == pytest.approx(float(analysis.target_features.quality[7]))
    assert details.surer == np.mean(analysis.target_features.quality > analysis.target_features.quality[7])


def test_own_weights_do_not_keep_the_state_from_the_page(session: Session) -> None:
    event = _event("state", asdict(session.snapshot()))
    assert json.loads(event.split("data: ")[1])["settings"]["weights"].endswith("judging.safetensors")

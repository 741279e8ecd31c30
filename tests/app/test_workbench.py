"""What panels have done beside the main work: runs, plots, sweeps and comparison, on small hills."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.picture import Picture
from app.plots import Plots, SweepName, separation
from app.poses import PoseRow
from app.session import Session
from app.settings import Bar, Column, ViewSettings
from app.snapshot import Snapshot
from cgf.checks import InputError
from cgf.geometry import transforms
from cgf.pipeline import RegistrationSettings
from tests.app.scenes import LONG_S, SETTINGS, hills, source_of


@pytest.fixture(scope="module")
def opened() -> Iterator[Session]:
    session = Session([source_of(hills()), source_of(hills(with_truth=False))], SETTINGS)
    session.start()
    assert session.wait_until_idle(LONG_S)
    yield session
    session.close()


@pytest.fixture
def session(opened: Session) -> Iterator[Session]:
    """The opened session, put back afterwards as it was, but for the poses found."""
    yield opened
    opened.workbench.choose_estimate("automatic")
    settle(opened, **{name: getattr(SETTINGS, name) for name in SETTINGS.__dataclass_fields__})


def settle(session: Session, **changes: Any) -> Snapshot:
    session.change(changes)
    assert session.wait_until_idle(LONG_S)
    return session.snapshot()


def run(session: Session, start: str | None = None, **wanted: Any) -> PoseRow:
    session.workbench.run(RegistrationSettings(**wanted), start)
    assert session.wait_until_idle(LONG_S)
    return session.workbench.poses()[-1]


def plots_after(session: Session, name: SweepName) -> Plots:
    session.workbench.sweep(name)
    assert session.wait_until_idle(LONG_S)
    return session.workbench.plots()


def picture_of(session: Session) -> Picture:
    picture = session.picture()
    assert picture is not None
    return picture


@pytest.mark.parametrize("method", ["ransac", "fgr"])
def test_a_run_finds_the_pose_and_is_listed_with_its_measures(session: Session, method: str) -> None:
    row = run(session, method=method)
    assert row.found
    assert row.label.endswith(f"{method.upper()}, ICP")
    assert row.rotation_error_deg is not None
    assert row.rotation_error_deg < 2
    assert row.fitness is not None
    assert row.fitness > 0.9
    assert row.elapsed_s is not None
    assert not row.is_estimate


def test_every_pose_is_measured_within_the_same_distance(session: Session) -> None:
    near = run(session, method="fgr", refine=False)
    far = run(session, method="fgr", refine=False, inlier_distance=0.5)
    assert near.fitness is not None
    assert far.fitness is not None
    assert far.fitness <= near.fitness + 0.02
    rows = {row.name: row for row in session.workbench.poses()}
    assert rows["ground_truth"].rotation_error_deg is None
    assert rows["loaded"].fitness is not None
    assert rows["ground_truth"].fitness is not None
    assert rows["loaded"].fitness < rows["ground_truth"].fitness


def test_icp_starts_from_the_pose_that_is_named(session: Session) -> None:
    good, bad = (run(session, start, method="icp", iterations=1) for start in ("ground_truth", "loaded"))
    assert good.label.endswith("ICP, planes, from the truth")
    assert bad.label.endswith("ICP, planes, from as loaded")
    assert good.rotation_error_deg is not None
    assert good.rotation_error_deg < 1
    assert bad.rotation_error_deg is None or bad.rotation_error_deg > 1


def test_a_run_can_stand_for_the_estimate(session: Session) -> None:
    row = run(session, "loaded", method="icp", iterations=1)
    session.workbench.choose_estimate(row.name)
    assert [other.name for other in session.workbench.poses() if other.is_estimate] == [row.name]
    snapshot = settle(session, reference="estimate")
    assert snapshot.estimate is not None
    assert snapshot.estimate.rotation_error_deg == row.rotation_error_deg
    against_run = snapshot.numbers
    session.workbench.choose_estimate("automatic")
    against_automatic = session.snapshot().numbers
    assert against_run is not None
    assert against_automatic is not None
    assert against_run.precision is not None
    assert against_automatic.precision is not None
    assert against_run.precision < against_automatic.precision


def test_runs_of_another_pair_are_not_listed(session: Session) -> None:
    run(session, method="fgr")
    settle(session, pair=1)
    assert [row.name for row in session.workbench.poses()] == ["loaded", "automatic"]


def test_the_oldest_runs_are_forgotten_but_not_the_estimate(session: Session) -> None:
    chosen = run(session, "ground_truth", method="icp", iterations=1)
    session.workbench.choose_estimate(chosen.name)
    for _ in range(13):
        run(session, "ground_truth", method="icp", iterations=1)
    names = [row.name for row in session.workbench.poses() if row.name.startswith("run-")]
    assert len(names) == 12
    assert chosen.name in names


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda bench: bench.run(RegistrationSettings(method="icp"), "run-99999"), "start must be one of"),
        (lambda bench: bench.choose_estimate("run-99999"), "The estimate must be automatic or a run that found a pose"),
        (lambda bench: bench.choose_estimate("loaded"), "The estimate must be automatic or a run that found a pose"),
    ],
)
def test_poses_that_are_not_there_are_refused(session: Session, call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(session.workbench)


def test_a_run_can_be_stopped(session: Session) -> None:
    before = len(session.workbench.poses())
    session.workbench.run(RegistrationSettings(method="ransac", inlier_distance=1e-6), None)
    session.workbench.tasks.cancel("register")
    assert session.wait_until_idle(LONG_S)
    assert len(session.workbench.poses()) == before
    assert session.snapshot().status.tasks == ()


def test_before_there_are_matches_there_is_nothing_to_show() -> None:
    session = Session([source_of(hills())], SETTINGS)
    for call in (session.workbench.poses, session.workbench.plots):
        with pytest.raises(InputError, match="There are no"):
            call()
    with pytest.raises(InputError, match="There are no matches yet"):
        session.workbench.run(RegistrationSettings(), None)
    session.close()


def test_the_source_moves_between_two_poses_without_being_sent_again(session: Session) -> None:
    start = settle(session, layout="overlaid", pose_from="loaded", pose_to="ground_truth", pose_share=0.0)
    assert start.pose == "loaded"
    first = picture_of(session)
    half = settle(session, pose_share=0.5)
    assert half.pose is None
    middle = picture_of(session)
    settle(session, pose_share=1.0)
    last = picture_of(session)
    assert middle.source.points is first.source.points
    assert middle.scene == first.scene == last.scene
    np.testing.assert_allclose(middle.source.position, (first.source.position + last.source.position) / 2)
    turned = [transforms.rigid(picture.source.rotation) for picture in (first, middle, last)]
    whole = transforms.rotation_error_deg(turned[0], turned[2])
    assert transforms.rotation_error_deg(turned[0], turned[1]) == pytest.approx(whole / 2)
    assert settle(session, pose="loaded").settings.pose_from is None


def test_residuals_are_small_where_the_surfaces_meet(session: Session) -> None:
    snapshot = settle(session, coloring="residual", pose="ground_truth")
    assert snapshot.legend is not None
    assert snapshot.legend.scale is not None
    light = tuple(int(snapshot.legend.ramp[0][at : at + 2], 16) for at in (1, 3, 5))
    aligned = picture_of(session).source.colors
    settle(session, pose="loaded")
    apart = picture_of(session).source.colors
    assert np.mean((aligned == light).all(axis=1)) > 0.5
    assert np.mean((apart == light).all(axis=1)) < 0.1


def test_the_error_bars_count_every_match_with_a_partner(session: Session) -> None:
    snapshot, plots = session.snapshot(), session.workbench.plots()
    assert plots.error_bars is not None
    assert snapshot.numbers is not None
    assert sum(plots.error_bars.counts) + plots.error_bars.beyond == snapshot.numbers.with_partner
    assert set(plots.error_bars.colors) <= set(snapshot.legend.ramp if snapshot.legend is not None else ())


def test_the_threshold_decides_which_matches_are_right(session: Session) -> None:
    wide = settle(session, right_within=0.2)
    plots = session.workbench.plots()
    assert wide.numbers is not None
    assert wide.numbers.precision_radius == plots.right_within == 0.2
    assert plots.distance_bars is not None
    assert sum(plots.distance_bars.right) == wide.numbers.right
    assert sum(plots.distance_bars.wrong) == wide.numbers.with_partner - wide.numbers.right
    narrow = settle(session, right_within=0.02)
    assert narrow.numbers is not None
    assert narrow.numbers.right < wide.numbers.right


def test_separation_is_the_share_of_draws_in_which_the_right_one_is_nearer() -> None:
    assert separation(np.float32([1, 2]), np.float32([3, 4])) == 1
    assert separation(np.float32([1, 4]), np.float32([2, 3])) == 0.5
    assert separation(np.float32([2]), np.float32([2])) == 0.5
    assert separation(np.float32([]), np.float32([1])) is None


def test_a_bar_leaves_the_lines_and_colours_of_its_matches(session: Session) -> None:
    plots = session.workbench.plots()
    assert plots.error_bars is not None
    low, high = plots.error_bars.edges[1:3]
    before = picture_of(session)
    snapshot = settle(session, bar=Bar("error", low, high), line_count=5000)
    after = picture_of(session)
    assert len(after.line_points) == plots.error_bars.counts[1]
    assert len(np.unique(after.source.colors, axis=0)) < len(np.unique(before.source.colors, axis=0))
    assert snapshot.legend is not None
    assert "other match" in [swatch.label for swatch in snapshot.legend.swatches]


def test_precision_over_dimensions_is_that_of_each_dimension(session: Session) -> None:
    sweep = plots_after(session, "dim").dims
    values = {point.value: point.precision for point in sweep.points}
    assert None not in values.values()
    assert sweep.current in values
    numbers = settle(session, dim=8).numbers
    assert numbers is not None
    assert numbers.precision == values[8.0]


def test_precision_over_radii_is_known_point_by_point_and_can_be_taken_over(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.plots.RADIUS_FACTORS", (0.5, 0.7))
    before = session.workbench.plots().radii
    assert [point.value for point in before.points if point.precision is not None] == [0.8]
    revisions = {session.revision}
    forget = session.listen(lambda: revisions.add(session.revision))
    sweep = plots_after(session, "radius").radii
    forget()
    assert all(point.precision is not None for point in sweep.points)
    assert len(sweep.points) == 3
    # The state before, and one for each point that appeared.
    assert len(revisions) == 3
    other = sweep.points[1]
    numbers = settle(session, support_radius=other.value).numbers
    assert numbers is not None
    assert numbers.precision == other.precision


def test_compared_columns_have_their_own_errors_at_one_scale(session: Session) -> None:
    alone = picture_of(session)
    columns = (Column("cgf", 32, 0.8), Column("cgf", 8, 0.8), Column("fpfh"))
    snapshot = settle(session, columns=columns)
    assert [column.label for column in snapshot.columns] == ["CGF-32, radius 0.8 m", "CGF-8, radius 0.8 m", "FPFH"]
    assert all(column.is_ready for column in snapshot.columns)
    picture = picture_of(session)
    first, second, third = picture.columns
    assert first.source.points is second.source.points is alone.source.points
    steps = [b.source.position - a.source.position for a, b in ((first, second), (second, third))]
    np.testing.assert_allclose(steps[0], steps[1])
    assert np.linalg.norm(steps[0]) > 0
    assert not np.array_equal(first.source.colors, second.source.colors)
    np.testing.assert_array_equal(first.source.colors, alone.source.colors)
    assert first.target is None
    assert first.label == f"CGF-32, radius 0.8 m: {100 * (snapshot.columns[0].precision or 0):.1f} %"
    legend = settle(session, compare_pair=True, coloring="residual").legend
    assert legend is not None
    assert legend.coloring == "error"
    settle(session, coloring="error")
    assert picture_of(session).columns[0].target is not None
    settle(session, columns=())
    assert picture_of(session).columns == ()
    assert picture_of(session).scene == alone.scene


def test_a_column_that_cannot_be_computed_says_why(session: Session) -> None:
    snapshot = settle(session, columns=(Column("cgf", 5), Column("cgf", 8)))
    assert snapshot.columns[0].problem is not None
    assert "dim" in snapshot.columns[0].problem
    assert snapshot.columns[1].is_ready


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"right_within": -1.0}, "right_within must be positive, got -1"),
        ({"pose_to": "nowhere"}, "pose_to must be the name of a pose, such as loaded or run-1, got nowhere"),
        ({"columns": (Column("cgf"),) * 4}, "columns must be 3 at most, got 4"),
    ],
)
def test_settings_of_the_panels_that_make_no_sense_are_refused(
    session: Session, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        session.change(changes)


def test_what_belongs_to_one_pair_is_not_kept_for_another() -> None:
    settings = replace(ViewSettings(), right_within=0.1, bar=Bar("error", 0, 1), pose_from="loaded", pose_to="run-1")
    other = settings.changed({"pair": 1}, pairs=2)
    assert (other.right_within, other.bar, other.pose_from, other.pose_to) == (None, None, None, None)

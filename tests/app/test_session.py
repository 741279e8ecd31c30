"""The session alone, on hills small enough that every stage is quick."""

import csv
import io
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from app.match_file import matches_file
from app.pair_source import PairSource
from app.picture import Picture
from app.session import Session
from app.snapshot import Snapshot
from cgf import pipeline
from cgf.checks import InputError
from cgf.evaluation.matches import export_matches, match_errors
from cgf.types import Pair
from tests.app.scenes import LONG_S, SETTINGS, hills, run, source_of, strangers


def settle(session: Session, **changes: object) -> Snapshot:
    session.change(changes)
    assert session.wait_until_idle(LONG_S)
    return session.snapshot()


def picture_of(session: Session) -> Picture:
    picture = session.picture()
    assert picture is not None
    return picture


@pytest.fixture(scope="module")
def opened() -> Iterator[Session]:
    session = Session([source_of(hills(), command=("a.ply", "b.ply"))], SETTINGS)
    snapshot = run(session)
    assert snapshot.settled, snapshot.messages
    yield session
    session.close()


@pytest.fixture
def session(opened: Session) -> Iterator[Session]:
    """The opened session, put back afterwards as it was."""
    yield opened
    settle(opened, **{name: getattr(SETTINGS, name) for name in SETTINGS.__dataclass_fields__})


def test_a_session_ends_with_matches_measured_against_the_truth(session: Session) -> None:
    snapshot = session.snapshot()
    assert snapshot.status.phase == "ready"
    assert snapshot.reference == "ground_truth"
    assert snapshot.pose == "ground_truth"
    assert snapshot.numbers is not None
    assert snapshot.numbers.precision is not None
    assert snapshot.numbers.precision > 0.5
    assert snapshot.estimate is not None
    assert snapshot.estimate.rotation_error_deg is not None
    assert snapshot.estimate.rotation_error_deg < 2


def test_the_numbers_are_those_of_the_pipeline(session: Session) -> None:
    pair = hills()
    result = pipeline.run_pair(pair.source, pair.target, SETTINGS.pair_settings())
    measured = match_errors(
        result.source,
        result.target,
        result.table,
        target_from_source=pair.target_from_source,
        tau=result.settings.tau,
    )
    judged = measured.errors[measured.has_partner]
    numbers = session.snapshot().numbers
    assert numbers is not None
    assert numbers.matches == len(result.table)
    assert numbers.with_partner == len(judged)
    assert numbers.right == np.count_nonzero(judged <= result.settings.precision_radius)


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_exported_matches_are_those_of_the_command_to_the_last_digit(
    session: Session, suffix: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    settle(session, mutual=True, max_ratio=0.98)
    pair = hills()
    settings = replace(SETTINGS, mutual=True, max_ratio=0.98).pair_settings()
    result = pipeline.run_pair(pair.source, pair.target, settings)
    measured = match_errors(
        result.source,
        result.target,
        result.table,
        target_from_source=pair.target_from_source,
        tau=result.settings.tau,
    )
    path = tmp_path_factory.mktemp("export") / f"matches{suffix}"
    export_matches(path, result.source, result.target, result.table, result.rows, measured)
    exported = matches_file(session, suffix)
    if suffix == ".csv":
        assert exported == path.read_bytes()
        assert len(list(csv.reader(io.StringIO(exported.decode())))) == 1 + len(result.rows)
    else:
        ours, theirs = np.load(io.BytesIO(exported)), np.load(path)
        assert ours.files == theirs.files
        for name in ours.files:
            np.testing.assert_array_equal(ours[name], theirs[name])


def test_without_truth_errors_are_relative_to_an_estimate() -> None:
    session = Session([source_of(hills(with_truth=False))], SETTINGS)
    snapshot = run(session)
    session.close()
    assert snapshot.reference == "estimate"
    assert snapshot.pose == "estimate"
    assert "No ground truth: errors are relative to the estimate." in [message.text for message in snapshot.messages]
    assert snapshot.controls is not None
    assert "ground_truth" not in snapshot.controls.poses
    assert snapshot.numbers is not None
    assert snapshot.numbers.precision is not None
    assert snapshot.numbers.precision > 0.5


def test_a_pose_brought_along_is_shown_and_not_computed_again() -> None:
    pair = hills()
    assert pair.target_from_source is not None
    wrong = pair.target_from_source.copy()
    wrong[:3, 3] += [0.5, 0.0, 0.0]
    session = Session([source_of(pair)], SETTINGS, given_estimate=wrong)
    snapshot = run(session)
    session.close()
    assert snapshot.reference == "ground_truth"
    assert snapshot.estimate is not None
    assert snapshot.estimate.given
    assert snapshot.estimate.translation_error == pytest.approx(0.5)


def test_errors_can_be_measured_against_the_estimate_instead(session: Session) -> None:
    against_truth = session.snapshot()
    against_estimate = settle(session, reference="estimate")
    assert against_estimate.reference == "estimate"
    assert against_truth.curve is not None
    assert against_estimate.curve is not None
    assert against_estimate.curve.precision != against_truth.curve.precision


def test_clouds_that_do_not_overlap_are_reported() -> None:
    session = Session([source_of(strangers())], SETTINGS)
    snapshot = run(session)
    session.close()
    assert any(
        message.level == "warning" and message.text.startswith("Under the ground truth the clouds do not overlap")
        for message in snapshot.messages
    )


class Counted:
    """Counts how often a stage is computed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[str] = []
        for name in ("prepare", "describe", "match_both_features", "register_pair"):
            for module in (pipeline, pipeline.cache):
                if hasattr(module, name):
                    monkeypatch.setattr(module, name, self._counting(name, getattr(module, name)))

    def _counting(self, name: str, function: Callable[..., object]) -> Callable[..., object]:
        def counted(*arguments: object, **named: object) -> object:
            self.calls.append(name)
            return function(*arguments, **named)

        return counted


@pytest.mark.parametrize(
    "changes",
    [
        {"coloring": "features"},
        {"layout": "overlaid"},
        {"pose": "loaded"},
        {"point_size": 2.0},
        {"line_count": 10, "line_choice": "worst"},
        {"error_scale": 0.1},
        {"reference": "estimate"},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_what_is_only_drawn_otherwise_computes_nothing(
    session: Session, changes: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    before = session.picture()
    snapshot = session.change(changes)
    assert counted.calls == []
    assert snapshot.settled
    assert session.picture() is not before


def test_filters_only_estimate_the_pose_again(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Counted(monkeypatch)
    snapshot = settle(session, mutual=True, max_ratio=0.97)
    assert counted.calls == ["register_pair"]
    assert snapshot.numbers is not None
    assert snapshot.funnel[-2].name == "Ratio"
    assert snapshot.funnel[-2].count == snapshot.numbers.with_partner


def test_another_dimension_matches_prefixes_of_the_same_features(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    snapshot = settle(session, dim=16)
    assert counted.calls == ["match_both_features", "register_pair"]
    assert snapshot.controls is not None
    assert snapshot.controls.dim == 16


def test_going_back_to_earlier_settings_computes_nothing(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(session, dim=8, mutual=True)
    counted = Counted(monkeypatch)
    settle(session, dim=None, mutual=False)
    settle(session, dim=8, mutual=True)
    assert counted.calls == []


def test_recolouring_keeps_the_points_as_they_were_sent(session: Session) -> None:
    before = picture_of(session)
    session.change({"coloring": "features", "layout": "overlaid", "pose": "loaded"})
    after = picture_of(session)
    assert after.source.points is before.source.points
    assert after.target.points is before.target.points
    assert not np.array_equal(after.source.colors, before.source.colors)
    assert not np.array_equal(after.source.position, before.source.position)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"support_radius": 0.001}, r"^Support radius must be above the point spacing"),
        ({"support_radius": 50.0}, r"^Support radius must be at most the diameter of the clouds"),
        ({"lrf_radius": 0.001}, r"^Frame radius must be above the point spacing"),
        ({"voxel_size": 0.9}, r"^(Voxel size|Support radius) must be"),
        ({"dim": 5}, r"^Dimensions must be one of"),
        ({"descriptor": "sift"}, r"^Descriptor must be one of"),
        ({"coloring": "rainbow"}, r"^coloring must be one of error, .*, got rainbow$"),
        ({"pair": 3}, r"^pair must be from 0 to 0, got 3$"),
        ({"error_scale": -1.0}, r"^error_scale must be positive, got -1$"),
        ({"colour": "error"}, r"^settings must be known, got colour$"),
    ],
    ids=lambda value: next(iter(value.items())).__repr__() if isinstance(value, dict) else "",
)
def test_a_setting_that_cannot_be_used_changes_nothing(
    session: Session, changes: dict[str, object], message: str
) -> None:
    before = session.snapshot()
    with pytest.raises(ValueError, match=message):
        session.change(changes)
    assert session.snapshot() == before


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (InputError("--voxel must leave 10 points or more, got 3"), "Voxel size must leave 10 points or more, got 3"),
        (MemoryError("no"), "MemoryError: no; start cgf-viewer with --debug to see where."),
    ],
    ids=["input", "unexpected"],
)
def test_what_fails_only_in_the_computation_keeps_the_last_good_result(
    session: Session, error: Exception, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    before = session.snapshot()
    monkeypatch.setattr(pipeline, "prepare", fail)
    failed = settle(session, voxel_size=0.13)
    assert failed.status.phase == "failed"
    assert [(message.level, message.text) for message in failed.messages[:1]] == [("error", text)]
    assert failed.numbers == before.numbers
    assert not failed.settled
    monkeypatch.undo()
    assert settle(session, voxel_size=None).settled


def test_numbers_that_cannot_be_drawn_are_clamped(session: Session) -> None:
    settings = session.change({"line_count": 10**6, "point_size": 99.0}).settings
    assert settings.line_count == 5_000
    assert settings.point_size == 4.0


def test_a_first_pair_that_cannot_be_loaded_is_a_message() -> None:
    def fail() -> Pair:
        raise InputError("a.ply must hold points, got an empty file; check the export")

    session = Session([PairSource("broken", fail)], SETTINGS)
    snapshot = run(session)
    session.close()
    assert snapshot.status.phase == "failed"
    assert [message.text for message in snapshot.messages] == [
        "a.ply must hold points, got an empty file; check the export"
    ]


def test_another_pair_takes_its_own_lengths() -> None:
    session = Session([source_of(hills()), source_of(hills(with_truth=False))], SETTINGS)
    run(session)
    snapshot = settle(session, pair=1)
    session.close()
    assert snapshot.settings.support_radius is None
    assert snapshot.reference == "estimate"


def test_listeners_hear_of_every_change_until_they_leave(session: Session) -> None:
    heard = threading.Event()
    forget = session.listen(heard.set)
    session.change({"line_count": 20})
    assert heard.is_set()
    forget()
    heard.clear()
    session.change({"line_count": 30})
    assert not heard.is_set()


def test_a_new_request_cancels_the_old_one(session: Session) -> None:
    for radius in (0.7, 0.75, 0.85, 0.9):
        session.change({"support_radius": radius})
    assert session.wait_until_idle(LONG_S)
    snapshot = session.snapshot()
    assert snapshot.settled
    assert snapshot.settings.support_radius == 0.9


def test_stopping_keeps_what_is_shown() -> None:
    loading, go_on = threading.Event(), threading.Event()

    def load() -> Pair:
        loading.set()
        assert go_on.wait(LONG_S)
        return hills()

    session = Session([PairSource("slow", load)], SETTINGS)
    session.start()
    assert loading.wait(LONG_S)
    session.cancel()
    go_on.set()
    assert session.wait_until_idle(LONG_S)
    snapshot = session.snapshot()
    session.close()
    assert snapshot.status.text == "Stopped"
    assert snapshot.numbers is None


def test_the_command_writes_the_matches_shown(session: Session) -> None:
    snapshot = settle(session, dim=16, mutual=True, max_ratio=0.9, voxel_size=0.05)
    assert snapshot.command == (
        "cgf match a.ply b.ply --descriptor cgf --dim 16 --radius 0.8 --voxel 0.05 --ratio 0.9 --mutual -o matches.csv"
    )


def test_the_legend_is_painted_by_the_function_that_painted_the_points(session: Session) -> None:
    legend = session.snapshot().legend
    assert legend is not None
    painted = {"#{:02x}{:02x}{:02x}".format(*color) for color in picture_of(session).source.colors.tolist()}
    assert painted <= {*legend.ramp, *(swatch.color for swatch in legend.swatches)}
    assert legend.ramp[0] != legend.ramp[-1] == "#000000"
    assert legend.scale == pytest.approx(0.25)

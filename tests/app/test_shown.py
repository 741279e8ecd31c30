"""Which points are drawn, and whose colours they borrow."""

from dataclasses import replace

import numpy as np
import pytest

from app.analysis import Analysis
from app.picture import draw
from app.placing import place
from app.session import Session
from app.settings import ViewSettings
from app.shown import choose_shown, thinned_rows
from cgf.geometry.sampling import voxel_downsample
from cgf.pipeline import PairSettings, describe, prepare, resolve
from cgf.types import PointCloud
from tests.app.scenes import bumpy_cloud, hills, source_of


def test_every_loaded_point_is_shown_and_borrows_from_the_nearest_prepared_one() -> None:
    loaded = bumpy_cloud(side=40)
    prepared = voxel_downsample(loaded, 0.3)
    shown = choose_shown(loaded, prepared)
    assert shown.cloud is loaded
    distances = np.linalg.norm(loaded.points[:, None] - prepared.points[None], axis=2)
    np.testing.assert_array_equal(shown.prepared_rows, distances.argmin(axis=1))


@pytest.mark.parametrize("limit", [200, 900])
def test_a_cloud_of_too_many_points_is_thinned_evenly(limit: int) -> None:
    # Half of the square has ten times as many points.
    rng = np.random.default_rng(0)
    sparse, dense = rng.uniform(0, 1, size=(2_000, 3)), rng.uniform(0, 1, size=(20_000, 3)) - [1, 0, 0]
    loaded = PointCloud(np.concatenate([sparse, dense]) * [1, 1, 0])
    shown = choose_shown(loaded, loaded, limit=limit)
    assert limit / 2 < len(shown.cloud) <= limit
    left = np.count_nonzero(shown.cloud.points[:, 0] < 0)
    assert 0.4 < left / len(shown.cloud) < 0.65
    np.testing.assert_array_equal(loaded.points[shown.prepared_rows], shown.cloud.points)
    assert shown.spacing == pytest.approx(np.sqrt(2 / len(shown.cloud)), rel=0.3)


def test_an_edge_found_on_a_part_of_many_points_suits_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    # A few thousand are many here: one half of the wavy square has ten times as many points as the other.
    monkeypatch.setattr("app.shown._SAMPLED", 5_000)
    monkeypatch.setattr("app.shown._CELL", 4)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 1, size=(5_000, 3)), rng.uniform(0, 1, size=(50_000, 3)) - [1, 0, 0]])
    points[:, 2] = 0.1 * np.sin(9 * points[:, 0])
    rows = thinned_rows(points, limit=2_000)
    # So few voxels a cell have many at its border, which count twice.
    assert 1_200 < len(rows) <= 2_000
    assert 0.4 < np.count_nonzero(points[rows, 0] < 0) / len(rows) < 0.6


def test_repeated_points_are_thinned_to_one_of_each() -> None:
    assert thinned_rows(np.ones((50, 3)), limit=10).tolist() == [0]
    assert thinned_rows(np.repeat(np.eye(3), 20, axis=0), limit=10).tolist() == [0, 20, 40]


def test_points_between_described_ones_have_their_colours() -> None:
    pair = hills()
    resolved = resolve(PairSettings(voxel_size=0.3, support_radius=1.0), pair.source, pair.target)
    source, target = prepare(pair.source, resolved), prepare(pair.target, resolved)
    shown = choose_shown(pair.source, source), choose_shown(pair.target, target)
    analysis = Analysis(0, pair, resolved, source, target, *shown)
    features = describe(source, resolved), describe(target, resolved)
    described = replace(analysis, source_features=features[0], target_features=features[1])
    placed = place(analysis)
    before = draw(analysis, None, ViewSettings(coloring="features"), placed)
    after = draw(described, None, ViewSettings(coloring="features"), placed)
    for cloud, loaded, prepared in ((after.source, pair.source, source), (after.target, pair.target, target)):
        assert len(cloud.points) == len(cloud.colors) == len(loaded) > 3 * len(prepared)
        colors_of_row = np.zeros((len(prepared), 3), np.uint8)
        colors_of_row[cloud.prepared_rows] = cloud.colors
        np.testing.assert_array_equal(cloud.colors, colors_of_row[cloud.prepared_rows])
        assert len(np.unique(colors_of_row, axis=0)) > len(prepared) / 2
    assert after.source.points is before.source.points
    assert not np.array_equal(after.source.colors, before.source.colors)


def test_no_more_points_are_drawn_than_asked_for_and_the_page_knows() -> None:
    pair = hills()
    session = Session([source_of(pair)], ViewSettings(support_radius=0.8), max_shown=300)
    session.start()
    assert session.wait_until_idle(120.0)
    snapshot, picture = session.snapshot(), session.picture()
    session.close()
    assert snapshot.source is not None
    assert picture is not None
    assert snapshot.source.points == len(pair.source)
    assert 150 < snapshot.source.shown == len(picture.source.points) <= 300
    assert snapshot.source.prepared == snapshot.source.features == len(pair.source)

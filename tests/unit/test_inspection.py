from dataclasses import replace

import numpy as np
import pytest

from cgf.descriptors.network import load_network
from cgf.descriptors.spherical_histogram import histogram_grid
from cgf.evaluation.metrics import has_partner
from cgf.geometry import transforms
from cgf.geometry.lrf import estimate_lrf
from cgf.matching import MatchTable
from cgf.pipeline import (
    REJECTIONS,
    PairResult,
    PairSettings,
    best_turn,
    far_modes,
    inspect_point,
    rejections,
    run_pair,
    shell_edges,
)
from cgf.pipeline.inspection import Side
from cgf.types import Correspondences, Features, PointCloud

TRUTH = transforms.rigid(transforms.rotation_about([0.3, -1.0, 0.5], 0.8), [0.5, -0.2, 1.0])
SETTINGS = PairSettings(support_radius=0.6, lrf_radius=0.25, voxel_size=0.0)


def hilly(count: int, seed: int) -> PointCloud:
    x, y = np.random.default_rng(seed).uniform(-1.5, 1.5, size=(2, count))
    points = np.column_stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y) + 0.2 * np.sin(5 * y + x)])
    return PointCloud(points, name=f"hills {seed}", viewpoint=np.array([0.0, 0.0, 10.0]))


@pytest.fixture(scope="module")
def result() -> PairResult:
    """Two scans of one surface, the source moved and with a point far from all others."""
    stray = np.array([[0.0, 0.0, 4.0]])
    source = hilly(700, 0)
    source = transforms.move(transforms.invert(TRUTH), replace(source, points=np.concatenate([source.points, stray])))
    return run_pair(source, hilly(800, 1), SETTINGS)


@pytest.mark.parametrize(("side", "row"), [("source", 5), ("source", 400), ("target", 17)])
def test_an_inspection_agrees_with_brute_force(result: PairResult, side: Side, row: int) -> None:
    found = inspect_point(result, row, side=side, target_from_source=TRUTH, count=6)
    own, other = (result.source, result.target) if side == "source" else (result.target, result.source)
    own_features, other_features = (
        (result.source_features, result.target_features)
        if side == "source"
        else (result.target_features, result.source_features)
    )
    vector = own_features.vectors[list(own_features.indices).index(row)].astype(float)
    distances = {
        int(index): float(np.linalg.norm(vector - other_vector))
        for index, other_vector in zip(other_features.indices, other_features.vectors, strict=True)
    }
    ranking = sorted(distances, key=lambda index: (np.float32(distances[index]), index))
    assert found.nearest.tolist() == ranking[:6]
    for index, distance in enumerate(found.distances):
        assert distance == pytest.approx(distances.get(index, np.nan), rel=1e-6, nan_ok=True)
    assert found.own_distances[row] == 0
    pose = TRUTH if side == "source" else transforms.invert(TRUTH)
    gaps = np.linalg.norm(other.points - transforms.apply(pose, own.points[row][None]), axis=1)
    np.testing.assert_allclose(found.errors, gaps[ranking[:6]])
    assert found.partner_gap == pytest.approx(gaps.min())
    assert (found.partner is not None) == (gaps.min() <= result.settings.tau) == (row != 5)
    if found.partner is not None:
        assert found.partner.row == gaps.argmin()
        assert found.partner_rank == ranking.index(found.partner.row) + 1


def test_the_nearest_is_the_match_of_the_table(result: PairResult) -> None:
    for place in range(0, len(result.table), 97):
        row, match = result.table.correspondences.indices[place]
        found = inspect_point(result, int(row))
        assert found.nearest[0] == match
        assert found.distances[match] == pytest.approx(result.table.correspondences.distances[place], rel=1e-6)
        assert found.distances[found.nearest[0]] / found.distances[found.nearest[1]] == pytest.approx(
            result.table.correspondences.ratios[place], rel=1e-5
        )


def test_frame_and_histogram_are_those_of_the_descriptor(result: PairResult) -> None:
    cloud, settings = result.target, result.settings
    assert cloud.normals is not None
    found = inspect_point(result, 7, side="target").point
    frame, _ = estimate_lrf(cloud.points, cloud.normals, np.array([7]), radius=settings.lrf_radius)
    np.testing.assert_array_equal(found.frame, frame[0])
    grid = histogram_grid(cloud.points, support_radius=settings.support_radius, min_radius=settings.min_radius)
    card = load_network("cgf", settings.model).card
    expected, counts = grid.histograms(cloud.points[[7]], frame, soft=card.soft)
    assert found.histogram is not None
    np.testing.assert_array_equal(found.histogram.ravel(), expected[0])
    assert found.neighbors == counts[0]


def test_the_axes_of_the_histogram_are_azimuth_elevation_and_shell(result: PairResult) -> None:
    cloud, settings = result.target, result.settings
    found = inspect_point(result, 7, side="target").point
    assert found.frame is not None
    assert found.histogram is not None
    offsets = (np.delete(cloud.points, 7, axis=0) - cloud.points[7]) @ found.frame.T
    lengths = np.linalg.norm(offsets, axis=1)
    offsets, lengths = offsets[lengths <= settings.support_radius], lengths[lengths <= settings.support_radius]
    share = found.histogram.sum()
    assert share == pytest.approx(1, abs=1e-5)
    shells, _ = np.histogram(lengths, shell_edges(settings))
    np.testing.assert_allclose(found.histogram.sum(axis=(0, 1)), shells / len(lengths), atol=1e-5)
    # Ring 0 holds what lies around +z.
    upper = np.mean(offsets[:, 2] / lengths > np.cos(5 * np.pi / 11))
    assert found.histogram[:, :5].sum() == pytest.approx(upper, abs=1e-5)
    # The first sector begins at -x and turns towards -y; neighbours near an edge may count in both sectors beside it.
    assert found.histogram[:6].sum() == pytest.approx(np.mean(offsets[:, 1] < 0), abs=0.05)
    quarter = np.mean((offsets[:, 1] < 0) & (offsets[:, 0] < 0))
    assert found.histogram[:3].sum() == pytest.approx(quarter, abs=0.05)


def test_without_a_pose_nothing_is_said_of_errors_and_partner(result: PairResult) -> None:
    found = inspect_point(result, 5)
    assert np.isnan(found.errors).all()
    assert found.partner is None
    assert found.partner_rank is None
    assert found.match is not None


def test_a_point_without_a_frame_has_no_match_but_a_true_place(result: PairResult) -> None:
    stray = len(result.source) - 1
    assert stray not in result.source_features.indices
    found = inspect_point(result, stray, target_from_source=TRUTH)
    assert found.point.frame is None
    assert found.point.histogram is None
    assert found.match is None
    assert found.nearest.shape == (0,)
    assert np.isnan(found.distances).all()
    assert found.modes.shape == (0,)


@pytest.mark.parametrize("row", [-1, 10_000])
def test_a_row_that_does_not_exist_is_refused(result: PairResult, row: int) -> None:
    with pytest.raises(ValueError, match=f"row must be from 0 to {len(result.source) - 1} for the source, got {row}"):
        inspect_point(result, row)


def test_an_inspection_lists_at_least_the_match(result: PairResult) -> None:
    with pytest.raises(ValueError, match="count must be 1 or more, got 0"):
        inspect_point(result, 0, count=0)


def test_far_modes_are_places_apart_that_look_alike() -> None:
    points = np.zeros((8, 3))
    points[:, 0] = [0.0, 0.1, 5.0, 5.1, 10.0, 10.1, 20.0, 30.0]
    distances = np.array([1.0, 1.02, 1.05, 1.03, 1.3, 1.2, np.nan, 1.1], dtype=np.float32)
    assert far_modes(points, distances, apart=1.0).tolist() == [0, 3, 7]
    assert far_modes(points, distances, apart=7.0).tolist() == [0, 7]
    assert far_modes(points, np.full(8, np.nan, dtype=np.float32), apart=1.0).shape == (0,)


def test_the_best_turn_undoes_a_turn() -> None:
    histogram = np.random.default_rng(0).random((12, 11, 17)).astype(np.float32)
    assert best_turn(histogram, np.roll(histogram, 5, axis=0)) == 7
    assert best_turn(histogram, histogram) == 0


def table_of(ratios: list[float], mutual: list[bool]) -> MatchTable:
    count = len(ratios)
    indices = np.column_stack([np.arange(1, count + 1), np.arange(count)])
    return MatchTable(
        Correspondences(indices, *np.array([ratios, ratios], dtype=np.float32)),
        np.array(mutual),
    )


def test_each_point_is_rejected_by_the_first_stage_that_it_fails(result: PairResult) -> None:
    # Row 0 is alone, row 7 has a frame but no feature, rows 1 to 6 fail one stage after the other.
    near = hilly(400, 3)
    assert near.normals is None
    cloud = replace(
        near, points=np.concatenate([[[0.0, 0.0, 9.0]], near.points[:399]]), normals=np.tile([0.0, 0.0, 1.0], (400, 1))
    )
    features = Features(np.arange(1, 7), np.zeros((6, 32), dtype=np.float32), "cgf")
    table = table_of([1.0, 1.0, 0.95, 0.85, 0.5, 0.5], [False, False, True, True, True, True])
    codes = rejections(
        cloud, features, table, result.settings,
        has_partner=np.arange(400) != 1, is_inlier=np.array([True, True, True, True, False, True]), mutual=True,
        max_ratio=0.9, surest=1 / 3,
    )  # fmt: skip
    expected = ["no_frame", "no_partner", "not_mutual", "above_ratio", "unsure", "outlier", "none", "no_feature"]
    assert [REJECTIONS[code] for code in codes[:8]] == expected
    unfiltered = rejections(cloud, features, table, result.settings)
    assert [REJECTIONS[code] for code in unfiltered[:8]] == ["no_frame", *["none"] * 6, "no_feature"]


def test_points_that_are_not_rejected_are_the_matches_that_pass(result: PairResult) -> None:
    partner = has_partner(result.source.points, result.target.points, TRUTH, tau=result.settings.tau)
    codes = rejections(
        result.source, result.source_features, result.table, result.settings, has_partner=partner, mutual=True
    )
    table = result.table
    passing = table.correspondences.indices[table.mutual, 0]
    assert np.flatnonzero(codes == REJECTIONS.index("none")).tolist() == sorted(passing[partner[passing]].tolist())
    assert codes[-1] == REJECTIONS.index("no_frame")

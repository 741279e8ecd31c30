import re
from dataclasses import replace

import numpy as np
import pytest

from cgf.matching import MatchTable, filter_rows, match, match_both, nearest
from cgf.matching.ranking import RANKINGS, surest_rows, trust
from cgf.matching.search import BLOCK
from cgf.matching.tiles import LANES, ROWS
from cgf.types import Cancelled, Correspondences, Features


def features(vectors: np.ndarray, *, descriptor: str = "cgf", indices: np.ndarray | None = None) -> Features:
    rows = np.arange(len(vectors)) if indices is None else indices
    return Features(rows, np.asarray(vectors, dtype=np.float32), descriptor)


def unit_vectors(rng: np.random.Generator, count: int, dim: int = 32) -> np.ndarray:
    vectors = rng.normal(size=(count, dim)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def sq_distances(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """All squared distances in float64, summed term by term as the search does, so that ties are the same."""
    sq = np.zeros((len(source), len(target)))
    for a, b in zip(source.astype(np.float64).T, target.astype(np.float64).T, strict=True):
        sq += np.square(a[:, None] - b)
    return sq


def assert_brute_force_agrees(source: np.ndarray, target: np.ndarray) -> None:
    forward, back = match_both(features(source), features(target))
    sq = sq_distances(source, target)
    assert_agrees(forward, sq)
    assert_agrees(back, sq.T)


def assert_agrees(table: MatchTable, sq: np.ndarray) -> None:
    first, back = sq.argmin(axis=1), sq.argmin(axis=0)
    smallest = np.sqrt(np.partition(sq, 1, axis=1)[:, :2])
    np.testing.assert_array_equal(table.correspondences.indices, np.column_stack([np.arange(len(sq)), first]))
    np.testing.assert_array_equal(table.correspondences.distances, smallest[:, 0].astype(np.float32))
    np.testing.assert_array_equal(table.mutual, back[first] == np.arange(len(sq)))
    ratios = np.divide(smallest[:, 0], smallest[:, 1], out=np.ones(len(sq)), where=smallest[:, 1] > 0)
    np.testing.assert_array_equal(table.correspondences.ratios, ratios.astype(np.float32))


@pytest.mark.parametrize(
    ("sources", "targets"), [(2, 2), (ROWS, LANES), (ROWS + 1, LANES + 1), (BLOCK + 1, 2049), (2 * BLOCK + 5, 4500)]
)
def test_matches_are_those_of_brute_force_across_tile_borders(sources: int, targets: int) -> None:
    rng = np.random.default_rng(sources)
    assert_brute_force_agrees(unit_vectors(rng, sources), unit_vectors(rng, targets))


@pytest.mark.parametrize("dim", [*range(1, 65), 125, 352])
def test_matches_are_those_of_brute_force_in_any_dimension(dim: int) -> None:
    rng = np.random.default_rng(dim)
    assert_brute_force_agrees(unit_vectors(rng, 70, dim), unit_vectors(rng, 90, dim))


@pytest.mark.parametrize(("sources", "targets"), [(1, 1), (1, 40), (40, 1)])
def test_matches_are_exact_where_a_cloud_has_one_feature(sources: int, targets: int) -> None:
    rng = np.random.default_rng(8)
    table = match(features(unit_vectors(rng, sources)), features(unit_vectors(rng, targets)))
    rng = np.random.default_rng(8)
    sq = sq_distances(unit_vectors(rng, sources), unit_vectors(rng, targets))
    np.testing.assert_array_equal(table.correspondences.indices[:, 1], sq.argmin(axis=1))
    np.testing.assert_array_equal(table.mutual, sq.argmin(axis=0)[sq.argmin(axis=1)] == np.arange(sources))
    assert targets > 1 or not table.correspondences.ratios.any()


@pytest.mark.parametrize("threads", ["1", "2", "5"])
def test_matches_do_not_depend_on_the_number_of_threads(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CGF_THREADS", threads)
    rng = np.random.default_rng(9)
    # Equal features in different blocks of the source: each target's nearest is the first of them.
    some = unit_vectors(rng, 2 * BLOCK)
    assert_brute_force_agrees(np.concatenate([some, some, some[:7]]), unit_vectors(rng, 300))


def test_matches_are_exact_where_every_feature_comes_twice() -> None:
    rng = np.random.default_rng(10)
    source, target = unit_vectors(rng, 300), unit_vectors(rng, 200)
    assert_brute_force_agrees(np.concatenate([source, source]), np.concatenate([target, target]))
    assert_brute_force_agrees(np.repeat(source, 2, axis=0), np.repeat(source, 2, axis=0))


def test_matches_do_not_change_when_features_are_a_view() -> None:
    rng = np.random.default_rng(11)
    wide, target = unit_vectors(rng, 80, 24), unit_vectors(rng, 60, 12)
    assert_brute_force_agrees(wide[:, ::2], target)


@pytest.mark.parametrize(("scale", "offset"), [(1e-18, 0.0), (1e15, 0.0), (1.0, 1e3), (200.0, 200.0)])
def test_matches_are_exact_at_any_scale_and_offset(scale: float, offset: float) -> None:
    rng = np.random.default_rng(3)
    source, target = (scale * unit_vectors(rng, count, 8) + offset for count in (300, 400))
    assert_brute_force_agrees(source.astype(np.float32), target.astype(np.float32))


def test_matches_are_exact_among_repeated_features() -> None:
    rng = np.random.default_rng(4)
    assert_brute_force_agrees(
        rng.integers(0, 2, size=(600, 4)).astype(np.float32), rng.integers(0, 2, size=(700, 4)).astype(np.float32)
    )


def test_matches_are_exact_when_all_features_are_equal() -> None:
    assert_brute_force_agrees(np.ones((200, 5), dtype=np.float32), np.ones((300, 5), dtype=np.float32))


def test_matches_are_exact_where_float32_cannot_tell_distances_apart() -> None:
    rng = np.random.default_rng(5)
    base = unit_vectors(rng, 1)
    nearly = [base + 1e-6 * rng.normal(size=(count, 32)).astype(np.float32) for count in (100, 120)]
    assert_brute_force_agrees(*nearly)


def test_ties_go_to_the_lower_row() -> None:
    table = match(features([[0.0], [0.0]]), features([[1.0], [-1.0], [1.0]]))
    np.testing.assert_array_equal(table.correspondences.indices, [[0, 0], [1, 0]])
    np.testing.assert_array_equal(table.mutual, [True, False])
    np.testing.assert_array_equal(table.correspondences.ratios, [1, 1])


def test_rows_are_those_of_the_clouds() -> None:
    source = features([[0.0], [5.0]], indices=np.array([3, 9]))
    target = features([[5.1], [0.1]], indices=np.array([20, 40]))
    table = match(source, target)
    np.testing.assert_array_equal(table.correspondences.indices, [[3, 40], [9, 20]])


def test_one_target_has_no_second_nearest_and_ratio_zero() -> None:
    table = match(features([[0.0], [3.0]]), features([[1.0]]))
    np.testing.assert_array_equal(table.correspondences.ratios, [0, 0])
    np.testing.assert_array_equal(table.correspondences.distances, [1, 2])


def test_the_ratio_is_one_where_the_two_nearest_are_equal_to_the_feature() -> None:
    np.testing.assert_array_equal(match(features([[2.0]]), features([[2.0], [2.0]])).correspondences.ratios, [1])


@pytest.mark.parametrize(("sources", "targets"), [(0, 3), (3, 0), (0, 0)])
def test_nothing_matches_nothing(sources: int, targets: int) -> None:
    table = match(features(np.zeros((sources, 4))), features(np.zeros((targets, 4))))
    assert len(table) == 0
    assert table.correspondences.indices.shape == (0, 2)
    assert table.mutual.shape == (0,)
    assert filter_rows(table, mutual=True, max_ratio=0.5, surest=0.5).shape == (0,)


def some_table() -> MatchTable:
    correspondences = Correspondences(
        np.array([[0, 5], [1, 6], [2, 7]]),
        np.array([0.1, 0.2, 0.3], dtype=np.float32),
        np.array([0.5, 0.8, 0.9], dtype=np.float32),
    )
    return MatchTable(correspondences, np.array([True, False, True]))


@pytest.mark.parametrize(
    ("mutual", "max_ratio", "rows"),
    [(False, None, [0, 1, 2]), (True, None, [0, 2]), (False, 0.8, [0, 1]), (True, 0.8, [0]), (False, 0.1, [])],
)
def test_filters_keep_what_passes_each(mutual: bool, max_ratio: float | None, rows: list[int]) -> None:
    np.testing.assert_array_equal(filter_rows(some_table(), mutual=mutual, max_ratio=max_ratio), rows)


@pytest.mark.parametrize("max_ratio", [0.0, -1.0, 1.5, float("nan")])
def test_a_ratio_outside_its_range_is_refused(max_ratio: float) -> None:
    with pytest.raises(ValueError, match=f"max_ratio must be above 0 and at most 1, got {max_ratio:g}"):
        filter_rows(some_table(), max_ratio=max_ratio)


def test_nearest_is_match_and_filter_in_one() -> None:
    rng = np.random.default_rng(6)
    source, target = features(unit_vectors(rng, 50)), features(unit_vectors(rng, 60))
    table = match(source, target)
    expected = table.correspondences.take(filter_rows(table, mutual=True, max_ratio=0.95))
    np.testing.assert_array_equal(nearest(source, target, mutual=True, max_ratio=0.95).indices, expected.indices)


def test_features_of_two_descriptors_are_refused() -> None:
    sentence = "target must have features of the source's descriptor (cgf), got fpfh"
    with pytest.raises(ValueError, match=re.escape(sentence)):
        match(features(np.zeros((2, 3))), features(np.zeros((2, 3)), descriptor="fpfh"))


def test_features_of_two_dimensions_are_refused() -> None:
    with pytest.raises(ValueError, match=re.escape("target must have features of the source's dimension (3), got 4")):
        match(features(np.zeros((2, 3))), features(np.zeros((2, 4))))


def test_features_that_are_not_finite_are_refused() -> None:
    vectors = np.zeros((4, 2))
    vectors[2, 1] = np.nan
    sentence = "target must have finite features, got 1 of 4 rows with NaN or inf (first at row 2); leave them out"
    with pytest.raises(ValueError, match=re.escape(sentence)):
        match(features(np.zeros((2, 2))), features(vectors))


def test_cancelled_matching_stops() -> None:
    with pytest.raises(Cancelled):
        match(features(np.zeros((2, 2))), features(np.zeros((2, 2))), cancelled=lambda: True)


def test_progress_rises_to_one() -> None:
    told: list[float] = []
    rng = np.random.default_rng(7)
    source = features(unit_vectors(rng, 2 * BLOCK + 1, 4))
    match(source, source, progress=lambda share, _: told.append(share))
    assert told == sorted(told)
    assert len(told) > 2
    assert told[-1] == 1


def ranked_features(quality: list[float] | None) -> Features:
    values = None if quality is None else np.array(quality, np.float32)
    return Features(np.array([7, 2, 5]), np.eye(3, dtype=np.float32), "cgf", values)


def test_the_table_says_the_quality_of_both_features() -> None:
    source, target = (ranked_features(values) for values in ([0.5, 1.0, 0.8], [1.0, 0.25, 0.5]))
    table = match(source, replace(target, vectors=target.vectors[[2, 0, 1]]))
    assert table.source_quality is not None
    assert table.target_quality is not None
    np.testing.assert_array_equal(table.source_quality, np.array([0.5, 1.0, 0.8], np.float32))
    np.testing.assert_array_equal(table.target_quality, np.array([0.25, 0.5, 1.0], np.float32))
    np.testing.assert_allclose(table.quality, [0.125, 0.5, 0.8])
    assert match(source, ranked_features(None)).quality is None


def test_the_surest_share_is_kept_by_quality_and_distance_or_by_distance_alone() -> None:
    table = some_table()
    assert filter_rows(table, surest=1 / 3).tolist() == [0]
    assert filter_rows(table, surest=0.67, mutual=True).tolist() == [0]
    judged = replace(table, source_quality=np.array([0.1, 1, 1], np.float32), target_quality=np.ones(3, np.float32))
    # 0.1 * 0.5, 1 * 0.2, 1 * 0.1
    assert filter_rows(judged, surest=1 / 3).tolist() == [1]
    assert filter_rows(judged, surest=0.67).tolist() == [1, 2]
    assert filter_rows(judged, surest=1.0).tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match=r"share must be above 0 and at most 1, got 0"):
        filter_rows(judged, surest=0.0)


def test_matches_are_ranked_by_what_is_asked_for() -> None:
    matches = Correspondences(
        np.array([[2, 7], [7, 5], [5, 2]]),
        np.array([0.3, 0.1, 0.2], np.float32),
        np.array([0.9, 0.95, 0.5], np.float32),
    )
    quality = np.array([1.0, 0.25, 0.8], np.float32)
    orders = {by: surest_rows(trust(matches, by, quality=quality), share=1.0).tolist() for by in RANKINGS}
    assert orders == {"distance": [1, 2, 0], "ratio": [2, 0, 1], "quality": [0, 2, 1], "combined": [2, 0, 1]}
    assert surest_rows(trust(matches, "ratio"), share=0.1).tolist() == [2]


def test_features_without_quality_cannot_be_ranked_by_it() -> None:
    matches = Correspondences(np.array([[2, 7]]), np.ones(1, np.float32), np.ones(1, np.float32))
    with pytest.raises(ValueError, match="by must be distance or ratio where features have no quality, got quality"):
        trust(matches, "quality")
    with pytest.raises(ValueError, match=r"share must be above 0 and at most 1, got 0"):
        surest_rows(np.ones(1, np.float32), share=0.0)

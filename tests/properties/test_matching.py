import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cgf.matching import match
from cgf.types import Features

# Small whole numbers make ties, which random floats do not.
VALUES = st.one_of(
    st.integers(-2, 2).map(float), st.floats(-1e6, 1e6, width=32), st.floats(-(2.0**-20), 2.0**-20, width=32)
)


@st.composite
def pairs_of_features(draw: st.DrawFn) -> tuple[Features, Features]:
    dim = draw(st.integers(1, 40))
    return draw(features(dim)), draw(features(dim))


@st.composite
def features(draw: st.DrawFn, dim: int) -> Features:
    count = draw(st.integers(1, 80))
    vectors = draw(hnp.arrays(np.float32, (count, dim), elements=VALUES, fill=VALUES))
    return Features(np.arange(count), vectors, "cgf")


def sq_distances(source: Features, target: Features) -> np.ndarray:
    """In float64, summed term by term as the search does, so that ties are the same."""
    sq = np.zeros((len(source), len(target)))
    for a, b in zip(source.vectors.astype(np.float64).T, target.vectors.astype(np.float64).T, strict=True):
        sq += np.square(a[:, None] - b)
    return sq


@given(pairs_of_features())
def test_matches_are_those_of_brute_force(pair: tuple[Features, Features]) -> None:
    table = match(*pair)
    sq = sq_distances(*pair)
    np.testing.assert_array_equal(table.correspondences.indices[:, 1], sq.argmin(axis=1))
    np.testing.assert_array_equal(table.correspondences.distances, np.sqrt(sq.min(axis=1)).astype(np.float32))
    np.testing.assert_array_equal(table.mutual, sq.argmin(axis=0)[sq.argmin(axis=1)] == np.arange(len(sq)))
    if sq.shape[1] > 1:
        nearest, second = np.sqrt(np.partition(sq, 1, axis=1)[:, :2]).T
        ratios = np.divide(nearest, second, out=np.ones(len(sq)), where=second > 0)
        np.testing.assert_array_equal(table.correspondences.ratios, ratios.astype(np.float32))


@given(pairs_of_features())
def test_swapping_clouds_transposes_mutual_matches(pair: tuple[Features, Features]) -> None:
    source, target = pair
    there, back = match(source, target), match(target, source)
    forward = there.correspondences.indices[there.mutual]
    backward = back.correspondences.indices[back.mutual][:, ::-1]
    np.testing.assert_array_equal(forward, backward[np.argsort(backward[:, 0])])
    np.testing.assert_array_equal(
        there.correspondences.distances[there.mutual],
        back.correspondences.distances[back.mutual][np.argsort(backward[:, 0])],
    )


@given(pairs_of_features(), st.randoms(use_true_random=False))
def test_distances_do_not_depend_on_the_order_of_the_target(pair: tuple[Features, Features], random: object) -> None:
    source, target = pair
    order = list(range(len(target)))
    random.shuffle(order)  # type: ignore[attr-defined]
    shuffled = Features(np.arange(len(target)), target.vectors[order], "cgf")
    one, other = match(source, target).correspondences, match(source, shuffled).correspondences
    np.testing.assert_array_equal(one.distances, other.distances)
    np.testing.assert_array_equal(one.ratios, other.ratios)


@given(pairs_of_features())
def test_a_ratio_is_a_share(pair: tuple[Features, Features]) -> None:
    ratios = match(*pair).correspondences.ratios
    assert ((ratios >= 0) & (ratios <= 1)).all()

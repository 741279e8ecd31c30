"""Features of all loaded points, from those of one a voxel."""

from dataclasses import replace

import numpy as np
import pytest

from cgf.pipeline import PairSettings, describe_all, interpolate, nearest_described, prepare, resolve
from cgf.types import Features, PointCloud
from tests.app.scenes import bumpy_cloud


@pytest.fixture(scope="module")
def few():
    """Four described points out of six in a plane, and their features."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [9, 9, 0], [0, 1, 0], [5, 5, 0], [1, 1, 0]])
    vectors = np.array([[1.0, 0], [0, 1], [1, 0], [0, 1]], dtype=np.float32)
    return PointCloud(points), Features(np.array([0, 1, 3, 5]), vectors, "cgf")


def test_a_described_point_keeps_its_features_to_the_last_digit(few):
    cloud, features = few
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(4, 32)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    found = interpolate(cloud.points, cloud, replace(features, vectors=vectors), reach=0.5)
    np.testing.assert_array_equal(found.indices, features.indices)
    np.testing.assert_array_equal(found.vectors, vectors)


@pytest.mark.parametrize("descriptor", ["cgf", "pca"])
def test_between_points_the_nearer_counts_more(few, descriptor):
    cloud, features = few
    found = interpolate(np.array([[0.25, 0, 0]]), cloud, replace(features, descriptor=descriptor), reach=1.0)
    weights = 1 / np.array([0.25, 0.75, np.hypot(0.25, 1)])
    # The first and the third of the three nearest have the same feature.
    mean = np.array([weights[0] + weights[2], weights[1]]) / weights.sum()
    expected = mean / np.linalg.norm(mean) if descriptor == "cgf" else mean
    np.testing.assert_allclose(found.vectors, expected[None], rtol=1e-6)


def test_points_beyond_reach_of_all_described_ones_are_left_out(few):
    cloud, features = few
    found = interpolate(np.array([[3.0, 3, 0], [1.2, 1, 0], [0, 9, 0]]), cloud, features, reach=1.0)
    assert found.indices.tolist() == [1]
    assert found.vectors.shape == (1, 2)


def test_a_single_feature_serves_all_around(few):
    cloud, features = few
    only = Features(features.indices[1:2], features.vectors[1:2], "cgf")
    np.testing.assert_array_equal(interpolate(cloud.points[:2], cloud, only, reach=2.0).vectors, [[0, 1], [0, 1]])


def test_the_nearest_described_point_is_found_among_described_ones(few):
    cloud, features = few
    rows = nearest_described(cloud.points, cloud, features)
    assert rows.tolist() == [0, 1, 3, 2, 3, 3]


def test_every_loaded_point_is_described():
    cloud = bumpy_cloud(side=30)
    settings = resolve(PairSettings(voxel_size=0.25, support_radius=1.0, dim=16), cloud, cloud)
    features, prepared, few = describe_all(cloud, settings)
    assert len(prepared) < len(cloud) / 3
    assert len(prepare(cloud, settings)) == len(prepared)
    assert few.dim == features.dim == 16
    np.testing.assert_array_equal(features.indices, np.arange(len(cloud)))
    np.testing.assert_allclose(np.linalg.norm(features.vectors, axis=1), 1, rtol=1e-5)
    # Neighbours look alike: more than any two points do.
    own = few.vectors[nearest_described(cloud.points, prepared, few)]
    assert np.einsum("nd,nd->n", own, features.vectors).mean() > np.mean(own @ own.T) + 0.1

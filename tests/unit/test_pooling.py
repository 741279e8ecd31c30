import numpy as np

from cgf.descriptors import DescriptorSettings, make_descriptor
from cgf.descriptors.pooling import pool_features
from cgf.types import PointCloud


def test_features_are_the_weighted_means_of_those_around():
    rng = np.random.default_rng(0)
    points, vectors = rng.uniform(-1, 1, (400, 3)) + 7, rng.normal(size=(400, 5)).astype(np.float32)
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    weights = np.maximum(1 - (distances / 0.4) ** 2, 0)
    expected = weights @ vectors / weights.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(pool_features(points, vectors, radius=0.4), expected, atol=1e-5)


def test_a_point_alone_keeps_its_feature():
    points, vectors = np.array([[0.0, 0, 0], [1, 0, 0]]), np.eye(2, dtype=np.float32)
    np.testing.assert_array_equal(pool_features(points, vectors, radius=0.5), vectors)
    assert pool_features(points[:0], vectors[:0], radius=0.5).shape == (0, 2)


def test_the_descriptor_pools_over_what_it_is_asked_for():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 2, (2, 4_000))
    points = np.column_stack([x, y, 0.1 * np.sin(7 * x) * np.cos(5 * y)])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    cloud = PointCloud(points, normals)
    settings = DescriptorSettings(support_radius=0.3, min_radius=0.05, lrf_radius=0.1, dim=16, model="object")
    descriptor = make_descriptor("cgf", settings)
    far = np.array([0])
    near = np.flatnonzero(np.linalg.norm(points - points[0], axis=1) < 0.1)
    alone, among = descriptor.describe(cloud, far), descriptor.describe(cloud, near)
    here = among.vectors[among.indices == 0][0]
    np.testing.assert_allclose(np.linalg.norm(among.vectors, axis=1), 1, atol=1e-5)
    assert 1e-4 < np.linalg.norm(here - alone.vectors[0]) < 0.6

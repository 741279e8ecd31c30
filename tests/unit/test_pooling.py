import numpy as np

from cgf.descriptors import DescriptorSettings, make_descriptor
from cgf.descriptors.pooling import add_context, cell_means, pool_features
from cgf.types import PointCloud


def test_features_are_the_weighted_means_of_those_around():
    rng = np.random.default_rng(0)
    points, vectors = rng.uniform(-1, 1, (400, 3)) + 7, rng.normal(size=(400, 5)).astype(np.float32)
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    weights = np.maximum(1 - (distances / 0.4) ** 2, 0)
    expected = weights @ vectors / weights.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(pool_features(points, vectors, radius=0.4), expected, atol=1e-5)


def test_means_can_be_taken_elsewhere():
    rng = np.random.default_rng(3)
    points, vectors = rng.uniform(-1, 1, (400, 3)), rng.normal(size=(400, 5)).astype(np.float32)
    at = points[::7] + 0.1
    together = pool_features(np.concatenate([points, at]), np.pad(vectors, ((0, len(at)), (0, 0))), radius=0.4)
    weights = [np.maximum(1 - (np.linalg.norm(points - place, axis=1) / 0.4) ** 2, 0) for place in at]
    expected = np.stack([own @ vectors / own.sum() for own in weights])
    np.testing.assert_allclose(pool_features(points, vectors, radius=0.4, at=at), expected, atol=1e-5)
    assert np.abs(together[400:] - expected).max() > 0.01


def test_cells_count_the_same_however_many_points_they_hold():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.1, 0.2, 0.1], [5.1, 0.1, 0.1]]) + 1000
    vectors = np.array([[0.0], [3.0], [6.0], [1.0]], np.float32)
    means, averaged = cell_means(points, vectors, radius=2.0)
    np.testing.assert_allclose(means - 1000, [[0.4 / 3, 0.4 / 3, 0.1], [5.1, 0.1, 0.1]], atol=1e-9)
    np.testing.assert_array_equal(averaged, [[3.0], [1.0]])


def test_context_adds_means_of_its_parts_within_each_radius():
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(0, 3, (3000, 2)), np.zeros(3000)])
    own = rng.normal(size=(3000, 2)).astype(np.float32)
    smooth = np.sin(points[:, :2]).astype(np.float32)  # so that cells stand for their points
    parts = np.stack([own, 2 * smooth, smooth])
    near, far = pool_features(points, 2 * smooth, radius=0.3), pool_features(points, smooth, radius=0.9)
    found = add_context(points, parts, radii=(0.3, 0.9))
    np.testing.assert_allclose(found, own + near + far, atol=0.2)
    assert np.abs(found - own - 3 * smooth).max() > 0.4
    np.testing.assert_array_equal(add_context(points, own[None], radii=()), own)
    assert add_context(points[:0], parts[:, :0], radii=(0.3, 0.9)).shape == (0, 2)


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

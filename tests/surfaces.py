"""Surfaces of any size, for tests of what depends on it."""

import numpy as np

from cgf.types import PointCloud


def surface(size: float = 4.0, count: int = 1500, seed: int = 0) -> PointCloud:
    """A hilly sheet whose diagonal is `size`, without normals."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, size=(2, count))
    z = 0.2 * np.sin(3 * x) + 0.3 * np.cos(2 * y) * x
    points = np.column_stack([x, y, z])
    points *= size / np.linalg.norm(np.ptp(points, axis=0))
    return PointCloud(points, name="sheet", viewpoint=np.array([0.0, 0.0, 10 * size]))

"""What hypothesis draws: rigid motions and clouds that look like pieces of surface."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from cgf.geometry.transforms import rigid, rotation_of_quaternion
from cgf.types import PointCloud

# Sixteenths shrink well, and sums of them are exact.
_grid = st.integers(-64, 64).map(lambda value: value / 16)


@st.composite
def rotations(draw: st.DrawFn) -> np.ndarray:
    """Rotation matrices; the simplest is the identity."""
    x, y, z = (draw(_grid) for _ in range(3))
    return rotation_of_quaternion((1.0, x, y, z))


@st.composite
def rigid_motions(draw: st.DrawFn, *, max_translation: float = 4.0) -> np.ndarray:
    """4x4 motions; the simplest is the identity."""
    translation = [draw(_grid) * max_translation / 4 for _ in range(3)]
    return rigid(draw(rotations()), translation)


@st.composite
def surfaces(
    draw: st.DrawFn, *, min_points: int = 40, max_points: int = 160, normals: bool = True, colors: bool = False
) -> PointCloud:
    """Rough patches of surface about 2 units wide, seen from above, without two equal points.

    The heights are drawn, point by point, over a jittered lattice: neighbourhoods are full but in general position.
    """
    count = draw(st.integers(min_points, max_points))
    side = int(np.ceil(np.sqrt(count)))
    row = np.arange(count)
    flat = np.stack([row % side, row // side], axis=1) * (2 / side)
    offsets = draw(st_numpy.arrays(np.int8, (count, 3)))
    # The irrational step keeps points that shrink to equal offsets out of lines and planes.
    turns = np.stack([np.sin(1.7 * row), np.cos(2.3 * row), np.sin(3.1 * row) + np.cos(row)], axis=1)
    offsets = offsets / 128 * (0.3 / side) + turns * (0.1 / side)
    points = np.column_stack([flat, np.zeros(count)]) + offsets * (1, 1, 3)
    points = points - (1, 1, 0)
    directions = np.column_stack([offsets[:, :2] * side, np.ones(count)])
    return PointCloud(
        points=points,
        normals=directions / np.linalg.norm(directions, axis=1, keepdims=True) if normals else None,
        colors=draw(st_numpy.arrays(np.uint8, (count, 3))) if colors else None,
        name="surface",
        viewpoint=np.array([0.0, 0.0, 5.0]),
    )


@st.composite
def permutations_of(draw: st.DrawFn, count: int) -> np.ndarray:
    """Orders of `count` rows."""
    return np.array(draw(st.permutations(range(count))), dtype=np.int64)

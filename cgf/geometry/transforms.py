"""Rigid motions as 4x4 matrices that act on columns; points stay rows."""

from dataclasses import replace
from functools import reduce

import numpy as np
from jaxtyping import Float64

from cgf.checks import ArrayLike
from cgf.types import PointCloud


def apply(
    target_from_source: Float64[np.ndarray, "4 4"], points: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Move `points` from the source frame into the target frame."""
    moved: Float64[np.ndarray, "N 3"] = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return moved


def rotate(
    target_from_source: Float64[np.ndarray, "4 4"], vectors: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Turn directions, such as normals, without moving them."""
    turned: Float64[np.ndarray, "N 3"] = vectors @ target_from_source[:3, :3].T
    return turned


def move(target_from_source: Float64[np.ndarray, "4 4"], cloud: PointCloud) -> PointCloud:
    """Move a cloud: its points, its normals and its viewpoint."""
    return replace(
        cloud,
        points=apply(target_from_source, cloud.points),
        normals=None if cloud.normals is None else rotate(target_from_source, cloud.normals),
        viewpoint=apply(target_from_source, cloud.viewpoint[None])[0],
    )


def rigid(rotation: Float64[np.ndarray, "3 3"], translation: ArrayLike = (0.0, 0.0, 0.0)) -> Float64[np.ndarray, "4 4"]:
    """The motion `R p + t`."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def invert(target_from_source: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The motion back, `source_from_target`."""
    rotation = target_from_source[:3, :3].T
    return rigid(rotation, -rotation @ target_from_source[:3, 3])


def compose(*transforms: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Chain motions as they are written: `compose(c_from_b, b_from_a)` is `c_from_a`."""
    return reduce(np.matmul, transforms, np.eye(4))


def rotation_about(axis: ArrayLike, angle: float) -> Float64[np.ndarray, "3 3"]:
    """The rotation by `angle` (radians) about `axis`, right-handed; the axis need not have length 1.

    Raises:
        ValueError: `axis` has no length.
    """
    vector = np.asarray(axis, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"axis must be 3 numbers that are not all zero, got {vector}")
    x, y, z = vector / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64[np.ndarray, "3 3"] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotation  # Rodrigues' formula


def interpolate(
    start: Float64[np.ndarray, "4 4"], end: Float64[np.ndarray, "4 4"], share: float, center: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """The motion on the way from `start` to `end`: a steady turn the short way round, while `center` goes straight.

    Args:
        start: At share 0.
        end: At share 1.
        share: Of the way.
        center: Point, in the frame that both map from, whose image moves along a line at even speed.
    """
    from scipy.spatial.transform import Rotation  # on first use: it costs half a second to import

    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    rotation = start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    place = (1 - share) * apply(start, center[None])[0] + share * apply(end, center[None])[0]
    return rigid(rotation, place - rotation @ center)


def random_rigid(rng: np.random.Generator, *, max_translation: float = 1.0) -> Float64[np.ndarray, "4 4"]:
    """A motion whose rotation is uniform over all rotations and whose translation is uniform in a cube.

    Args:
        rng: Source of randomness.
        max_translation: Half the edge of the cube, in cloud units.
    """
    quaternion = rng.normal(size=4)
    translation = rng.uniform(-max_translation, max_translation, size=3)
    return rigid(rotation_of_quaternion(quaternion), translation)


def rotation_of_quaternion(quaternion: ArrayLike) -> Float64[np.ndarray, "3 3"]:
    """The rotation of the quaternion (w, x, y, z), of any length but zero.

    Raises:
        ValueError: Not four numbers, or all zero.
    """
    values = np.asarray(quaternion, dtype=np.float64)
    length = float(np.linalg.norm(values))
    if values.shape != (4,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"quaternion must be 4 numbers that are not all zero, got {values}")
    w, x, y, z = values / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_error_deg(estimate: Float64[np.ndarray, "4 4"], truth: Float64[np.ndarray, "4 4"]) -> float:
    """Angle between the rotations of two motions, in degrees (RRE in tables)."""
    # The chord is exact for the small angles that are compared; the usual arc cosine of the trace is not.
    chord = float(np.linalg.norm(estimate[:3, :3] - truth[:3, :3])) / np.sqrt(8.0)
    return float(np.degrees(2 * np.arcsin(min(chord, 1.0))))


def translation_error(estimate: Float64[np.ndarray, "4 4"], truth: Float64[np.ndarray, "4 4"]) -> float:
    """Distance between the translations of two motions, in cloud units (RTE in tables)."""
    return float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))

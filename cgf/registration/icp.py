"""Refinement of a motion by the iterative closest point method.

Point to plane (Chen and Medioni 1992) slides along surfaces and so takes few steps; point to point (Besl and McKay
1992) needs no normals.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64

from cgf.checks import check_count, check_positive, check_transform
from cgf.geometry import transforms
from cgf.geometry.neighbors import build_tree
from cgf.registration.agreement import nothing_found, surface_agreement
from cgf.registration.alignment import fit_rigid
from cgf.types import Correspondences, IsCancelled, PointCloud, Progress, RegistrationResult, raise_if_cancelled

IcpMetric = Literal["plane", "point"]

ANGLE_EPSILON_DEG = 1e-3
"""Steps that turn less and shift less end the refinement."""
SHIFT_EPSILON = 1e-4
"""As a share of the maximum distance."""
FREE_DIRECTION = 1e-6
"""A direction with less than this share of the strongest one's weight is not determined."""
FEWEST_POINTS = 10


@dataclass(frozen=True)
class IcpConfig:
    """How near and how long."""

    max_distance: float
    """Target points farther than this from a moved source point have no say, in cloud units."""
    iterations: int = 50
    metric: IcpMetric = "plane"
    """What is made small: distances to the planes of the target's points, or to the points themselves."""

    def __post_init__(self) -> None:
        check_positive(self.max_distance, "max_distance")
        check_count(self.iterations, "iterations", minimum=1)


@dataclass(frozen=True, eq=False)
class Icp:
    """Improves a motion that is nearly right, by the surfaces alone."""

    config: IcpConfig
    initial: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """`target_from_source` to start from."""

    def __post_init__(self) -> None:
        check_transform(self.initial, "initial")

    @property
    def name(self) -> str:
        return "icp"

    def estimate(
        self,
        source: PointCloud,
        target: PointCloud,
        correspondences: Correspondences,
        *,
        progress: Progress | None = None,
        cancelled: IsCancelled | None = None,
    ) -> RegistrationResult:
        """Move the source until its points lie on their nearest target points, or in those points' planes.

        Args:
            source: Cloud to move.
            target: Cloud that stays, for the metric `plane` with normals; their sides do not matter.
            correspondences: Not looked at but for `inliers`, those within the maximum distance afterwards.
            progress: Told the share of the iterations that are done.
            cancelled: Asked before every iteration whether to give up.

        Returns:
            `target_from_source` is None if fewer than 10 source points come within the maximum distance.

        Raises:
            ValueError: `target` has no normals, which the metric `plane` needs.
            Cancelled: `cancelled` returned True.
        """
        target_from_source = _refine(source, target, self.initial, self.config, progress, cancelled)
        if target_from_source is None:
            return nothing_found(self.name)
        fitness, inlier_rmse = surface_agreement(source, target, target_from_source, self.config.max_distance)
        moved = transforms.apply(target_from_source, source.points[correspondences.indices[:, 0]])
        offsets = moved - target.points[correspondences.indices[:, 1]]
        inliers = np.flatnonzero(np.linalg.norm(offsets, axis=1) <= self.config.max_distance)
        return RegistrationResult(target_from_source, inliers, fitness, inlier_rmse, self.name)


def _refine(
    source: PointCloud,
    target: PointCloud,
    initial: Float64[np.ndarray, "4 4"],
    config: IcpConfig,
    progress: Progress | None,
    cancelled: IsCancelled | None,
) -> Float64[np.ndarray, "4 4"] | None:
    normals = target.normals
    if normals is None and config.metric == "plane":
        raise ValueError("target must have normals, got none; estimate them first, or take the metric point")
    # Centred on the target, so that coordinates may be large (UTM).
    center = transforms.rigid(np.eye(3), -target.points.mean(axis=0))
    target_points = transforms.apply(center, target.points)
    tree = build_tree(target_points)
    motion = center @ initial
    for iteration in range(config.iterations):
        raise_if_cancelled(cancelled)
        if progress is not None:
            progress(iteration / config.iterations, "Refining on the surfaces")
        moved = transforms.apply(motion, source.points)
        distances, rows = tree.query(moved, distance_upper_bound=config.max_distance, workers=-1)
        near = np.flatnonzero(np.isfinite(distances))
        if len(near) < FEWEST_POINTS:
            return None
        goals = target_points[rows[near]]
        if config.metric == "point":
            step = fit_rigid(moved[near], goals)
        else:
            assert normals is not None
            step = _plane_step(moved[near], goals, normals[rows[near]])
        motion = step @ motion
        turned = transforms.rotation_error_deg(step, np.eye(4))
        shift = transforms.apply(step, moved.mean(axis=0, keepdims=True))[0] - moved.mean(axis=0)
        if turned < ANGLE_EPSILON_DEG and np.linalg.norm(shift) < SHIFT_EPSILON * config.max_distance:
            break
    return transforms.compose(transforms.invert(center), motion)


def _plane_step(
    points: Float64[np.ndarray, "C 3"], goals: Float64[np.ndarray, "C 3"], normals: Float64[np.ndarray, "C 3"]
) -> Float64[np.ndarray, "4 4"]:
    """The small motion that brings `points` into the planes through `goals`, linearised in the angle."""
    middle = points.mean(axis=0)
    arms = points - middle
    # Angles count as lengths at this distance, so that one threshold tells what the planes leave free (sliding along
    # a single plane, say): lstsq does not move along such directions.
    lever = max(float(np.sqrt(np.square(arms).sum(axis=1).mean())), np.finfo(np.float64).tiny)
    jacobian = np.column_stack([np.cross(arms, normals) / lever, normals])
    residuals = np.einsum("ij,ij->i", goals - points, normals)
    solution = np.linalg.lstsq(jacobian.T @ jacobian, jacobian.T @ residuals, rcond=FREE_DIRECTION)[0]
    vector = solution[:3] / lever
    angle = float(np.linalg.norm(vector))
    rotation = transforms.rotation_about(vector, angle) if angle > 0 else np.eye(3)
    return transforms.rigid(rotation, middle + solution[3:] - rotation @ middle)

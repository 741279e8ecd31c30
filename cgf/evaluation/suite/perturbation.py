"""What robustness is measured against: noise, lost points, holes, and a radius that is off."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cgf.geometry.neighbors import build_tree
from cgf.geometry.normals import estimate_normals
from cgf.types import PointCloud

Change = Literal["none", "noise", "density", "holes", "radius"]
_TITLES = {"noise": "noise", "density": "points kept", "holes": "lost in holes", "radius": "support radius"}


@dataclass(frozen=True)
class Perturbation:
    """One change to a pair: to its source, or to the radius that both clouds are described with."""

    change: Change
    amount: float = 0.0
    """Standard deviation of noise in voxels; share of points kept, or lost in holes; factor of the radius."""

    @property
    def label(self) -> str:
        """What is changed, by how much."""
        if self.change == "none":
            return "unchanged"
        amount = f"{self.amount:g} voxels" if self.change == "noise" else f"{100 * self.amount:g} %"
        return f"{_TITLES[self.change]} {amount}"


def perturbations() -> tuple[Perturbation, ...]:
    """All that are measured, in the order of the tables."""
    amounts: dict[Change, tuple[float, ...]] = {
        "noise": (0.17, 0.33, 0.67),
        "density": (0.5, 0.25, 0.1),
        "holes": (0.1, 0.25, 0.5),
        "radius": (0.7, 0.85, 1.15, 1.3),
    }
    changes = [Perturbation(change, amount) for change, values in amounts.items() for amount in values]
    return (Perturbation("none"), *changes)


def perturb(
    cloud: PointCloud,
    perturbation: Perturbation,
    *,
    voxel_size: float,
    normal_radius: float,
    hole_radius: float,
    rng: np.random.Generator,
) -> PointCloud:
    """The cloud, as it was read, with a change to its points.

    Args:
        cloud: Of any density.
        perturbation: What to do; a change of the radius leaves the cloud as it is.
        voxel_size: Unit of the noise, in cloud units.
        normal_radius: Of the neighbourhood for normals, where the cloud brings some and its points move.
        hole_radius: Of the balls that are cut out.
        rng: Draws noise, points and centres of holes.

    Returns:
        Of noisy points, normals are estimated anew and turned to the side of the old ones.
    """
    if perturbation.change == "noise":
        noise = rng.normal(scale=perturbation.amount * voxel_size, size=cloud.points.shape)
        noisy = replace(cloud, points=cloud.points + noise)
        if cloud.normals is None:
            return noisy
        normals = estimate_normals(noisy, radius=normal_radius).normals
        assert normals is not None
        opposite = np.einsum("ij,ij->i", normals, cloud.normals) < 0
        return replace(noisy, normals=np.where(opposite[:, None], -normals, normals))
    if perturbation.change == "density":
        kept = rng.permutation(len(cloud))[: max(round(perturbation.amount * len(cloud)), 1)]
        return cloud.take(np.sort(kept))
    if perturbation.change == "holes":
        return _with_holes(cloud, share=perturbation.amount, radius=hole_radius, rng=rng)
    return cloud


def _with_holes(cloud: PointCloud, *, share: float, radius: float, rng: np.random.Generator) -> PointCloud:
    """The cloud without `share` of its points, in whole balls but for the last."""
    tree, lost = build_tree(cloud.points), np.zeros(len(cloud), dtype=np.bool_)
    wanted = round(share * len(cloud))
    while (missing := wanted - np.count_nonzero(lost)) > 0:
        center = cloud.points[rng.choice(np.flatnonzero(~lost))]
        inside = np.array(tree.query_ball_point(center, radius, return_sorted=True), dtype=np.int64)
        lost[inside[~lost[inside]][:missing]] = True
    return cloud.take(np.flatnonzero(~lost))

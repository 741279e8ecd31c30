"""Changes that make a few scans stand for many: drawn anew for every overlap of every batch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

_FEWEST = 10
"""A cloud that would keep fewer points keeps them all."""


@dataclass(frozen=True)
class Augmentation:
    """How much is changed. Lengths are shares of the support radius."""

    radius_jitter: float = 0.1
    """The support is scaled by a factor within 1 plus or minus this, the same for both clouds."""
    stretch: float = 0.0
    """Both clouds are stretched along three random axes by up to 1 plus this, or shrunk by as much."""
    mirror: float = 0.0
    """Share of the overlaps that are mirrored: other rooms, of the same kind."""
    holes: float = 0.0
    """Share of the clouds that lose up to five balls, of a radius from 0.1 to 0.5."""
    cut: float = 0.0
    """Share of the clouds that end at a random plane."""
    normal_noise_deg: float = 3.0
    """Standard deviation of the tilt of the frames' z axes."""
    keep_at_least: float = 0.6
    """A random share of the neighbours, between this and 1, is kept in each cloud."""

    def draw_shape(self, rng: np.random.Generator) -> Float64[np.ndarray, "3 3"]:
        """A linear map for both clouds of an overlap, in one common frame."""
        shape = np.eye(3)
        if self.stretch:
            axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            most = np.log1p(self.stretch)
            shape = axes @ np.diag(np.exp(rng.uniform(-most, most, 3))) @ axes.T
        if self.mirror and rng.random() < self.mirror:
            shape = shape @ np.diag([-1.0, 1.0, 1.0])
        return shape

    def draw_kept(
        self, points: Float64[np.ndarray, "N 3"], support_radius: float, rng: np.random.Generator
    ) -> Bool[np.ndarray, "N"]:
        """Which points of one cloud are left: some are dropped at random, some make room for holes and an edge."""
        kept = rng.random(len(points)) < rng.uniform(self.keep_at_least, 1.0)
        if self.holes and rng.random() < self.holes:
            for _ in range(rng.integers(1, 6)):
                center = points[rng.integers(len(points))]
                kept &= np.linalg.norm(points - center, axis=1) > rng.uniform(0.1, 0.5) * support_radius
        if self.cut and rng.random() < self.cut:
            direction = rng.normal(size=3)
            heights = points @ (direction / np.linalg.norm(direction))
            kept &= heights < np.quantile(heights, rng.uniform(0.5, 1.0))
        return kept if kept.sum() >= _FEWEST else np.ones(len(points), dtype=np.bool_)

    def draw_frames(
        self, normals: Float64[np.ndarray, "K 3"], rng: np.random.Generator
    ) -> Float64[np.ndarray, "K 3 3"]:
        """Frames with z near the normal and a random x, for a network that has to do without a repeatable one."""
        z = normals + rng.normal(size=normals.shape) * np.deg2rad(self.normal_noise_deg)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        x = np.cross(z, rng.normal(size=z.shape))
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        return np.stack([x, np.cross(z, x), z], axis=1)

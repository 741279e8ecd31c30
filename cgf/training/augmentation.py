"""Changes that make a few scans stand for many: drawn anew for every overlap of every batch."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, no_type_check

import numpy as np
from jaxtyping import Bool, Float64
from numba import njit

Rows: TypeAlias = Float64[np.ndarray, "N 3"]
Bend: TypeAlias = Callable[[Rows, Rows], tuple[Rows, Rows]]
"""Gives moved points, and their normals, of any length."""

_FEWEST = 10
"""A cloud that would keep fewer points keeps them all."""
_WAVES = 4
_STEEPEST = 8.0
"""Slope of the wave t (8 - 16 |t|), t from -1/2 to 1/2, where it crosses zero: parabolas instead of a sine."""


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
    bend: float = 0.0
    """Both clouds are bent by four waves, each of which stretches them by up to this."""
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

    def draw_bend(self, support_radius: float, rng: np.random.Generator) -> Bend:
        """A smooth map for points and normals of both clouds of an overlap, in one common frame.

        Its waves are between half and four times as long as the support's radius.
        """
        if not self.bend:
            return lambda points, normals: (points, normals)
        directions, offsets = rng.normal(size=(2, _WAVES, 3))
        lengths = support_radius * np.exp(rng.uniform(np.log(0.5), np.log(4.0), (_WAVES, 1)))
        waves = directions / np.linalg.norm(directions, axis=1, keepdims=True) / lengths
        heights = rng.uniform(0, self.bend, (_WAVES, 1)) * lengths / _STEEPEST
        offsets *= heights / np.linalg.norm(offsets, axis=1, keepdims=True)
        phases = rng.random(_WAVES)
        return lambda points, normals: _bent(points, normals, waves, phases, offsets)

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


@njit(cache=True, nogil=True, fastmath=True)
@no_type_check
def _bent(points, normals, waves, phases, offsets):
    """Points moved by `offsets` (W, 3) times the waves; normals times the cofactors of the derivative."""
    moved, turned = np.empty_like(points), np.empty_like(normals)
    for i in range(len(points)):
        x, y, z = points[i]
        dx = dy = dz = 0.0
        xx = yy = zz = 1.0
        xy = xz = yx = yz = zx = zy = 0.0
        for w in range(len(waves)):
            a, b, c = waves[w]
            t = a * x + b * y + c * z + phases[w]
            t -= np.floor(t + 0.5)
            height, slope = t * (8.0 - 16.0 * abs(t)), 8.0 - 32.0 * abs(t)
            u, v, q = offsets[w]
            dx += u * height
            dy += v * height
            dz += q * height
            xx += slope * u * a
            xy += slope * u * b
            xz += slope * u * c
            yx += slope * v * a
            yy += slope * v * b
            yz += slope * v * c
            zx += slope * q * a
            zy += slope * q * b
            zz += slope * q * c
        moved[i, 0], moved[i, 1], moved[i, 2] = x + dx, y + dy, z + dz
        nx, ny, nz = normals[i]
        turned[i, 0] = (yy * zz - yz * zy) * nx + (yz * zx - yx * zz) * ny + (yx * zy - yy * zx) * nz
        turned[i, 1] = (xz * zy - xy * zz) * nx + (xx * zz - xz * zx) * ny + (xy * zx - xx * zy) * nz
        turned[i, 2] = (xy * yz - xz * yy) * nx + (xz * yx - xx * yz) * ny + (xx * yy - xy * yx) * nz
    return moved, turned

"""Batches for the contrastive recipe: each is a function of the seed and its number, so a run can resume anywhere."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import cKDTree

from cgf.descriptors.settings import FrameKind
from cgf.descriptors.spherical_histogram import histogram_grid, nested_scales
from cgf.geometry.lrf import estimate_lrf
from cgf.geometry.transforms import apply
from cgf.training.augmentation import Augmentation
from cgf.training.fragments import Fragments, Overlap


@dataclass(frozen=True, eq=False)
class Batch:
    """Histograms of corresponding points: row i of the source belongs to row i of the target."""

    source: Float32[np.ndarray, "N *S W"]
    target: Float32[np.ndarray, "N *S W"]
    ignored: Bool[np.ndarray, "B B"]
    """Entries that are no negatives: near the true partner, or from another overlap of the same scene.

    Of the whole batch, of which the histograms may be one process's share.
    """


class Batches:
    """Draws batches of `size` correspondences from `per_batch` overlaps at a time."""

    def __init__(
        self,
        fragments: Fragments,
        *,
        support_radius: float,
        min_radius: float,
        lrf_radius: float,
        frame: FrameKind | Literal["random"],
        tau: float,
        size: int,
        per_batch: int,
        augmentation: Augmentation,
        seed: int,
        share: slice = slice(None),
        insets: tuple[int, ...] = (0,),
        oriented: bool = False,
        joined: bool = False,
    ) -> None:
        """Of the supports smaller by `insets`, each overlap is described in one, or, if `joined`, in all.

        Histograms are `oriented`, with soft azimuth sectors if the frame is random, or as in the paper.
        `share` says which of the `per_batch` overlaps' histograms are computed; others do without.
        """
        self.fragments = fragments
        self.support_radius, self.min_radius, self.tau = support_radius, min_radius, tau
        self.lrf_radius, self.frame = lrf_radius, frame
        self.size, self.per_batch, self.augmentation, self.seed = size, per_batch, augmentation, seed
        self.insets, self.oriented, self.joined = insets, oriented, joined
        self._scales = nested_scales(insets, support_radius=support_radius, min_radius=min_radius)
        self._own = range(per_batch)[share]
        self._scenes: dict[int, list[Overlap]] = {}
        for overlap in fragments.overlaps:
            self._scenes.setdefault(overlap.scene, []).append(overlap)
        self._tree = lru_cache(maxsize=None)(lambda cloud: cKDTree(fragments.clouds[cloud].points))

    def draw(self, step: int) -> Batch:
        """Batch number `step`."""
        share = self.size // self.per_batch
        sources: list[np.ndarray] = []
        targets, positions, partners, scenes = [], [], [], []
        for number in range(self.per_batch):
            # Its own, so that no overlap depends on what was drawn for the others.
            rng = np.random.default_rng([self.seed, 7, step, number])
            scene, overlap, rows, partner_rows = self._overlap(share, rng)
            source, target = self.fragments.clouds[overlap.source], self.fragments.clouds[overlap.target]
            if number in self._own:
                jitter, shape = self.augmentation.radius_jitter, self.augmentation.draw_shape(rng)
                factor, turn = rng.uniform(1 - jitter, 1 + jitter), overlap.target_from_source[:3, :3]
                if len(self.insets) > 1 and not self.joined:
                    factor *= self._scales[int(rng.integers(len(self._scales)))]
                normals = [self._normals(cloud, rng) for cloud in (overlap.source, overlap.target)]
                sources.append(self._histograms(source.points, normals[0], rows, factor, shape @ turn, rng))
                targets.append(self._histograms(target.points, normals[1], partner_rows, factor, shape, rng))
            positions.append(apply(overlap.target_from_source, source.points[rows]))
            partners.append(target.points[partner_rows])
            scenes.append(scene)
        ignored = np.repeat(np.repeat(np.equal.outer(scenes, scenes), share, axis=0), share, axis=1)
        for number, (moved, true) in enumerate(zip(positions, partners, strict=True)):
            block = slice(number * share, (number + 1) * share)
            ignored[block, block] = np.linalg.norm(moved[:, None] - true[None], axis=2) < 1.5 * self.tau
        np.fill_diagonal(ignored, False)
        return Batch(np.concatenate(sources), np.concatenate(targets), ignored)

    def _overlap(self, count: int, rng: np.random.Generator) -> tuple[int, Overlap, np.ndarray, np.ndarray]:
        """An overlap of a random scene, with rows of `count` correspondences."""
        while True:
            scene = int(rng.choice(list(self._scenes)))
            overlap = self._scenes[scene][int(rng.integers(len(self._scenes[scene])))]
            if rng.random() < 0.5:
                overlap = _reversed(overlap)
            found = self._correspondences(overlap, count, rng)
            if found is not None:
                return scene, overlap, *found

    def _correspondences(
        self, overlap: Overlap, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Rows of `count` source points with a partner within a voxel, and of the partners; None if there are fewer."""
        points = self.fragments.clouds[overlap.source].points
        candidates = rng.permutation(len(points))[: 12 * count]
        moved = apply(overlap.target_from_source, points[candidates])
        distances, partners = self._tree(overlap.target).query(moved, distance_upper_bound=overlap.voxel_size)
        near = np.flatnonzero(np.isfinite(distances))[:count]
        return (candidates[near], partners[near]) if len(near) == count else None

    def _normals(self, cloud: int, rng: np.random.Generator) -> Float64[np.ndarray, "N 3"]:
        """One of the estimates that there are for a cloud."""
        own = self.fragments.clouds[cloud].normals
        assert own is not None
        others = self.fragments.other_normals[cloud] if self.fragments.other_normals else []
        return [own, *others][int(rng.integers(1 + len(others)))] if others else own

    def _histograms(
        self,
        points: Float64[np.ndarray, "N 3"],
        normals: Float64[np.ndarray, "N 3"],
        rows: np.ndarray,
        factor: float,
        shape: Float64[np.ndarray, "3 3"],
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "K *S B"]:
        """Histograms of the augmented cloud, which the linear map `shape` has brought into another shape and frame."""
        points, normals = points @ shape.T, normals @ np.linalg.inv(shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        support_radius = self.support_radius * factor
        kept = self.augmentation.draw_kept(points, support_radius, rng)
        grid = histogram_grid(
            points[kept],
            support_radius=support_radius,
            min_radius=self.min_radius * factor,
            normals=normals[kept] if self.oriented else None,
        )
        frames = self.augmentation.draw_frames(normals[rows], rng)
        if self.frame != "random":
            estimated, defined = estimate_lrf(points, normals, rows, radius=self.lrf_radius, kind=self.frame)
            frames = np.where(defined[:, None, None], estimated, frames)
        insets = self.insets if self.joined else (0,)
        histograms, _ = grid.nested_histograms(points[rows], frames, soft=self.frame == "random", insets=insets)
        return histograms if self.joined else histograms[:, 0]


def _reversed(overlap: Overlap) -> Overlap:
    inverse = np.linalg.inv(overlap.target_from_source)
    return Overlap(overlap.target, overlap.source, inverse, overlap.scene, overlap.voxel_size)

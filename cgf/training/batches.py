"""Batches for the contrastive recipe: each is a function of the seed and its number, so a run can resume anywhere."""

from dataclasses import dataclass, replace
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
from cgf.training.surroundings import Surroundings


@dataclass(frozen=True, eq=False)
class Batch:
    """Histograms of corresponding points: row i of the source belongs to row i of the target."""

    source: Float32[np.ndarray, "N *S W"]
    target: Float32[np.ndarray, "N *S W"]
    ignored: Bool[np.ndarray, "B B"]
    """Entries that are no negatives: near the true partner, or from another overlap of the same scene.

    Of the whole batch, of which the histograms may be one process's share.
    """
    around: Float32[np.ndarray, "M C F"] | None = None
    """Of sources and then of targets, means of features around each; None without a context."""


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
        negatives: Literal["overlap", "place"] = "overlap",
        scenes: int | None = None,
        surroundings: Surroundings | None = None,
    ) -> None:
        """Of the supports smaller by `insets`, each overlap is described in one, or, if `joined`, in all.

        Histograms are `oriented`, with soft azimuth sectors if the frame is random, or as in the paper.
        Negatives of the same scene come from the same overlap or place; each batch is of so many `scenes`, or of any.
        With `surroundings`, they come with the means of the features around each point.
        `share` says which of the `per_batch` overlaps' histograms are computed; others do without.
        """
        self.fragments = fragments
        self.support_radius, self.min_radius, self.tau = support_radius, min_radius, tau
        self.lrf_radius, self.frame = lrf_radius, frame
        self.size, self.per_batch, self.augmentation, self.seed = size, per_batch, augmentation, seed
        self.insets, self.oriented, self.joined = insets, oriented, joined
        self.negatives, self.scenes, self.surroundings = negatives, scenes, surroundings
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
        around: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
        targets, moved, partners, overlaps = [], [], [], []
        scenes = list(self._scenes)
        if self.scenes is not None:
            scenes = np.random.default_rng([self.seed, 8, step]).permutation(scenes)[: self.scenes].tolist()
        for number in range(self.per_batch):
            # Its own, so that no overlap depends on what was drawn for the others.
            rng = np.random.default_rng([self.seed, 7, step, number])
            overlap, rows, partner_rows = self._overlap(scenes, share, rng)
            source, target = self.fragments.clouds[overlap.source], self.fragments.clouds[overlap.target]
            if number in self._own:
                jitter, shape = self.augmentation.radius_jitter, self.augmentation.draw_shape(rng)
                factor = rng.uniform(1 - jitter, 1 + jitter)
                bend = self.augmentation.draw_bend(self.support_radius, rng)
                if len(self.insets) > 1 and not self.joined:
                    factor *= self._scales[int(rng.integers(len(self._scales)))]
                normals = [self._normals(cloud, rng) for cloud in (overlap.source, overlap.target)]
                turn = overlap.target_from_source
                bent = bend(apply(turn, source.points), normals[0] @ turn[:3, :3].T)
                sources.append(self._histograms(*bent, rows, factor, shape, rng))
                bent = bend(target.points, normals[1])
                targets.append(self._histograms(*bent, partner_rows, factor, shape, rng))
                if self.surroundings is not None:
                    around[0].append(self.surroundings.around(overlap.source, rows))
                    around[1].append(self.surroundings.around(overlap.target, partner_rows))
            place_from_source = overlap.place_from_target @ overlap.target_from_source
            moved.append(apply(place_from_source, source.points[rows]))
            partners.append(apply(overlap.place_from_target, target.points[partner_rows]))
            overlaps.append(overlap)
        ignored = self._ignored(overlaps, np.concatenate(moved), np.concatenate(partners))
        np.fill_diagonal(ignored, False)
        means = None if self.surroundings is None else np.concatenate([*around[0], *around[1]])
        return Batch(np.concatenate(sources), np.concatenate(targets), ignored, means)

    def _ignored(
        self, overlaps: list[Overlap], moved: Float64[np.ndarray, "B 3"], partners: Float64[np.ndarray, "B 3"]
    ) -> Bool[np.ndarray, "B B"]:
        """Which partners of others are no negatives: those near, and those of the scene that may be."""
        rows = np.repeat(np.arange(len(overlaps)), len(moved) // len(overlaps))
        scenes, places = np.array([[overlap.scene, overlap.place] for overlap in overlaps]).T
        same_overlap, same_scene = np.equal.outer(rows, rows), np.equal.outer(scenes, scenes)[rows][:, rows]
        known = same_overlap
        if self.negatives == "place":
            known = same_scene & np.equal.outer(places, places)[rows][:, rows]
        # Two fragments of a place lie less exactly than two that were registered with each other.
        least = np.where(same_overlap, 1.5, 3.0) * self.tau
        return same_scene & (~known | (np.linalg.norm(moved[:, None] - partners[None], axis=2) < least))

    def _overlap(
        self, scenes: list[int], count: int, rng: np.random.Generator
    ) -> tuple[Overlap, np.ndarray, np.ndarray]:
        """An overlap of one of the scenes, with rows of `count` correspondences."""
        while True:
            scene = int(rng.choice(scenes))
            overlap = self._scenes[scene][int(rng.integers(len(self._scenes[scene])))]
            if rng.random() < 0.5:
                overlap = _reversed(overlap)
            found = self._correspondences(overlap, count, rng)
            if found is not None:
                return overlap, *found

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
    place_from_source = overlap.place_from_target @ overlap.target_from_source
    return replace(
        overlap,
        source=overlap.target,
        target=overlap.source,
        target_from_source=inverse,
        place_from_target=place_from_source,
    )

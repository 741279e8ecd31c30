"""Triplets exactly as in the paper's section 6.1: 40 a point, 15 of them with a hard negative."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.spatial import cKDTree

from cgf.descriptors.settings import FrameKind
from cgf.descriptors.spherical_histogram import HistogramGrid, histogram_grid
from cgf.geometry.lrf import estimate_lrf
from cgf.geometry.transforms import apply
from cgf.training.fragments import Fragments
from cgf.types import PointCloud, Progress

PER_POINT = 40
HARD_PER_POINT = 15


@dataclass(frozen=True, eq=False)
class TripletBatch:
    """Histograms of the points of a minibatch, and which of them form triplets."""

    histograms: Float32[np.ndarray, "P 2244"]
    rows: tuple[Int64[np.ndarray, "T"], Int64[np.ndarray, "T"], Int64[np.ndarray, "T"]]
    """Rows of `histograms`: anchors, positives, negatives."""


@dataclass(frozen=True, eq=False)
class _View:
    """One cloud with everything that is asked of it again and again."""

    cloud: PointCloud
    rows: Int64[np.ndarray, "R"]
    """Points that have a frame."""
    frames: Float32[np.ndarray, "R 3 3"]
    tree: cKDTree
    """Over `rows`."""
    grid: HistogramGrid


class Triplets:
    """All triplets of an epoch, in random order, without ever being stored.

    Triplet number n belongs to anchor n // 40; which positive and negative it has is a hash of the seed and n, so it
    is the same in each epoch, as if it had been drawn once.
    """

    def __init__(
        self,
        fragments: Fragments,
        *,
        support_radius: float,
        min_radius: float,
        lrf_radius: float,
        frame: FrameKind = "paper",
        soft: bool = False,
        tau: float,
        batch: int,
        seed: int,
        share: slice = slice(None),
        progress: Progress,
    ) -> None:
        """`share` says which of the `batch` triplets of a minibatch are wanted."""
        self.tau, self.batch, self.seed, self.share, self.soft = tau, batch, seed, share, soft
        self._views = []
        for number, cloud in enumerate(fragments.clouds):
            progress(number / len(fragments.clouds), "local reference frames")
            self._views.append(_view(cloud, support_radius, min_radius, lrf_radius, frame))
        position = {id(cloud): number for number, cloud in enumerate(fragments.clouds)}
        self._model_of = {position[id(cloud)]: group for group in fragments.groups for cloud in group}
        self._numbers = {id(group): np.array([position[id(cloud)] for cloud in group]) for group in fragments.groups}
        self._directed = [(o.source, o.target, o.target_from_source) for o in fragments.overlaps] + [
            (o.target, o.source, np.linalg.inv(o.target_from_source)) for o in fragments.overlaps
        ]
        self._anchors, self._starts, self._partners = self._find_anchors(progress)
        self._order: tuple[int, np.ndarray] | None = None

    @property
    def batches_per_epoch(self) -> int:
        """Minibatches in which every triplet comes once; the last, incomplete one is left out."""
        return max(len(self._anchors) * PER_POINT // self.batch, 1)

    def draw(self, step: int) -> TripletBatch:
        """Minibatch number `step`, counted over epochs."""
        epoch, place = divmod(step, self.batches_per_epoch)
        if self._order is None or self._order[0] != epoch:
            numbers = np.arange(len(self._anchors) * PER_POINT, dtype=np.int32)
            self._order = (epoch, np.random.default_rng([self.seed, 11, epoch]).permutation(numbers))
        triplets = self._order[1][place * self.batch : (place + 1) * self.batch][self.share].astype(np.int64)
        points = np.array([self._triplet(int(number)) for number in triplets])  # (T, 3, 2): cloud, entry of its rows
        unique, inverse = np.unique(points.reshape(-1, 2), axis=0, return_inverse=True)
        rows = inverse.reshape(-1, 3)
        return TripletBatch(self._histograms(unique), (rows[:, 0], rows[:, 1], rows[:, 2]))

    def _find_anchors(self, progress: Progress) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points with a partner within tau: (cloud, entry), and for each the directed overlaps that cover it."""
        found = []
        for number, (source, target, pose) in enumerate(self._directed):
            progress(number / len(self._directed), "correspondences")
            moved = apply(pose, self._views[source].cloud.points[self._views[source].rows])
            distances, _ = self._views[target].tree.query(moved, distance_upper_bound=self.tau)
            entries = np.flatnonzero(np.isfinite(distances))
            found.append(np.stack([np.full_like(entries, source), entries, np.full_like(entries, number)], axis=1))
        table = np.concatenate(found)
        table = table[np.lexsort(table.T[::-1])]
        anchors, starts = np.unique(table[:, :2], axis=0, return_index=True)
        return anchors, np.append(starts, len(table)), table[:, 2]

    def _triplet(self, number: int) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
        """Anchor, positive and negative of triplet `number`, each as cloud and entry of its rows."""
        anchor, turn = divmod(number, PER_POINT)
        uniform = _uniform(self.seed, number)
        cloud, entry = (int(value) for value in self._anchors[anchor])
        covering = self._partners[self._starts[anchor] : self._starts[anchor + 1]]
        _, other, pose = self._directed[covering[int(uniform[0] * len(covering))]]
        view = self._views[other]
        position = apply(pose, self._views[cloud].cloud.points[self._views[cloud].rows[entry]][None])[0]
        near = view.tree.query_ball_point(position, self.tau, return_sorted=True)
        positive = near[int(uniform[1] * len(near))]
        if turn < HARD_PER_POINT:
            around = view.tree.query_ball_point(position, 2 * self.tau, return_sorted=True)
            ring = np.setdiff1d(around, near, assume_unique=True)
            if len(ring):
                return (cloud, entry), (other, positive), (other, int(ring[int(uniform[2] * len(ring))]))
        return (cloud, entry), (other, positive), self._anywhere(other, near, uniform[2:])

    def _anywhere(self, other: int, near: list[int], uniform: Float64[np.ndarray, "U"]) -> tuple[int, int]:
        """A point of any cloud of the model; one of the partner's own positives is drawn again."""
        numbers = self._numbers[id(self._model_of[other])]
        for first, second in zip(uniform[::2], uniform[1::2], strict=True):
            cloud = int(numbers[int(first * len(numbers))])
            entry = int(second * len(self._views[cloud].rows))
            if cloud != other or entry not in near:
                break
        return cloud, entry

    def _histograms(self, points: Int64[np.ndarray, "P 2"]) -> Float32[np.ndarray, "P 2244"]:
        rows = np.empty((len(points), 2244), np.float32)
        for number in np.unique(points[:, 0]):
            chosen = points[:, 0] == number
            view, entries = self._views[number], points[chosen, 1]
            centers = view.cloud.points[view.rows[entries]]
            rows[chosen] = view.grid.histograms(centers, view.frames[entries].astype(np.float64), soft=self.soft)[0]
        return rows


def _view(cloud: PointCloud, support_radius: float, min_radius: float, lrf_radius: float, frame: FrameKind) -> _View:
    assert cloud.normals is not None
    everything = np.arange(len(cloud))
    frames, defined = estimate_lrf(cloud.points, cloud.normals, everything, radius=lrf_radius, kind=frame)
    rows = np.flatnonzero(defined)
    grid = histogram_grid(cloud.points, support_radius=support_radius, min_radius=min_radius)
    return _View(cloud, rows, frames[rows].astype(np.float32), cKDTree(cloud.points[rows]), grid)


def _uniform(seed: int, number: int, count: int = 8) -> Float64[np.ndarray, "8"]:
    """Numbers in [0, 1) that depend on nothing but the arguments (SplitMix64, Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        state = (
            np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
            + np.uint64(number) * np.uint64(count)
            + np.arange(count, dtype=np.uint64)
        )
        mixed = state * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2**53

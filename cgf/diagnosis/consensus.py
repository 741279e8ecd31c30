"""Motions that many matches agree on, found without an estimator's luck: the yardstick for what it found.

Pairs of correspondences are compatible where a rigid motion could have made both: their distances agree. Counting
what two compatible ones are compatible with in common separates inliers from chance far better than the pairs alone
(Chen, Sun, Yang, Tao, CVPR 2022, SC2-PCR), so that a few dozen right matches among thousand suffice.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from cgf.geometry import transforms
from cgf.registration.alignment import fit_rigid
from cgf.registration.ransac import SAMPLE
from cgf.types import IsCancelled, raise_if_cancelled

SEEDS = 150
"""Correspondences around which a motion is looked for."""
GROUP = 24
"""Correspondences that a first guess is fitted to."""
SHORTEST_EDGE = 4.0
"""In distances: nearer ones are compatible whatever the motion."""
POLISH_STEPS = 8
CLEARANCE = 2.0
"""Correspondences within this many distances of a motion are not asked for another one."""
SHARED = 0.3
"""Motions that share more of the smaller one's inliers are one."""
SAME_MOTION = 4.0
"""And so are those that take the inliers of one to places less than this many distances apart (RMS)."""


@dataclass(frozen=True, eq=False)
class Consensus:
    """A motion and the correspondences that agree with it."""

    target_from_source: Float64[np.ndarray, "4 4"]
    rows: Int64[np.ndarray, "I"]
    """Of the correspondences given."""


def find_consensus(
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    *,
    distance: float,
    most: int = 2,
    cancelled: IsCancelled | None = None,
) -> list[Consensus]:
    """Motions with the most agreeing correspondences, best first; no two share many of them.

    Args:
        source_points: Of each correspondence; a thousand take a few tenths of a second, time grows with the cube.
        target_points: Their matches, in rows of the same order.
        distance: How far a moved source point may lie from its match, in cloud units.
        most: Motions returned at most.
        cancelled: Asked between motions whether to give up.

    Returns:
        Fewer than `most`, or none, where no more than three correspondences agree.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    found: list[Consensus] = []
    left = np.arange(len(source_points), dtype=np.int64)
    while len(found) < most and len(left) > SAMPLE:
        raise_if_cancelled(cancelled)
        motion = _strongest(source_points[left], target_points[left], distance)
        if motion is None:
            break
        rows = inliers_of(motion, source_points, target_points, distance)
        # Those a little farther off belong to the same motion, not to another one.
        near = inliers_of(motion, source_points[left], target_points[left], CLEARANCE * distance)
        left = np.delete(left, near)
        if not any(_are_alike(motion, rows, other, source_points, distance) for other in found):
            found.append(Consensus(motion, rows))
        if not len(near):
            break
    return sorted(found, key=lambda item: -len(item.rows))


def _strongest(
    source_points: Float64[np.ndarray, "C 3"], target_points: Float64[np.ndarray, "C 3"], distance: float
) -> Float64[np.ndarray, "4 4"] | None:
    """The motion with the most inliers among those fitted around compatible correspondences."""
    weights = compatibility(source_points, target_points, distance=distance).astype(np.float32)
    common: Float32[np.ndarray, "C C"] = weights * (weights @ weights)
    order = np.argsort(-common.sum(axis=1), kind="stable")
    # The strongest, and a spread of the rest: all of the strongest may be of one group.
    seeds = np.unique(np.concatenate([order[: SEEDS // 2], order[SEEDS // 2 :: max(len(order) // SEEDS, 1)]]))
    size = min(GROUP, len(order) - 1)
    best: tuple[int, Float64[np.ndarray, "4 4"]] | None = None
    for seed in seeds.tolist():
        group = np.argpartition(-common[seed], size)[:size]
        group = np.append(group[common[seed, group] > 0], seed)
        if len(group) < SAMPLE:
            continue
        motion, count = _polished(
            fit_rigid(source_points[group], target_points[group]), source_points, target_points, distance
        )
        if best is None or count > best[0]:
            best = count, motion
    return None if best is None or best[0] <= SAMPLE else best[1]


def compatibility(
    source_points: Float64[np.ndarray, "C 3"], target_points: Float64[np.ndarray, "C 3"], *, distance: float
) -> Bool[np.ndarray, "C C"]:
    """Which two correspondences are as far apart in the source as in the target, within `distance`."""
    in_source, in_target = pairwise_distances(source_points), pairwise_distances(target_points)
    near = np.abs(in_source - in_target) <= distance
    return np.asarray(near & (np.minimum(in_source, in_target) >= SHORTEST_EDGE * distance))


def pairwise_distances(points: Float64[np.ndarray, "C 3"]) -> Float32[np.ndarray, "C C"]:
    """Distance of every two of `points`, in cloud units."""
    centred = (points - points.mean(axis=0)).astype(np.float32)
    sq = np.square(centred).sum(axis=1)
    return np.sqrt(np.maximum(sq[:, None] + sq[None] - 2 * centred @ centred.T, 0))


def motion_difference(
    first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"], points: Float64[np.ndarray, "N 3"]
) -> float:
    """Root mean square distance between the images of `points`, in cloud units."""
    offsets = transforms.apply(first, points) - transforms.apply(second, points)
    return float(np.sqrt(np.square(offsets).sum(axis=1).mean()))


def inliers_of(
    motion: Float64[np.ndarray, "4 4"],
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    distance: float,
) -> Int64[np.ndarray, "I"]:
    """Rows of correspondences that `motion` brings within `distance` of each other."""
    offsets = transforms.apply(motion, source_points) - target_points
    return np.flatnonzero(np.square(offsets).sum(axis=1) <= distance**2)


def _polished(
    motion: Float64[np.ndarray, "4 4"],
    source_points: Float64[np.ndarray, "C 3"],
    target_points: Float64[np.ndarray, "C 3"],
    distance: float,
) -> tuple[Float64[np.ndarray, "4 4"], int]:
    """Least squares over the inliers while they grow in number; the motion and that number."""
    rows = inliers_of(motion, source_points, target_points, distance)
    for _ in range(POLISH_STEPS):
        if len(rows) < SAMPLE:
            break
        refined = fit_rigid(source_points[rows], target_points[rows])
        refined_rows = inliers_of(refined, source_points, target_points, distance)
        if len(refined_rows) <= len(rows):
            break
        motion, rows = refined, refined_rows
    return motion, len(rows)


def _are_alike(
    motion: Float64[np.ndarray, "4 4"],
    rows: Int64[np.ndarray, "I"],
    other: Consensus,
    source_points: Float64[np.ndarray, "C 3"],
    distance: float,
) -> bool:
    shared = len(np.intersect1d(rows, other.rows))
    if shared > SHARED * min(len(rows), len(other.rows)):
        return True
    return motion_difference(motion, other.target_from_source, source_points[other.rows]) <= SAME_MOTION * distance

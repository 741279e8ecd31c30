"""Everything that a diagnosis rests on, measured; nothing is judged here."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from cgf.diagnosis.case import Case
from cgf.diagnosis.consensus import Consensus, find_consensus, inliers_of, motion_difference, pairwise_distances
from cgf.diagnosis.findings import Outcome
from cgf.diagnosis.likeness import Likeness, compare
from cgf.diagnosis.surfaces import Surface, measure, stability
from cgf.diagnosis.trials import Trial
from cgf.evaluation.metrics import correspondence_errors, precision
from cgf.geometry import transforms
from cgf.geometry.neighbors import build_tree, median_spacing
from cgf.types import IsCancelled, Progress, raise_if_cancelled

FAR = 3.0
"""Places this many precision radii apart are different ones."""
RELIABLE_COUNT = 20
RELIABLE_LEAD = 1.8
"""Times as many matches as the next best pose has.

Of the 98 pairs that the rules were measured on, 97 have a right pose in front: all but one by 2.1 times or more,
that one by 1.6. Wrong ones lead by 1.6 times at most, with earlier weights, or fall under the limit below.
"""
RELIABLE_STABILITY = 0.008
"""Of the points whose matches agree. Right poses have 0.016 or more, but for one with 0.003; wrong ones, which fit one
plane, 0.006 or less, with earlier weights."""
RIGHT = 2.0
"""An estimate is right if it is off by at most so many precision radii over the overlap (RMS): 20 cm in rooms."""
SCALE_SAMPLE = 400
SCALE_STEP = 0.0125


@dataclass(frozen=True, eq=False)
class UnderPose:
    """Both clouds as one pose lays them over each other."""

    overlaps: Bool[np.ndarray, "N"]
    """Which source points have a target point within tau."""
    opposed: float
    """Share of these whose normal points against the target's."""
    agreeing: int
    """Asked matches within the inlier distance."""
    precision: float
    """Share of matches within the precision radius, of points that overlap; nan without any."""
    stability: float
    """Of the overlapping points."""

    @property
    def overlap(self) -> float:
        """Share of source points that overlap."""
        return float(self.overlaps.mean())


@dataclass(frozen=True, eq=False)
class Measures:
    """All measures of one case."""

    case: Case
    source: Surface
    target: Surface
    loaded_spacings: tuple[float, float]
    likeness: Likeness
    asked: Int64[np.ndarray, "C"]
    """Rows of the match table that were asked for poses."""
    poses: tuple[Consensus, ...]
    """That most of these agree on, best first; rows count `asked`."""
    scale: float
    """That makes the most distances between matches agree, near 1."""
    scale_gain: float
    """How many times more of them agree than with a scale of 1."""
    truth: UnderPose | None
    estimate: UnderPose | None
    best: UnderPose | None
    """Under `pose`."""
    inverse_overlap: float
    """Under the inverse of the true pose; 0 without one."""
    trials: dict[str, Trial] = field(default_factory=dict)
    """Remedies that were tried, by the kind of finding that they belong to."""

    @property
    def outcome(self) -> Outcome:
        """Whether the estimate can be trusted: by the true pose where it is known, else by the matches themselves."""
        if self.case.truth is None and self.case.estimate is not None and self.pose is None:
            return "doubtful"
        return "registered" if self.is_estimate_right else "failed"

    @property
    def counts(self) -> tuple[int, int]:
        """Matches that agree on the best and on the second pose."""
        numbers = [len(pose.rows) for pose in self.poses] + [0, 0]
        return numbers[0], numbers[1]

    @cached_property
    def pose_stability(self) -> float:
        """Of the points whose matches agree on the best pose."""
        if not self.poses:
            return 0.0
        assert self.case.source.normals is not None
        rows = self.case.table.correspondences.indices[self.asked[self.poses[0].rows], 0]
        return stability(self.case.source.points[rows], self.case.source.normals[rows])

    @property
    def pose(self) -> Float64[np.ndarray, "4 4"] | None:
        """The pose that most matches agree on, if that can be relied on."""
        first, second = self.counts
        is_reliable = first >= max(RELIABLE_COUNT, RELIABLE_LEAD * second)
        return self.poses[0].target_from_source if is_reliable and self.pose_stability >= RELIABLE_STABILITY else None

    @cached_property
    def estimate_error(self) -> float:
        """How far the estimate is from the true pose, or else from `pose`, over the points that overlap (RMS).

        In cloud units; infinite without an estimate, nan where there is nothing to compare with.
        """
        case = self.case
        known = case.truth if case.truth is not None else self.pose
        under = self.truth if case.truth is not None else self.best
        if case.estimate is None:
            return np.inf
        if known is None or under is None:
            return np.nan
        points = case.source.points[under.overlaps] if under.overlaps.any() else case.source.points
        return motion_difference(case.estimate, known, points)

    @property
    def is_estimate_right(self) -> bool:
        """Whether the estimate is near the true pose, or near `pose` where that is all there is."""
        return bool(self.estimate_error <= RIGHT * self.case.settings.precision_radius)


def take_measures(case: Case, *, progress: Progress | None = None, cancelled: IsCancelled | None = None) -> Measures:
    """Measure a case; a second for 15,000 points a cloud.

    Raises:
        Cancelled: `cancelled` returned True.
    """

    def stage(share: float, text: str) -> None:
        raise_if_cancelled(cancelled)
        if progress is not None:
            progress(share, text)

    settings = case.settings
    stage(0.0, "Looking at the surfaces")
    source, target = measure(case.source, settings), measure(case.target, settings)
    spacings = median_spacing(case.loaded_source.points), median_spacing(case.loaded_target.points)
    stage(0.2, "Comparing features")
    likeness = compare(
        case.source,
        case.target,
        case.source_features,
        case.target_features,
        far=FAR * settings.precision_radius,
        cancelled=cancelled,
    )
    stage(0.5, "Asking matches for poses")
    asked = case.asked()
    ends = case.ends(asked)
    poses = find_consensus(*ends, distance=settings.inlier_distance, cancelled=cancelled)
    scale, gain = scale_of(ends[0][:SCALE_SAMPLE], ends[1][:SCALE_SAMPLE], shortest=8 * settings.inlier_distance)
    stage(0.8, "Laying the clouds over each other")

    def under(pose: Float64[np.ndarray, "4 4"] | None) -> UnderPose | None:
        return None if pose is None else under_pose(case, asked, pose)

    inverse = 0.0
    if case.truth is not None:
        inverse = under_pose(case, asked, transforms.invert(case.truth)).overlap
    measured = Measures(
        case, source, target, spacings, likeness, asked, tuple(poses), scale, gain,
        truth=under(case.truth), estimate=under(case.estimate), best=None, inverse_overlap=inverse,
    )  # fmt: skip
    return replace(measured, best=under(measured.pose))


def under_pose(case: Case, asked: Int64[np.ndarray, "C"], pose: Float64[np.ndarray, "4 4"]) -> UnderPose:
    """Lay the source over the target."""
    settings, source, target = case.settings, case.source, case.target
    assert source.normals is not None
    assert target.normals is not None
    distances, nearest = build_tree(target.points).query(
        transforms.apply(pose, source.points), distance_upper_bound=settings.tau, workers=-1
    )
    overlaps = np.isfinite(distances)
    turned = transforms.rotate(pose, source.normals[overlaps])
    cosines = np.einsum("ij,ij->i", turned, target.normals[nearest[overlaps]])
    ends = case.ends(asked)
    indices = case.table.correspondences.indices
    errors = correspondence_errors(source.points, target.points, indices, pose)
    return UnderPose(
        overlaps=overlaps,
        opposed=float(np.mean(cosines < -0.5)) if len(cosines) else 0.0,
        agreeing=len(inliers_of(pose, *ends, settings.inlier_distance)),
        precision=precision(errors[overlaps[indices[:, 0]]], threshold=settings.precision_radius),
        stability=stability(source.points[overlaps], source.normals[overlaps]),
    )


def scale_of(
    source_points: Float64[np.ndarray, "C 3"], target_points: Float64[np.ndarray, "C 3"], *, shortest: float
) -> tuple[float, float]:
    """The scale between 0.7 and 1.4 of the source that makes most distances between matches agree within 2 %.

    Args:
        source_points: Of each match.
        target_points: Of each match.
        shortest: Shorter distances say little about the scale, in cloud units.

    Returns:
        The scale, and how many times more distances agree with it than with 1; or 1 and 1 where nothing stands out.
    """
    if len(source_points) < 3:
        return 1.0, 1.0
    rows, columns = np.triu_indices(len(source_points), 1)
    in_source, in_target = (pairwise_distances(points)[rows, columns] for points in (source_points, target_points))
    long = np.minimum(in_source, in_target) >= shortest
    logs = np.sort(np.log(in_target[long] / in_source[long]))
    steps = np.arange(-28, 29) * SCALE_STEP
    counts = np.searchsorted(logs, steps + 0.02) - np.searchsorted(logs, steps - 0.02)
    peak = int(np.argmax(counts))
    if counts[peak] < 2 * max(float(np.median(counts)), 1.0):
        return 1.0, 1.0
    middle = float(steps[peak])
    for _ in range(5):
        middle = float(np.median(logs[np.searchsorted(logs, middle - 0.02) : np.searchsorted(logs, middle + 0.02)]))
    return float(np.exp(middle)), float(counts[peak] / max(counts[28], 1))

"""Poses of a pair: which are known, how good each is, and the way between two of them."""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from app.analysis import Analysis, kept_rows
from app.runs import Run
from app.settings import ViewSettings
from cgf.evaluation.metrics import correspondence_errors
from cgf.geometry import transforms
from cgf.geometry.neighbors import build_tree
from cgf.types import PointCloud, Transform

Floats = npt.NDArray[np.float64]

LOADED = np.eye(4)
"""The pose of the files."""


@dataclass(frozen=True)
class ShownPose:
    """Where the source is drawn."""

    name: str | None
    """Of the pose, or None between two."""
    matrix: Transform
    ends: tuple[Transform, ...]
    """What the view should hold: both ends of the way, or the pose itself."""
    key: tuple[object, ...]
    """Changes when the camera should be set anew."""


@dataclass(frozen=True)
class PoseRow:
    """How good one pose is, measured alike for all: within the pair's inlier distance."""

    name: str
    label: str
    found: bool
    inliers: int | None
    """Correspondences that pass the filters and agree."""
    correspondences: int | None
    fitness: float | None
    """Share of prepared source points with a target point near them."""
    rmse: float | None
    """Root mean square distance of those, in cloud units."""
    rotation_error_deg: float | None
    """Against the ground truth; None without one."""
    translation_error: float | None
    elapsed_s: float | None
    is_estimate: bool
    """Whether errors can be measured against it as "the estimate" now."""


def known_poses(analysis: Analysis) -> dict[str, Transform]:
    """`target_from_source` of every pose that can be shown, by name."""
    known: dict[str, Transform | None] = {
        "ground_truth": analysis.truth,
        "estimate": analysis.estimate,
        "loaded": LOADED,
        "automatic": analysis.automatic_estimate,
        **{run.name: run.result.target_from_source for run in analysis.runs},
    }
    return {name: pose for name, pose in known.items() if pose is not None}


def shown_pose(analysis: Analysis, settings: ViewSettings) -> ShownPose:
    """The pose to draw: the wanted one where it is known, else the best; or a place on the way between two."""
    known = known_poses(analysis)
    name = next(name for name in (settings.pose_to, settings.pose, *known) if name in known)
    end = known[name]
    if settings.pose_from is None or settings.pose_from not in known:
        return ShownPose(name, end, (end,), (name,))
    start = known[settings.pose_from]
    source = analysis.source.points
    center = (source.min(axis=0) + source.max(axis=0)) / 2
    share = settings.pose_share
    matrix = end if share == 1 else start if share == 0 else transforms.interpolate(start, end, share, center)
    shown = {0.0: settings.pose_from, 1.0: name}.get(share)
    return ShownPose(shown, matrix, (start, end), ("between", settings.pose_from, name))


_TREES: WeakKeyDictionary[PointCloud, Any] = WeakKeyDictionary()
"""Clouds never change, and a slider asks often."""


def residuals(analysis: Analysis, pose: Transform, *, limit: float) -> tuple[Floats, Floats]:
    """Distance from each prepared source point to the nearest target point under `pose`, and the reverse.

    Args:
        analysis: Of the pair.
        pose: `target_from_source`.
        limit: Distances from here on all count as this much, in cloud units.
    """
    source, target = analysis.source, analysis.target
    back = transforms.invert(pose)
    return (
        _distances(target, transforms.apply(pose, source.points), limit),
        _distances(source, transforms.apply(back, target.points), limit),
    )


def _distances(cloud: PointCloud, points: Floats, limit: float) -> Floats:
    tree = _TREES.get(cloud)
    if tree is None:
        tree = _TREES[cloud] = build_tree(cloud.points)
    distances, _ = tree.query(points, distance_upper_bound=limit, workers=-1)
    return np.minimum(distances, limit)


class PoseTable:
    """Rows of the known poses; what was measured once is kept until clouds, matches or filters change."""

    def __init__(self) -> None:
        self._measured: dict[int, tuple[Transform, _Measured]] = {}
        self._basis: tuple[object, ...] = ()

    def rows(self, analysis: Analysis, settings: ViewSettings) -> tuple[PoseRow, ...]:
        """Every pose that is known, and every run, also those that found nothing."""
        filters = (settings.mutual, settings.max_ratio, settings.surest)
        basis = (id(analysis.source), id(analysis.target), id(analysis.matches), *filters)
        if basis != self._basis:
            self._measured, self._basis = {}, basis
        chosen = analysis.chosen_run
        listed: list[tuple[str, str, Transform | None, Run | None]] = [("loaded", "As loaded", LOADED, None)]
        if analysis.truth is not None:
            listed.append(("ground_truth", "Ground truth", analysis.truth, None))
        automatic = "Estimate given" if analysis.given_estimate is not None else "Estimate"
        if analysis.automatic_estimate is not None:
            listed.append(("automatic", automatic, analysis.automatic_estimate, None))
        listed += [(run.name, run.label, run.result.target_from_source, run) for run in analysis.runs]
        current = "automatic" if chosen is None else chosen.name
        return tuple(
            self._row(analysis, settings, pose, name, label, run, is_estimate=name == current)
            for name, label, pose, run in listed
        )

    def _row(
        self, analysis: Analysis, settings: ViewSettings, pose: Transform | None, name: str, label: str,
        run: Run | None, *, is_estimate: bool,
    ) -> PoseRow:  # fmt: skip
        measured = _Measured() if pose is None else self._measure(analysis, settings, pose)
        truth = analysis.truth
        compared = pose is not None and truth is not None and name != "ground_truth"
        return PoseRow(
            name=name,
            label=label,
            found=pose is not None,
            inliers=measured.inliers,
            correspondences=measured.correspondences,
            fitness=measured.fitness,
            rmse=measured.rmse,
            rotation_error_deg=transforms.rotation_error_deg(pose, truth) if compared else None,  # type: ignore[arg-type]
            translation_error=transforms.translation_error(pose, truth) if compared else None,  # type: ignore[arg-type]
            elapsed_s=None if run is None else run.elapsed_s,
            is_estimate=is_estimate,
        )

    def _measure(self, analysis: Analysis, settings: ViewSettings, pose: Transform) -> "_Measured":
        if id(pose) in self._measured:
            return self._measured[id(pose)][1]
        near = analysis.resolved.inlier_distance
        source, target, matches = analysis.source, analysis.target, analysis.matches
        distances = _distances(target, transforms.apply(pose, source.points), near)
        within = distances[distances < near]
        inliers = count = None
        if matches is not None:
            indices = matches.correspondences.indices[kept_rows(matches, settings)]
            errors = correspondence_errors(source.points, target.points, indices, pose)
            inliers, count = int(np.count_nonzero(errors <= near)), len(indices)
        measured = _Measured(
            inliers, count, len(within) / len(source), float(np.sqrt(np.mean(within**2))) if len(within) else None
        )
        # The pose is kept with its measures, so that no other can come to have its identity.
        self._measured[id(pose)] = (pose, measured)
        return measured


@dataclass(frozen=True)
class _Measured:
    inliers: int | None = None
    correspondences: int | None = None
    fitness: float | None = None
    rmse: float | None = None

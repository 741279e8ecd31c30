"""The values that pass between stages, and the protocols that stages implement."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

Points = Float64[np.ndarray, "N 3"]
Indices = Int64[np.ndarray, "K"]
Transform = Float64[np.ndarray, "4 4"]

Progress = Callable[[float, str], None]
"""Told the share done in [0, 1] and what is being done."""
IsCancelled = Callable[[], bool]
"""Asked between chunks of long work whether to give up."""


class Cancelled(Exception):
    """Long work was given up because its caller no longer wants the result."""


def raise_if_cancelled(cancelled: IsCancelled | None) -> None:
    """Raise `Cancelled` if the caller has given up."""
    if cancelled is not None and cancelled():
        raise Cancelled


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with what is known of them; rows of all arrays belong together."""

    points: Float64[np.ndarray, "N 3"]
    """Finite coordinates, in cloud units."""
    normals: Float64[np.ndarray, "N 3"] | None = None
    """Unit vectors on the side of the sensor, or None where unknown."""
    colors: UInt8[np.ndarray, "N 3"] | None = None
    """The sensor's own colours, red, green, blue."""
    name: str = ""
    """What a person calls this cloud, mostly its file name."""
    viewpoint: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Position of the sensor in the cloud's frame; normals are oriented to it."""

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def diameter(self) -> float:
        """Diagonal of the axis-aligned bounding box, in cloud units."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0))) if len(self.points) else 0.0

    def take(self, indices: Int64[np.ndarray, "K"]) -> "PointCloud":
        """The cloud of the rows `indices`, in that order."""
        return replace(
            self,
            points=self.points[indices],
            normals=None if self.normals is None else self.normals[indices],
            colors=None if self.colors is None else self.colors[indices],
        )


@dataclass(frozen=True, eq=False)
class Features:
    """Descriptor vectors of some points of one cloud."""

    indices: Int64[np.ndarray, "K"]
    """Rows of the cloud that are described; points without a frame are left out."""
    vectors: Float32[np.ndarray, "K D"]
    """One row per entry of `indices`."""
    descriptor: str
    """Name of the descriptor, e.g. `cgf`."""
    quality: Float32[np.ndarray, "K"] | None = None
    """How distinctive each feature is, as estimated from itself alone: the probability, in training, that its nearest
    neighbour was right. None where the descriptor does not say."""

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def dim(self) -> int:
        """Number of columns of `vectors`."""
        return int(self.vectors.shape[1])


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Matches from a source to a target cloud."""

    indices: Int64[np.ndarray, "C 2"]
    """Source row, target row (rows of the clouds, not of the features)."""
    distances: Float32[np.ndarray, "C"]
    """Euclidean distance in feature space."""
    ratios: Float32[np.ndarray, "C"]
    """Distance over the distance of the second nearest, in [0, 1]; small is distinctive."""

    def __len__(self) -> int:
        return len(self.indices)

    def take(self, rows: Int64[np.ndarray, "R"]) -> "Correspondences":
        """The correspondences `rows`, in that order."""
        return Correspondences(self.indices[rows], self.distances[rows], self.ratios[rows])


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """What an estimator found."""

    target_from_source: Float64[np.ndarray, "4 4"] | None
    """Maps the source onto the target; None where nothing was found."""
    inliers: Int64[np.ndarray, "I"]
    """Rows of the correspondences that fit."""
    fitness: float
    """Share of source points with a target point within the inlier distance, after moving."""
    inlier_rmse: float
    """Root mean square distance of those, in cloud units; nan where there are none."""
    method: str
    """Name of the estimator."""


@runtime_checkable
class Descriptor(Protocol):
    """Describes the surface around points of a cloud by vectors."""

    @property
    def name(self) -> str: ...

    @property
    def dim(self) -> int: ...

    def describe(
        self,
        cloud: PointCloud,
        indices: Int64[np.ndarray, "K"],
        *,
        progress: Progress | None = None,
        cancelled: IsCancelled | None = None,
    ) -> Features:
        """Describe rows `indices` of `cloud`, whose normals are present; rows that cannot be are left out."""
        ...


@runtime_checkable
class Estimator(Protocol):
    """Finds the rigid motion that most correspondences agree with."""

    @property
    def name(self) -> str: ...

    def estimate(
        self,
        source: PointCloud,
        target: PointCloud,
        correspondences: Correspondences,
        *,
        progress: Progress | None = None,
        cancelled: IsCancelled | None = None,
    ) -> RegistrationResult: ...


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds of a data set, with their true relative pose where it is known."""

    name: str
    source: PointCloud
    target: PointCloud
    target_from_source: Float64[np.ndarray, "4 4"] | None = None

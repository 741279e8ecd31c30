"""One point of a pair in detail: what its descriptor sees, and how every point of the other cloud compares."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, Float64, Int64

from cgf.checks import check_count
from cgf.descriptors.network import NetworkCard, load_network
from cgf.descriptors.settings import AZIMUTH_BINS, ELEVATION_BINS, RADIAL_BINS
from cgf.geometry import transforms
from cgf.pipeline.settings import ResolvedSettings
from cgf.pipeline.stages import PairResult
from cgf.types import Features, PointCloud

if TYPE_CHECKING:
    from cgf.descriptors.spherical_histogram import HistogramGrid

Side = Literal["source", "target"]
Histogram = Float32[np.ndarray, "12 11 17"]

ALIKE = 0.9
"""Features count as alike where the nearest's distance is at least this share of theirs, as in a usual ratio test."""
MOST_MODES = 100
_CHUNK = 65_536


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the descriptor sees around one point."""

    row: int
    """Of the prepared cloud."""
    frame: Float64[np.ndarray, "3 3"] | None
    """Local reference frame, rows x, y, z; None where there are too few neighbours or the descriptor uses none."""
    histogram: Histogram | None
    """Share of the neighbours in each azimuth sector, elevation ring (from the z axis down) and shell (outwards)."""
    neighbors: int
    """Points within the support radius, the point itself not among them."""


@dataclass(frozen=True, eq=False)
class PointInspection:
    """A point, the points of the other cloud that look most like it, and its true partner."""

    side: Side
    point: Surroundings
    match: Surroundings | None
    """The nearest in feature space; None where the point or the whole other cloud has no feature."""
    partner: Surroundings | None
    """The point nearest to the true place; None where no pose is known, or none comes within `tau`."""
    partner_rank: int | None
    """Place of the partner by feature distance, 1 for the match; None without a partner that has a feature."""
    partner_gap: float
    """From the true place to the nearest point of the other cloud, in cloud units; nan where no pose is known."""
    distances: Float32[np.ndarray, "M"]
    """Feature distance to every point of the other cloud, by its row; nan where either has no feature."""
    own_distances: Float32[np.ndarray, "N"]
    """The same to every point of its own cloud."""
    nearest: Int64[np.ndarray, "K"]
    """Rows of the other cloud by feature distance: the match and the runners-up; ties go to the lower row."""
    errors: Float64[np.ndarray, "K"]
    """How far each of `nearest` lies from the true place, in cloud units; nan where no pose is known."""
    modes: Int64[np.ndarray, "_"]
    """Rows of the other cloud, the match first: places far from each other that all look like the match, see `ALIKE`.

    Two or more mean that the surface repeats itself, or that the feature says too little.
    """


def inspect_point(
    result: PairResult,
    row: int,
    *,
    side: Side = "source",
    target_from_source: Float64[np.ndarray, "4 4"] | None = None,
    count: int = 8,
) -> PointInspection:
    """Compare one point with all points of the other cloud.

    The first call for a cloud and radius prepares it; later ones take milliseconds.

    Args:
        result: What `run_pair` gave.
        row: Of the prepared cloud, `result.source` or `result.target`.
        side: The cloud that `row` counts in.
        target_from_source: The true pose, or an estimate to judge by.
        count: How many of the nearest to list, the match included.

    Raises:
        ValueError: There is no such row, or `count` is below 1.
    """
    cloud, features = getattr(result, side), getattr(result, f"{side}_features")
    other_side = "target" if side == "source" else "source"
    other, other_features = getattr(result, other_side), getattr(result, f"{other_side}_features")
    if not 0 <= row < len(cloud):
        raise ValueError(f"row must be from 0 to {len(cloud) - 1} for the {side}, got {row}")
    check_count(count, "count", minimum=1)
    vector = features.vectors[features.indices == row]
    distances = _feature_distances(vector, other_features, len(other))
    order = _order(distances, other_features)
    nearest = order[:count]
    errors, partner, gap = np.full(len(nearest), np.nan), None, math.nan
    if target_from_source is not None:
        other_from_own = target_from_source if side == "source" else transforms.invert(target_from_source)
        place = transforms.apply(other_from_own, cloud.points[row : row + 1])[0]
        gaps = np.linalg.norm(other.points - place, axis=1)
        errors = gaps[nearest]
        closest = int(np.argmin(gaps))
        gap = float(gaps[closest])
        partner = closest if gap <= result.settings.tau else None
    ranked = np.flatnonzero(order == partner) if partner is not None else np.zeros(0, dtype=np.int64)
    return PointInspection(
        side=side,
        point=surroundings(cloud, row, result.settings),
        match=surroundings(other, int(nearest[0]), result.settings) if len(nearest) else None,
        partner=None if partner is None else surroundings(other, partner, result.settings),
        partner_rank=int(ranked[0]) + 1 if len(ranked) else None,
        partner_gap=gap,
        distances=distances,
        own_distances=_feature_distances(vector, features, len(cloud)),
        nearest=nearest,
        errors=errors,
        modes=far_modes(other.points, distances, apart=result.settings.support_radius / 2),
    )


def surroundings(cloud: PointCloud, row: int, settings: ResolvedSettings) -> Surroundings:
    """Frame and spherical histogram of one point of a prepared cloud, as its descriptor gets them."""
    frame = frames(cloud, np.array([row], dtype=np.int64), settings)[0]
    if not frame.any():
        return Surroundings(row, None, None, 0)
    soft = _card(settings).soft
    rows, counts = _grid(cloud, settings).histograms(cloud.points[row : row + 1], frame[None], soft=soft)
    # Radial bins are the fastest, azimuth the slowest.
    histogram = rows[0].reshape(AZIMUTH_BINS, ELEVATION_BINS, RADIAL_BINS)
    return Surroundings(row, frame, histogram if counts[0] else None, int(counts[0]))


def uses_frames(settings: ResolvedSettings) -> bool:
    """Whether the descriptor describes a point in a local reference frame."""
    return settings.descriptor in ("cgf", "pca")


def frames(cloud: PointCloud, rows: Int64[np.ndarray, "K"], settings: ResolvedSettings) -> Float64[np.ndarray, "K 3 3"]:
    """The local reference frames in which `rows` of a prepared cloud are described; zeros where there is none."""
    if cloud.normals is None or not uses_frames(settings):
        return np.zeros((len(rows), 3, 3))
    from cgf.geometry.lrf import estimate_lrf  # on first use: Numba takes a second to import

    kind = _card(settings).frame
    return estimate_lrf(cloud.points, cloud.normals, rows, radius=settings.lrf_radius, kind=kind)[0]


def _card(settings: ResolvedSettings) -> NetworkCard:
    return load_network(settings.descriptor, settings.model, settings.weights).card


def far_modes(
    points: Float64[np.ndarray, "M 3"], distances: Float32[np.ndarray, "M"], *, apart: float
) -> Int64[np.ndarray, "_"]:
    """The places whose features are about as near as the nearest one, one point each.

    Args:
        points: Of the cloud searched.
        distances: Feature distance of each; nan where there is none.
        apart: How far places must lie from each other to count apart, in cloud units.

    Returns:
        Rows of `points` by feature distance, at most `MOST_MODES`; none where all distances are nan.
    """
    known = np.flatnonzero(np.isfinite(distances))
    if not len(known):
        return np.zeros(0, dtype=np.int64)
    alike = known[distances[known] * np.float32(ALIKE) <= distances[known].min()]
    left = alike[np.argsort(distances[alike], kind="stable")]
    modes: list[int] = []
    while len(left) and len(modes) < MOST_MODES:
        modes.append(int(left[0]))
        left = left[np.linalg.norm(points[left] - points[left[0]], axis=1) > apart]
    return np.array(modes, dtype=np.int64)


def shell_edges(settings: ResolvedSettings) -> Float64[np.ndarray, "18"]:
    """Radii between the shells of the spherical histogram, from 0 to the support radius, in cloud units."""
    from cgf.descriptors import spherical_histogram

    radii = {"support_radius": settings.support_radius, "min_radius": settings.min_radius}
    return np.concatenate([[0.0], spherical_histogram.shell_edges(0, **radii), [settings.support_radius]])


def best_turn(histogram: Histogram, other: Histogram) -> int:
    """By how many azimuth sectors `other` must be turned (`np.roll` along its first axis) to fit `histogram` best.

    The learned feature treats the sectors alike, so such a turn is no difference to it.
    """
    roots, other_roots = np.sqrt(histogram), np.sqrt(other)
    misfit = [np.square(roots - np.roll(other_roots, turn, axis=0)).sum() for turn in range(AZIMUTH_BINS)]
    return int(np.argmin(misfit))


_GRIDS: WeakKeyDictionary[PointCloud, tuple[tuple[float, float], "HistogramGrid"]] = WeakKeyDictionary()
"""The last one of each cloud; points are picked one after the other with the same radii."""


def _grid(cloud: PointCloud, settings: ResolvedSettings) -> "HistogramGrid":
    from cgf.descriptors.spherical_histogram import histogram_grid

    key = (settings.support_radius, settings.min_radius)
    kept = _GRIDS.get(cloud)
    if kept is None or kept[0] != key:
        grid = histogram_grid(cloud.points, support_radius=settings.support_radius, min_radius=settings.min_radius)
        kept = _GRIDS[cloud] = (key, grid)
    return kept[1]


def _feature_distances(
    vector: Float32[np.ndarray, "one D"], features: Features, count: int
) -> Float32[np.ndarray, "M"]:
    """Euclidean distances from `vector`, which may be missing, to the features of a cloud of `count` points."""
    distances = np.full(count, np.nan, dtype=np.float32)
    if len(vector):
        exact = vector[0].astype(np.float64)
        for start in range(0, len(features), _CHUNK):
            rows = slice(start, start + _CHUNK)
            difference = features.vectors[rows] - exact
            distances[features.indices[rows]] = np.sqrt(np.square(difference).sum(axis=1))
    return distances


def _order(distances: Float32[np.ndarray, "M"], features: Features) -> Int64[np.ndarray, "F"]:
    """Rows of the cloud that have a feature, the nearest first."""
    rows = np.sort(features.indices[np.isfinite(distances[features.indices])])
    return rows[np.argsort(distances[rows], kind="stable")]

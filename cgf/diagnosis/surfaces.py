"""What can be told from one cloud alone: its points, its normals, its shape."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from cgf.geometry.neighbors import build_tree
from cgf.pipeline import ResolvedSettings
from cgf.types import PointCloud

SAMPLE = 2_000
NEIGHBORS = 16
SAME_LINE = 0.7
"""Cosine above which two neighbouring normals belong to one smooth surface, but for their signs."""
FEW_NEIGHBORS = 12
"""Fewer neighbours than this give no frame that is to be relied on."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Measures of one prepared cloud, over an even sample of its points."""

    points: int
    spacing: float
    """Median distance to the nearest other point, in cloud units."""
    sampled: Int64[np.ndarray, "K"]
    """Rows that were looked at."""
    opposed: Float64[np.ndarray, "K"]
    """Share of smooth neighbours whose normal points the other way."""
    angles_deg: Float64[np.ndarray, "K"]
    """Between the normal and that of the plane through the neighbours, sides aside; 0 where none are near."""
    frame_neighbors: int
    """Median count within the frame radius."""
    support_neighbors: int
    """Median count within the support radius."""
    stability: float
    """Least constrained motion over the most constrained; see `stability`."""
    free_motions: int
    """How many of the six motions hardly change the surface."""
    facing: float
    """Share of points whose normal faces the viewpoint."""
    normal_spread: float
    """Second eigenvalue of the normals' scatter over the first: 0 for a plane."""

    @property
    def opposed_share(self) -> float:
        """Share of points most of whose smooth neighbours have a normal that points the other way."""
        return float(self.is_opposed.mean())

    @property
    def is_opposed(self) -> Bool[np.ndarray, "K"]:
        """Which sampled points these are."""
        return np.asarray(self.opposed >= 0.5)

    @property
    def tilt_deg(self) -> float:
        """Median of `angles_deg`."""
        return float(np.median(self.angles_deg))


def measure(cloud: PointCloud, settings: ResolvedSettings) -> Surface:
    """Look at an even sample of a prepared cloud."""
    assert cloud.normals is not None
    rows = even_rows(len(cloud), SAMPLE)
    tree = build_tree(cloud.points)
    count = min(NEIGHBORS, len(cloud))
    distances, neighbors = tree.query(cloud.points[rows], k=count, workers=-1)
    cosines = np.einsum("ki,kni->kn", cloud.normals[rows], cloud.normals[neighbors[:, 1:]])
    # Where points are sparse, neighbours tell of the shape around and not of the surface.
    near = distances[:, -1] <= settings.lrf_radius
    smooth = (np.abs(cosines) > SAME_LINE) & near[:, None]
    opposed = ((cosines < 0) & smooth).sum(axis=1) / np.maximum(smooth.sum(axis=1), 1)
    offsets = cloud.points[neighbors] - cloud.points[neighbors].mean(axis=1, keepdims=True)
    fitted = np.linalg.eigh(np.einsum("kni,knj->kij", offsets, offsets))[1][:, :, 0]
    cosine = np.abs(np.einsum("ki,ki->k", fitted, cloud.normals[rows]))
    values, _ = constraints(cloud.points[rows], smoothed_normals(cloud, rows, neighbors))
    scatter = np.linalg.eigvalsh(cloud.normals[rows].T @ cloud.normals[rows])
    few = rows[:: max(len(rows) // 200, 1)]
    frame, support = (
        int(np.median(tree.query_ball_point(cloud.points[few], radius, return_length=True, workers=-1)))
        for radius in (settings.lrf_radius, settings.support_radius)
    )
    return Surface(
        points=len(cloud),
        spacing=float(np.median(distances[:, min(1, count - 1)])),
        sampled=rows,
        opposed=opposed,
        angles_deg=np.where(near, np.degrees(np.arccos(np.clip(cosine, 0, 1))), 0.0),
        frame_neighbors=frame - 1,
        support_neighbors=support - 1,
        stability=float(values[0] / values[-1]),
        free_motions=int(np.count_nonzero(values < FREE_MOTION * values[-1])),
        facing=float(np.mean(np.einsum("ki,ki->k", cloud.normals[rows], cloud.viewpoint - cloud.points[rows]) > 0)),
        normal_spread=float(scatter[1] / scatter[2]),
    )


FREE_MOTION = 0.008
"""Motions with less than this share of the strongest one's constraint hardly change the surface.

All fragments but one of the 98 pairs have 0.011 or more; made planes, spheres and cylinders have 0.0001 or less.
"""


def constraints(
    points: Float64[np.ndarray, "K 3"], normals: Float64[np.ndarray, "K 3"]
) -> tuple[Float64[np.ndarray, "6"], Float64[np.ndarray, "6 6"]]:
    """How strongly a surface holds each small motion of itself (Gelfand et al. 2003, geometrically stable sampling).

    Returns:
        Mean squares of the surface's displacement along its normals, ascending, for unit motions (turns count at the
        RMS distance from the middle); and these motions, as columns of turn and shift.
    """
    arms = points - points.mean(axis=0)
    lever = max(float(np.sqrt(np.square(arms).sum(axis=1).mean())), np.finfo(np.float64).tiny)
    jacobian = np.column_stack([np.cross(arms, normals) / lever, normals])
    values, motions = np.linalg.eigh(jacobian.T @ jacobian / len(points))
    return np.maximum(values, 0), motions


def stability(points: Float64[np.ndarray, "K 3"], normals: Float64[np.ndarray, "K 3"]) -> float:
    """The weakest of `constraints` over the strongest: 0 where some motion cannot be seen at all."""
    if len(points) < 3:
        return 0.0
    values, _ = constraints(points, normals)
    return float(values[0] / values[-1]) if values[-1] > 0 else 0.0


def smoothed_normals(
    cloud: PointCloud, rows: Int64[np.ndarray, "K"], neighbors: Int64[np.ndarray, "K N"]
) -> Float64[np.ndarray, "K 3"]:
    """Mean normals of neighbourhoods, so that noise does not look like shape; sides do not matter."""
    assert cloud.normals is not None
    own = cloud.normals[rows]
    around = cloud.normals[neighbors]
    signs = np.sign(np.einsum("ki,kni->kn", own, around))
    mean = np.einsum("kn,kni->ki", signs, around) + own
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def even_rows(count: int, most: int) -> Int64[np.ndarray, "K"]:
    """At most `most` rows of `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))

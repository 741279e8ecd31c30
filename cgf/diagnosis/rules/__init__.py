"""From measures to findings: one function a kind of finding, each with the threshold it judges by.

The thresholds are those of the measurements named beside them: 98 pairs of FGR (level 1), redkitchen, home_at and the
demo, of which 97 register, and pairs and surfaces made for the purpose. A finding whose evidence is weak is a caution,
or none.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Int64

from cgf.diagnosis.findings import Finding, Place
from cgf.diagnosis.measures import Measures
from cgf.diagnosis.rules import clouds, matches
from cgf.geometry import neighbors
from cgf.types import PointCloud

Rule = Callable[[Measures], Finding | None]

RULES: tuple[Rule, ...] = (
    clouds.judge_truth,
    clouds.judge_scale,
    clouds.judge_unit,
    clouds.judge_points,
    clouds.judge_density,
    clouds.judge_normals,
    matches.judge_shape,
    matches.judge_radius,
    matches.judge_estimator,
    matches.judge_repetition,
    matches.judge_overlap,
    matches.judge_features,
    matches.judge_filters,
    matches.judge_agreement,
)
"""In the order in which a cause outranks another: what is wrong with the input spoils all that comes after it."""


CERTAIN = 0.9
_MATCHES = ("radius", "repetition", "overlap", "features", "filters", "agreement")
SPOILS: dict[str, tuple[str, ...]] = {
    "truth": ("overlap", "features", "estimator"),
    "scale": ("unit", "points", "density", "normals", "shape", *_MATCHES),
    "unit": ("points", "density", *_MATCHES),
    "density": _MATCHES,
    "normals": _MATCHES,
    "radius": _MATCHES,
    "shape": ("repetition", "overlap", "features", "agreement"),
}
"""Findings that do not count beside a certain cause."""


def judge(measured: Measures) -> list[Finding]:
    """All findings, in the order of the stages."""
    found = [finding for finding in (rule(measured) for rule in RULES) if finding is not None]
    cause = next((item for item in found if item.severity == "problem" and item.kind in SPOILS), None)
    if cause is None or cause.confidence < CERTAIN:
        return found
    after = found[found.index(cause) + 1 :]
    # What it spoils says nothing more: no match is right at another scale, and so no overlap is seen.
    kept = [item for item in after if item.severity == "fine" or item.kind not in SPOILS[cause.kind]]
    known = measured.truth is not None and cause.kind in ("normals", "radius", "density")
    kept += [item for item in after if item not in kept and item.kind == "overlap" and known]
    return [*found[: found.index(cause) + 1], *kept]


def places(measured: Measures, findings: list[Finding]) -> dict[str, Place]:
    """Points that findings concern, where these are some and not all."""
    case, likeness = measured.case, measured.likeness
    none = np.zeros(0, dtype=np.int64)
    known = measured.truth or measured.best
    found = {}
    for finding in findings:
        if finding.kind == "normals" and "normals" in finding.changes:
            found["normals"] = Place(
                _around(case.source, measured.source.sampled, measured.source.is_opposed),
                _around(case.target, measured.target.sampled, measured.target.is_opposed),
            )
        elif finding.kind == "overlap" and known is not None:
            found["overlap"] = Place(np.flatnonzero(known.overlaps), none)
        elif finding.kind == "features":
            found["features"] = Place(_around(case.source, likeness.rows, likeness.is_distinctive), none)
        elif finding.kind in ("agreement", "repetition", "estimator") and measured.poses:
            rows = measured.asked[measured.poses[0].rows]
            found[finding.kind] = Place(*case.table.correspondences.indices[rows].T)
    return {kind: place for kind, place in found.items() if len(place.source) or len(place.target)}


def _around(
    cloud: PointCloud, sampled: Int64[np.ndarray, "K"], chosen: Bool[np.ndarray, "K"]
) -> Int64[np.ndarray, "R"]:
    """Rows of the points whose nearest sampled point is a chosen one."""
    nearest, _ = neighbors.nearest(cloud.points[sampled], cloud.points)
    return np.flatnonzero(chosen[nearest])

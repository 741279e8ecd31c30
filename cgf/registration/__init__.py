"""Estimators of the rigid motion between two clouds, by name."""

from typing import Any

import numpy as np

from cgf.checks import ArrayLike, check_transform
from cgf.registration.fgr import Fgr, FgrConfig
from cgf.registration.icp import Icp, IcpConfig, IcpMetric
from cgf.registration.ransac import Ransac, RansacConfig
from cgf.types import Estimator

__all__ = ["IcpMetric", "available", "make_estimator"]


def available() -> tuple[str, ...]:
    """Names that `make_estimator` knows, in alphabetical order."""
    return ("fgr", "icp", "ransac")


def make_estimator(
    name: str,
    *,
    inlier_distance: float,
    iterations: int | None = None,
    seed: int = 0,
    initial: ArrayLike | None = None,
    metric: IcpMetric = "plane",
) -> Estimator:
    """An estimator with its main settings; the others of its config keep their defaults.

    Args:
        name: One of `available()`. `icp` does not look at the correspondences.
        inlier_distance: How far a moved source point may lie from its partner, in cloud units.
        iterations: At most, of whatever the method repeats: samples, or steps; None is the method's own default.
        seed: Of the random choices, where the method makes any.
        initial: `target_from_source` that `icp` starts from; None is the identity. The others need none.
        metric: What `icp` makes small.

    Raises:
        ValueError: The name is unknown, or a setting makes no sense.
    """
    given: dict[str, Any] = {} if iterations is None else {"iterations": iterations}
    if name == "ransac":
        return Ransac(RansacConfig(inlier_distance, seed=seed, **given))
    if name == "fgr":
        return Fgr(FgrConfig(inlier_distance, seed=seed, **given))
    if name == "icp":
        start = np.eye(4) if initial is None else check_transform(initial, "initial")
        return Icp(IcpConfig(inlier_distance, metric=metric, **given), start)
    raise ValueError(f"name must be one of {', '.join(available())}, got {name}")

"""Estimators of the rigid motion between two clouds, by name."""

from cgf.registration.icp import Icp, IcpConfig
from cgf.registration.ransac import Ransac, RansacConfig
from cgf.types import Estimator


def available() -> tuple[str, ...]:
    """Names that `make_estimator` knows, in alphabetical order."""
    return ("icp", "ransac")


def make_estimator(name: str, *, inlier_distance: float, seed: int = 0) -> Estimator:
    """An estimator with its defaults.

    Args:
        name: One of `available()`. `icp` starts from the identity and does not look at the correspondences.
        inlier_distance: How far a moved source point may lie from its partner, in cloud units.
        seed: Of the random choices, where the method makes any.

    Raises:
        ValueError: The name is unknown, or `inlier_distance` is not positive.
    """
    if name == "ransac":
        return Ransac(RansacConfig(inlier_distance=inlier_distance, seed=seed))
    if name == "icp":
        return Icp(IcpConfig(max_distance=inlier_distance))
    raise ValueError(f"name must be one of {', '.join(available())}, got {name}")

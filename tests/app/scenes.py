"""Small pairs for tests of the viewer, on which every stage takes a fraction of a second."""

import numpy as np

from app.pair_source import PairSource
from app.session import Session
from app.settings import ViewSettings
from app.snapshot import Snapshot
from cgf.geometry.transforms import invert, move, rigid, rotation_about
from cgf.types import Pair, PointCloud, Transform

LONG_S = 120.0
SETTINGS = ViewSettings(support_radius=0.8)


def bumpy_cloud(name: str = "hills", *, side: int = 32) -> PointCloud:
    """A square metre of hills, seen from above: about `side` squared points with normals."""
    x, y = np.meshgrid(np.linspace(0, 3, side), np.linspace(0, 3, side), indexing="ij")
    z = 0.25 * np.sin(2.1 * x) * np.cos(1.7 * y) + 0.1 * np.sin(5 * x + 3 * y)
    dx = 0.525 * np.cos(2.1 * x) * np.cos(1.7 * y) + 0.5 * np.cos(5 * x + 3 * y)
    dy = -0.425 * np.sin(2.1 * x) * np.sin(1.7 * y) + 0.3 * np.cos(5 * x + 3 * y)
    normals = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return PointCloud(points, normals=normals, name=name, viewpoint=np.array([1.5, 1.5, 4.0]))


def motion() -> Transform:
    """A turn by 30 degrees and a shift."""
    return rigid(rotation_about([0.2, 1.0, 0.4], np.radians(30)), [0.4, -0.3, 0.8])


def hills(*, with_truth: bool = True) -> Pair:
    """The hills twice; the source has lost a corner and was moved."""
    target = bumpy_cloud("target hills")
    kept = np.flatnonzero(target.points[:, 0] + target.points[:, 1] > 1.0)
    source = move(motion(), bumpy_cloud("source hills").take(kept))
    return Pair("hills", source, target, invert(motion()) if with_truth else None)


def strangers() -> Pair:
    """The hills, and hills a hundred metres away: the pose says that they do not overlap."""
    pair = hills()
    return Pair("strangers", pair.source, pair.target, rigid(np.eye(3), [100.0, 0.0, 0.0]))


def source_of(pair: Pair, *, command: tuple[str, ...] = ()) -> PairSource:
    """Offer a pair to a session."""
    return PairSource(pair.name, lambda: pair, command)


def run(session: Session) -> Snapshot:
    """Start a session and wait for its end."""
    session.start()
    assert session.wait_until_idle(LONG_S)
    return session.snapshot()

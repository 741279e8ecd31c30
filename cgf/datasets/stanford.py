"""Raw laser scans of the Stanford 3D Scanning Repository, with the poses of their `.conf` file."""

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from cgf.checks import InputError
from cgf.geometry.neighbors import overlap_mask
from cgf.geometry.transforms import apply, compose, invert, rigid, rotation_of_quaternion
from cgf.io import PairFiles, read_cloud, read_pairs
from cgf.types import Pair

_MOST_QUERIES = 5_000
_SCANNER = (0.0, 0.0, 10.0)
"""In metres, in the frame of each raw scan: on its side with large z, and farther than the scans are wide."""


def find_stanford(root: str | Path, *, overlap: float = 0.3, tau: float = 0.0015) -> list[PairFiles]:
    """List the pairs of scans that overlap; this reads all scans.

    Args:
        root: Folder with one `.conf` file and the scans that it names.
        overlap: Least share of the points of either scan (5,000 of them, evenly spread) that have a partner.
        tau: A partner is at most this far, in cloud units; the scans are in metres.

    Raises:
        InputError: The `.conf` file or a scan is missing or damaged.
    """
    poses = _read_poses(Path(root))
    placed = {path: apply(pose, read_cloud(path).points) for path, pose in poses.items()}
    found = []
    for target, source in combinations(poses, 2):
        shares = [_share(placed[source], placed[target], tau), _share(placed[target], placed[source], tau)]
        if min(shares) >= overlap:
            pose = compose(invert(poses[target]), poses[source])
            found.append(PairFiles(f"{source.stem} to {target.stem}", source, target, pose, viewpoint=_SCANNER))
    return found


def load_stanford(root: str | Path, *, overlap: float = 0.3, tau: float = 0.0015) -> Iterator[Pair]:
    """Read the pairs that `find_stanford` lists, one after another."""
    return read_pairs(find_stanford(root, overlap=overlap, tau=tau))


def _share(source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "M 3"], tau: float) -> float:
    step = -(-len(source) // _MOST_QUERIES)
    return float(overlap_mask(source[::step], target, tau).mean())


def _read_poses(root: Path) -> dict[Path, Float64[np.ndarray, "4 4"]]:
    """World from scan, by the file of the scan, in the order of the `.conf` file."""
    configurations = sorted(root.glob("*.conf"))
    if len(configurations) != 1:
        raise InputError(f"{root} must have one .conf file, got {len(configurations)}; check the path")
    text = configurations[0].read_text(encoding="latin-1")
    lines = [line.split() for line in text.splitlines() if line.startswith("bmesh ")]
    if not lines:
        raise InputError(f"{configurations[0]} must have lines 'bmesh file tx ty tz qx qy qz qw', got none")
    return {root / words[1]: _pose(words, configurations[0]) for words in lines}


def _pose(words: list[str], path: Path) -> Float64[np.ndarray, "4 4"]:
    try:
        tx, ty, tz, qx, qy, qz, qw = (float(word) for word in words[2:])
        # Quirk: the last number has the opposite sign to that of the usual formula.
        return rigid(rotation_of_quaternion((-qw, qx, qy, qz)), (tx, ty, tz))
    except ValueError:
        raise InputError(
            f"{path} must have 7 numbers after the file in 'bmesh' lines, got {' '.join(words)[:60]!a}"
        ) from None

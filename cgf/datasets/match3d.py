"""Scenes of the 3DMatch test set (Zeng et al., CVPR 2017), and of 3DLoMatch in the same form."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cgf.checks import check_count
from cgf.io import PairFiles, index_in_name, logged_pairs, read_pairs
from cgf.types import Pair


def find_scene(
    root: str | Path, *, log: str = "gt.log", consecutive: bool = False, limit: int | None = None
) -> list[PairFiles]:
    """List the pairs of one scene, in the order of its log.

    Args:
        root: Folder of the scene, with `cloud_bin_N.ply`.
        log: `gt.log` for pairs overlapping by 30 % or more, `gt_lomatch.log` for 10 to 30 %.
        consecutive: Keep pairs of fragments that follow each other, which official scores leave out.
        limit: Most pairs, spread evenly over the log; None takes all.

    Raises:
        InputError: The log or a fragment is missing, or the log is damaged.
        ValueError: `limit` is below 1.
    """
    if limit is not None:
        check_count(limit, "limit", minimum=1)
    pairs = [pair for pair in logged_pairs(Path(root), log=log) if consecutive or not _follow(pair)]
    if limit is None or limit >= len(pairs):
        return pairs
    return [pairs[row] for row in np.arange(limit) * len(pairs) // limit]


def load_scene(
    root: str | Path, *, log: str = "gt.log", consecutive: bool = False, limit: int | None = None
) -> Iterator[Pair]:
    """Read the pairs that `find_scene` lists, one after another; a fragment of several pairs is read once."""
    return read_pairs(find_scene(root, log=log, consecutive=consecutive, limit=limit))


def _follow(pair: PairFiles) -> bool:
    source, target = index_in_name(pair.source.name), index_in_name(pair.target.name)
    return source is not None and target is not None and abs(source - target) == 1

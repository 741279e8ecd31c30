"""The synthetic range images of Fast Global Registration (Zhou, Park, Koltun, ECCV 2016)."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

from cgf.checks import InputError
from cgf.io import PairFiles, logged_pairs, read_pairs
from cgf.types import Pair


def find_fgr(root: str | Path, pairs: Collection[int] | None = None) -> list[PairFiles]:
    """List pairs of one noise level, in order of their numbers.

    Args:
        root: Folder of one noise level, with folders `pair_01` to `pair_25`.
        pairs: Numbers of the pairs wanted, from 1; None takes all that are there.

    Raises:
        InputError: A pair is missing or has no pose.
    """
    root = Path(root)
    folders = {int(path.name[5:]): path for path in root.glob("pair_*") if path.name[5:].isdecimal()}
    if not folders:
        raise InputError(f"{root} must have folders pair_01, pair_02 and so on, got none; check the path")
    found = []
    for number in sorted(folders if pairs is None else set(pairs)):
        if number not in folders:
            raise InputError(f"pairs must be among {min(folders)} to {max(folders)} of {root}, got {number}")
        found += [replace(pair, name=folders[number].name) for pair in logged_pairs(folders[number])]
    return found


def load_fgr(root: str | Path, pairs: Collection[int] | None = None) -> Iterator[Pair]:
    """Read the pairs that `find_fgr` lists, one after another."""
    return read_pairs(find_fgr(root, pairs))

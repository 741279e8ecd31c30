"""Somebody's own pairs: a folder with a trajectory log beside its clouds, or a folder of such folders."""

from collections.abc import Iterator
from pathlib import Path

from cgf.checks import InputError
from cgf.io import PairFiles, logged_pairs, read_pairs
from cgf.types import Pair


def find_folder(root: str | Path, *, log: str = "gt.log") -> list[PairFiles]:
    """List the pairs of a folder, or of all folders in it, sorted by name, that have a log.

    Args:
        root: Holds clouds whose names end in numbers, and `log`; or folders that do.
        log: Name of the file of blocks `target source total` and a 4x4.

    Raises:
        InputError: There is no log, or it is damaged, or names clouds that are not there.
    """
    root = Path(root)
    if (root / log).is_file():
        return logged_pairs(root, log=log)
    if not root.is_dir():
        raise InputError(f"{root} must be a folder, got no such folder; check the path")
    folders = sorted(path.parent for path in root.glob(f"*/{log}"))
    if not folders:
        raise InputError(f"{root} must have a {log} beside its clouds or in its folders, got none; add the true poses")
    return [pair for folder in folders for pair in logged_pairs(folder, log=log)]


def load_folder(root: str | Path, *, log: str = "gt.log") -> Iterator[Pair]:
    """Read the pairs that `find_folder` lists, one after another."""
    return read_pairs(find_folder(root, log=log))

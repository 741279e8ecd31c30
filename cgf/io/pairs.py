"""Pairs of clouds that lie in files, read when they are needed."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from cgf.checks import InputError
from cgf.io.clouds import CLOUD_SUFFIXES, read_cloud
from cgf.io.poses import index_in_name, read_log
from cgf.types import Pair, PointCloud

_CACHED_POINTS = 5_000_000


@dataclass(frozen=True, eq=False)
class PairFiles:
    """Where the clouds of a pair lie, and how they do."""

    name: str
    source: Path
    target: Path
    target_from_source: Float64[np.ndarray, "4 4"] | None = None
    viewpoint: tuple[float, float, float] | None = None
    """Position of the sensor in the frame of either cloud; None takes the files'."""

    def read(self, *, drop_invalid: bool = False) -> Pair:
        """Read both clouds.

        Raises:
            InputError: A file cannot be read.
        """
        return next(read_pairs([self], drop_invalid=drop_invalid))


def read_pairs(pairs: Iterable[PairFiles], *, drop_invalid: bool = False) -> Iterator[Pair]:
    """Read pairs one after another; a cloud of several pairs is read once, while 5 million points suffice.

    Raises:
        InputError: A file cannot be read.
    """
    cache: OrderedDict[tuple[object, ...], PointCloud] = OrderedDict()

    def cloud(path: Path, viewpoint: tuple[float, float, float] | None) -> PointCloud:
        key = path, viewpoint
        if key not in cache:
            cache[key] = read_cloud(path, viewpoint=viewpoint, drop_invalid=drop_invalid)
        cache.move_to_end(key)
        while len(cache) > 1 and sum(map(len, cache.values())) > _CACHED_POINTS:
            cache.popitem(last=False)
        return cache[key]

    for files in pairs:
        source, target = (cloud(path, files.viewpoint) for path in (files.source, files.target))
        yield Pair(files.name, source, target, files.target_from_source)


def numbered_clouds(folder: Path) -> dict[int, Path]:
    """The clouds in a folder by the last number in their name, as trajectory logs call them.

    Raises:
        InputError: There is no such folder, or two clouds have one number.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} must be a folder of point clouds, got no such folder; check the path")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = index_in_name(path.name)
        # Text files beside clouds hold poses.
        if number is None or path.suffix.lower() not in CLOUD_SUFFIXES or path.suffix.lower() == ".txt":
            continue
        if number in found:
            raise InputError(
                f"{folder} must have one cloud for each number, got {found[number].name} and {path.name}; move one away"
            )
        found[number] = path
    return found


def logged_pairs(folder: Path, *, log: str = "gt.log") -> list[PairFiles]:
    """The pairs of a trajectory log and the clouds beside it, in the order of the log.

    Raises:
        InputError: The log or a cloud is missing, or the log is damaged.
    """
    clouds = numbered_clouds(folder)
    pairs = []
    for entry in read_log(folder / log):
        for number in (entry.source, entry.target):
            if number not in clouds:
                raise InputError(f"{folder} must have the cloud {number} that {log} names, got none with that number")
        name = f"{folder.name} {entry.source} to {entry.target}"
        pairs.append(PairFiles(name, clouds[entry.source], clouds[entry.target], entry.target_from_source))
    return pairs

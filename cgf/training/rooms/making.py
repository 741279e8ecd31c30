"""Furnished rooms, scanned, as folders that `cgf train --scenes` reads."""

from pathlib import Path

import numpy as np

from cgf.checks import check_count
from cgf.io import read_log
from cgf.training.rooms.furnishing import furnish
from cgf.training.rooms.furniture import Model, read_libraries
from cgf.training.rooms.scanning import scan, write_scene
from cgf.types import Progress

_RARE = 20
"""Rooms that are thrown away one after the other, because no two fragments overlap, before that is an error."""


def make_rooms(
    libraries: list[Path], folder: Path, *, count: int, fragments: int, seed: int, progress: Progress
) -> int:
    """Write `room_000` and so on into `folder`, each with cloud_bin_N.ply, in metres, and gt.log.

    A room depends on the seed, its number and the models alone. Those that are there already are left as they are, so
    that a run that was cut off goes on.

    Args:
        libraries: Furniture libraries (.sh3f).
        folder: Made if it is not there.
        count: Rooms.
        fragments: Of each room.
        seed: Of all random choices.
        progress: Told the share of rooms done.

    Returns:
        Pairs of fragments that overlap by 30 % or more, in all rooms.

    Raises:
        InputError: A library cannot be read.
        ValueError: `count` is below 1, or `fragments` below 2.
    """
    check_count(count, "count", minimum=1)
    check_count(fragments, "fragments", minimum=2)
    models = read_libraries(libraries, progress=progress)
    pairs = 0
    for number in range(count):
        progress(number / count, f"room {number + 1} of {count}")
        room = folder / f"room_{number:03d}"
        # The log is written last.
        pairs += len(read_log(room / "gt.log")) if (room / "gt.log").is_file() else _make(models, room, fragments, seed)
    return pairs


def _make(models: list[Model], room: Path, fragments: int, seed: int) -> int:
    for turn in range(_RARE):
        rng = np.random.default_rng([seed, int(room.name.removeprefix("room_")), turn])
        pairs = write_scene(room, *scan(furnish(models, rng), count=fragments, rng=rng))
        if pairs:
            return pairs
    raise RuntimeError(f"no two of {fragments} fragments overlap in any of {_RARE} rooms; ask for more --fragments")

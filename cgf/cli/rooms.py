"""The command `cgf rooms`: furnished rooms to train on, beside somebody's own scans."""

import argparse
from pathlib import Path

from cgf.cli.common import note, progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf rooms`."""
    parser.add_argument(
        "libraries",
        type=Path,
        nargs="+",
        metavar="LIBRARY.sh3f",
        help="models of furniture: libraries of the program Sweet Home 3D, e.g. of Debian's sweethome3d-furniture",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="of rooms; those there are kept",
    )
    parser.add_argument("--count", type=int, default=100, metavar="N", help="rooms (default: 100)")
    parser.add_argument("--fragments", type=int, default=12, metavar="N", help="of each room (default: 12)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="same seed and libraries, same rooms")


def run(options: argparse.Namespace) -> int:
    """Make the rooms that are not there yet."""
    from cgf.training.rooms.making import make_rooms

    with progress_bar(options) as progress:
        pairs = make_rooms(
            options.libraries,
            options.output,
            count=options.count,
            fragments=options.fragments,
            seed=options.seed,
            progress=progress or _silent,
        )
    note(options, f"Wrote {options.count} rooms with {pairs} overlapping pairs to {options.output}")
    note(options, f"Train on them with cgf train --model indoor --scenes {options.output}/room_*")
    return 0


def _silent(share: float, text: str) -> None:
    """Progress that nobody sees."""

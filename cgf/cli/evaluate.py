"""The command `cgf evaluate`: descriptors side by side on data sets whose poses are known."""

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from cgf.cli import suite
from cgf.cli.common import note, progress_bar

if TYPE_CHECKING:
    from cgf.evaluation.benchmark import Summary
    from cgf.pipeline import PairSettings
    from cgf.types import Pair

_DESCRIPTORS = ("cgf-8", "cgf-16", "cgf-32", "fpfh", "pca-32")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf evaluate`."""
    parser.add_argument(
        "data",
        nargs="*",
        metavar="DATA",
        help="demo, or folders: of pair_NN folders (Fast Global Registration), of scans with a .conf (Stanford), of "
        "fragments with a gt.log (3DMatch), or of such folders",
    )
    parser.add_argument(
        "--descriptors",
        nargs="+",
        default=_DESCRIPTORS,
        metavar="NAME-DIM",
        help=f"what to compare (default: {' '.join(_DESCRIPTORS)})",
    )
    parser.add_argument("--model", choices=("auto", "object", "indoor"), default="auto", help="for all (default: auto)")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="own weights for cgf, written by cgf train")
    parser.add_argument("--log", default="gt.log", metavar="NAME", help="name of the pose log (default: gt.log)")
    parser.add_argument(
        "--pairs", type=int, metavar="N", help="at most that many pairs of each data set, spread evenly (default: all)"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="scores of every pair as JSON")
    suite.add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Print a table for every data set."""
    from cgf.checks import InputError

    if options.pairs is not None and options.pairs < 1:
        raise InputError(f"--pairs must be 1 or more, got {options.pairs}")
    if options.suite is not None:
        return suite.run(options)
    if not options.data:
        raise InputError("DATA must be given, or --suite; see cgf evaluate --help")
    choices = [_choice(name, options) for name in options.descriptors]
    from cgf.evaluation.benchmark import evaluate, summarise
    from cgf.evaluation.matches import check_output, write_text

    if options.output is not None:
        check_output(options.output, (".json",))
    scores = {}
    for data in options.data:
        count, pairs = _pairs(data, log=options.log, limit=options.pairs)
        with progress_bar(options) as progress:
            scores[data] = evaluate(pairs, choices, count=count, progress=progress)
        print(_table(f"{Path(data).name}, {count} {'pair' if count == 1 else 'pairs'}", summarise(scores[data])))
    if options.output is not None:
        text = json.dumps({data: [asdict(score) for score in rows] for data, rows in scores.items()}, indent=1)
        write_text(options.output, text)
        note(options, f"Wrote {options.output}")
    return 0


def _choice(name: str, options: argparse.Namespace) -> "PairSettings":
    """`cgf-16` is descriptor cgf in 16 dimensions."""
    from cgf.checks import InputError
    from cgf.pipeline import PairSettings

    descriptor, _, dim = name.partition("-")
    if dim and not dim.isdecimal():
        raise InputError(f"--descriptors must be names such as cgf-32 or fpfh, got {name}")
    weights = options.weights if descriptor == "cgf" else None
    return PairSettings(model=options.model, descriptor=descriptor, dim=int(dim) if dim else None, weights=weights)


def _pairs(data: str, *, log: str, limit: int | None) -> "tuple[int, Iterable[Pair]]":
    """How many pairs a data set has, and the pairs."""
    from cgf.datasets import demo, fgr, folder, match3d, stanford
    from cgf.io import read_pairs

    root = Path(data)
    if data == "demo":
        return 1, [demo.load_demo()]
    if any(root.glob("pair_*")):
        found = fgr.find_fgr(root)
    elif any(root.glob("*.conf")):
        found = stanford.find_stanford(root)
    elif (root / log).is_file():
        # Consecutive fragments share frames; official scores leave them out.
        found = match3d.find_scene(root, log=log)
    else:
        found = folder.find_folder(root, log=log)
    if limit is not None and limit < len(found):
        found = [found[row * len(found) // limit] for row in range(limit)]
    return len(found), read_pairs(found)


def _table(title: str, rows: "list[Summary]") -> str:
    lines = [
        title,
        f"{'descriptor':12}{'precision':>11}{'in tau':>9}{'inlier ratio':>14}{'recall at 5 %':>15}{'ms per 1,000':>14}",
    ]
    for row in rows:
        shares = (100 * share for share in (row.precision, row.precision_in_tau, row.inlier_ratio))
        first, second, third = shares
        lines.append(
            f"{f'{row.descriptor}-{row.dim}':12}{first:>9.1f} %{second:>7.1f} %{third:>12.1f} %"
            f"{100 * row.feature_matching_recall:>13.1f} %{row.describe_ms_per_1000:>14.0f}"
        )
    return "\n".join(lines) + "\n"

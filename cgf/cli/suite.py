"""`cgf evaluate --suite paper`: every figure and plot of the documents, from the weights and the benchmark data."""

import argparse
import os
from pathlib import Path

from cgf.cli.common import note, progress_bar

SETS = ("demo", "fgr", "happy", "radii", "rooms", "lomatch", "cross", "robustness")
ROOT = Path(__file__).resolve().parents[2]
"""Of the checkout, where there is one."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf evaluate` that go with `--suite`."""
    group = parser.add_argument_group("the suite")
    group.add_argument(
        "--suite",
        choices=("paper",),
        help="measure all descriptors on all benchmark sets; what is done is kept, and a run that was stopped goes on",
    )
    shared = os.environ.get("CGF_SHARED")
    group.add_argument(
        "--data",
        type=Path,
        dest="data_folder",
        metavar="FOLDER",
        default=None if shared is None else Path(shared) / "data",
        help="of the benchmark data (default: `data` in the folder that CGF_SHARED names)",
    )
    weights = ROOT / "benchmarks" / "weights"
    group.add_argument(
        "--weights-folder",
        type=Path,
        metavar="FOLDER",
        default=weights if weights.is_dir() else None,
        help="every weights file in it is a row of its own (default: benchmarks/weights of the checkout)",
    )
    group.add_argument("--only", nargs="+", choices=SETS, default=SETS, metavar="SET", help=f"of {', '.join(SETS)}")
    group.add_argument("--quick", action="store_true", help="two pairs of each: whether it runs, not how well")
    group.add_argument("--kept", type=Path, default=Path("results/suite"), metavar="FOLDER", help="of what is done")
    group.add_argument(
        "--update", action="store_true", help="write tables, plots and the cards' scores into the checkout"
    )


def run(options: argparse.Namespace) -> int:
    """Measure, print the tables, and write them where that is asked for."""
    from cgf.checks import InputError

    if options.data or options.weights:
        given = "DATA" if options.data else "--weights"
        raise InputError(f"{given} must go without --suite, got both; give --data or --weights-folder")
    if options.update and options.quick:
        raise InputError("--update must go without --quick; two pairs of each say nothing of quality")
    if options.data_folder is None:
        raise InputError("--data must be given with --suite; it is the folder of the benchmark data")
    from cgf.evaluation.matches import check_output, write_text
    from cgf.evaluation.suite import report
    from cgf.evaluation.suite.rows import find_rows
    from cgf.evaluation.suite.running import run_suite
    from cgf.evaluation.suite.sets import QUICK_PAIRS, find_groups
    from cgf.evaluation.suite.summary import summarise

    if options.output is not None:
        check_output(options.output, (".json",))
    rows = find_rows(options.weights_folder)
    groups = find_groups(options.data_folder, options.only, limit=QUICK_PAIRS if options.quick else options.pairs)
    with progress_bar(options) as progress:
        results = run_suite(groups, rows, options.kept, progress=progress, told=lambda line: note(options, line))
    summaries = summarise(results)
    titles = {row.name: row.title for row in rows}
    print(report.document(summaries, titles))
    output = options.kept / "results.json" if options.output is None else options.output
    write_text(output, report.as_json(summaries, results))
    note(options, f"Wrote {output}")
    if options.update:
        for path in report.update_documents(ROOT, summaries, rows, limit=options.pairs):
            note(options, f"Wrote {path}")
    return 0

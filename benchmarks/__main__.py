"""The command: measures, prints the table, and writes it with a plot and the numbers."""

import argparse
import os
import time
from pathlib import Path

from benchmarks import groups, report
from benchmarks.timing import ROOT
from cgf.pipeline.cache import default_folder


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.data is not None and not options.data.is_dir():
        parser.error(f"--data must be a folder, got {options.data}")
    if options.repeats < 1:
        parser.error(f"--repeats must be at least 1, got {options.repeats}")
    plan = groups.Plan(
        data=options.data,
        cache=options.cache,
        quick=options.quick,
        repeats=1 if options.quick else options.repeats,
        points=500 if options.quick else 1_000_000,
        features=2_000 if options.quick else 20_000,
        sizes=(10_000,) if options.quick else (10_000, 100_000, 1_000_000, 10_000_000),
    )
    if options.data is None:
        print("No --data: the demo that comes with the package is measured, and rows that need more are left out.")
    done = []
    for key in options.only:
        start = time.perf_counter()
        print(f"{key} ...", end=" ", flush=True)
        done.append(groups.GROUPS[key](plan))
        print(f"{time.perf_counter() - start:.0f} s", flush=True)
    print()
    print(report.text(done))
    print("Ratio: a peer's time over ours. Times are of the processor, unless by the clock.")
    for path in report.save(done, options.output):
        print(f"Wrote {path}")
    if options.update:
        report.update(ROOT / "README.md", report.summary(done))
        report.update(ROOT / "docs" / "performance.md", f"{report.where()}\n{report.markdown(done)}")
        (ROOT / "docs" / "performance.svg").write_text(report.plot(done), "utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measures this project beside its peers. Peers that are not installed show as absent.",
    )
    default = os.environ.get("CGF_SHARED")
    parser.add_argument(
        "--data",
        type=Path,
        default=None if default is None else Path(default) / "data",
        help="folder of the benchmark data (the default is `data` in the folder that CGF_SHARED names)",
    )
    parser.add_argument(
        "--only", nargs="+", choices=groups.GROUPS, default=list(groups.GROUPS), help="some groups only"
    )
    parser.add_argument("--quick", action="store_true", help="few points, once: whether it runs, not how fast")
    parser.add_argument("--repeats", type=int, default=3, help="of each timing (default %(default)s)")
    parser.add_argument("--output", type=Path, default=Path("results/benchmarks"), help="folder of what is written")
    parser.add_argument(
        "--update", action="store_true", help="put the tables into README.md and docs/performance.md, with the plot"
    )
    parser.add_argument(
        "--cache", type=Path, default=default_folder() / "benchmarks", help="folder of the program that times PCL"
    )
    return parser


if __name__ == "__main__":
    main()

"""Where the time goes: `python -m benchmarks.profile` lists the functions that take it, in one thread."""

import argparse
import cProfile
import os
import pstats
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cgf
from benchmarks import inputs, report
from benchmarks.cases import load_vectors, spread, warm_up
from benchmarks.timing import ROOT

LEAST = 0.01
"""Share of the time below which a function is not listed."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.profile", description="Lists what takes the time.")
    parser.add_argument("--data", type=Path, help="folder of the benchmark data; the demo where it is not given")
    parser.add_argument("--points", type=int, default=4000, help="points described (default %(default)s)")
    parser.add_argument("--update", action="store_true", help="put the lists into docs/performance.md")
    options = parser.parse_args()
    os.environ["CGF_THREADS"] = "1"
    warm_up()
    tables = []
    for title, work in _works(options.data, options.points):
        work()
        # Of the processor, so that other work on the machine changes little.
        profile = cProfile.Profile(time.process_time)
        profile.runcall(work)
        tables.append(f"{title}\n{_table(pstats.Stats(profile))}")
        print(tables[-1])
    if options.update:
        content = "```text\n" + "\n".join(tables).strip() + "\n```"
        report.update(ROOT / "docs" / "performance.md", content, module="benchmarks.profile")


def _works(data: Path | None, points: int) -> Iterator[tuple[str, Callable[[], object]]]:
    from cgf import pipeline
    from cgf.matching import match
    from cgf.types import Features

    scan = inputs.load_scan(data)
    descriptor = inputs.describer(scan, model="object")
    rows = spread(len(scan.cloud), points)
    yield f"Describe {len(rows):,} points of {scan.name}", lambda: descriptor.describe(scan.cloud, rows)

    files = inputs.dense_files(data)
    if files is not None:
        cloud = cgf.read_cloud(files[1])
        settings = pipeline.resolve(pipeline.PairSettings(model="indoor", voxel_size=0.02), cloud, cloud)
        yield f"Read {files[1].name} ({len(cloud):,} points)", lambda: cgf.read_cloud(files[1])
        yield "Prepare it at 2 cm", lambda: pipeline.prepare(cloud, settings)

    name, source, target = inputs.load_features(data, 20_000)
    with tempfile.TemporaryDirectory() as folder:
        inputs.save_features(Path(folder) / "features.npz", source, target)
        vectors = load_vectors(Path(folder) / "features.npz", 32)
    sides = [Features(spread(len(side), len(side)), side, "cgf") for side in vectors]
    yield f"Match {len(sides[0]):,} x {len(sides[1]):,} features of {name}", lambda: match(*sides)


def _table(stats: pstats.Stats) -> str:
    """Functions by the time spent in themselves and in compiled code that they call."""
    entries = [
        (own, f"{_place(file)}:{function}", calls)
        for (file, _, function), (_, calls, own, _, _) in stats.stats.items()  # type: ignore[attr-defined]
    ]
    whole = sum(own for own, _, _ in entries)
    lines = [
        f"{own / whole:7.1%} {own:8.3f} s {calls:8,} calls  {name}"
        for own, name, calls in sorted(entries, reverse=True)
        if own >= LEAST * whole
    ]
    return "\n".join([f"  {whole:.2f} s", *lines, ""])


def _place(file: str) -> str:
    path = Path(file)
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


if __name__ == "__main__":
    main()

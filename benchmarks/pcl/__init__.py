"""PCL and FLANN, timed by a program that is built on first use."""

import hashlib
import shutil
import subprocess
from pathlib import Path

from benchmarks.timing import Timing

SOURCE = Path(__file__).resolve().parent / "peers.cpp"
PACKAGES = ("pcl_features", "pcl_surface", "pcl_search", "flann")
INSTALL = "apt-get install g++ pkg-config libpcl-dev"


class Absent(Exception):
    """PCL or what builds the program is not installed; the text says how to install it."""


def build(cache: Path) -> Path:
    """The program, compiled into `cache` unless it is there.

    Raises:
        Absent: It cannot be built here.
    """
    tag = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    program = cache / f"peers-{tag}"
    if program.exists():
        return program
    compiler, config = shutil.which("g++"), shutil.which("pkg-config")
    if compiler is None or config is None:
        raise Absent(INSTALL)
    flags = subprocess.run([config, "--cflags", "--libs", *PACKAGES], capture_output=True, text=True, check=False)
    if flags.returncode:
        raise Absent(INSTALL)
    cache.mkdir(parents=True, exist_ok=True)
    new = program.with_suffix(".new")
    command = [compiler, "-O3", "-DNDEBUG", "-std=c++17", "-w", str(SOURCE), "-o", str(new), *flags.stdout.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise Absent(f"{INSTALL} (building failed: {done.stderr.strip().splitlines()[0]})")
    new.replace(program)
    return program


def run(program: Path, *arguments: object) -> dict[str, Timing]:
    """Seconds a point, or a query, by the names that the program gives them.

    Raises:
        RuntimeError: The program fails.
    """
    done = subprocess.run([str(program), *map(str, arguments)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{program} failed: {done.stderr.strip()}")
    runs: dict[str, list[tuple[float, float]]] = {}
    for line in done.stdout.splitlines():
        name, count, cpu, wall = line.split()
        runs.setdefault(name, []).append((float(cpu) / int(count), float(wall) / int(count)))
    return {name: Timing(*map(tuple, zip(*values, strict=True))) for name, values in runs.items()}

"""What every command of this project shares: options, progress, and the edge where errors become a line.

Nothing heavy is imported before a command runs, so that `--help` comes at once.
"""

import argparse
import contextlib
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from cgf.pipeline import PairSettings
    from cgf.types import Progress

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130


def run(command: Callable[[], int], *, program: str, debug: bool) -> int:
    """Run `command` and turn what it raises into a line on stderr and an exit status.

    Args:
        command: Returns its own exit status where it comes to its end.
        program: What the line begins with.
        debug: Show the traceback as well.

    Returns:
        The command's status; 2 for bad input (ValueError), 130 for Ctrl-C, 1 for all else.
    """
    try:
        status = command()
        sys.stdout.flush()
    except KeyboardInterrupt:
        if debug:
            traceback.print_exc()
        print(f"{program}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the output has seen enough. Python flushes stdout once more on its way out: let that succeed.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:  # noqa: BLE001  This is the edge: a person reads the line, not a caller.
        if debug:
            traceback.print_exc()
        print(f"{program}: {_sentence(error)}", file=sys.stderr)
        return BAD_INPUT if isinstance(error, ValueError) else FAILED
    return status


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, too."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the arguments, and exit with status 2."""
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def add_loading_options(parser: argparse.ArgumentParser) -> None:
    """Options for how clouds are read."""
    group = parser.add_argument_group("reading")
    group.add_argument(
        "--viewpoint",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="position of the sensor, in each cloud's own frame, to which estimated normals turn (default: the file's)",
    )
    group.add_argument("--drop-invalid", action="store_true", help="leave out points with NaN or inf, not refuse them")


def add_feature_options(parser: argparse.ArgumentParser) -> None:
    """Options for what is computed on clouds; `feature_settings` reads them. What is not given stays None."""
    group = parser.add_argument_group("features (lengths in the unit of the clouds)")
    group.add_argument("--model", choices=("auto", "object", "indoor"), help="weights and defaults (default: auto)")
    group.add_argument("--weights", type=Path, metavar="FILE", help="own weights for cgf, written by cgf train")
    group.add_argument("--descriptor", metavar="NAME", help="cgf, fpfh or pca (default: cgf)")
    group.add_argument("--dim", type=int, metavar="N", help="values of a feature (default: 32)")
    group.add_argument("--radius", type=float, metavar="R", help="radius of the neighbourhood described")
    group.add_argument("--min-radius", type=float, metavar="R", help="radius of its innermost shell")
    group.add_argument("--lrf-radius", type=float, metavar="R", help="radius for the local reference frame")
    group.add_argument(
        "--voxel", type=float, metavar="V", help="edge of the voxels for downsampling; 0 keeps every point"
    )

    group = parser.add_argument_group("corrections of the clouds")
    group.add_argument("--unit", choices=("m", "cm", "mm", "ft", "in"), help="of the coordinates (default: m)")
    group.add_argument(
        "--source-scale", type=float, metavar="S", help="multiply the source's coordinates first; poses map the result"
    )
    group.add_argument(
        "--normals", choices=("stored", "estimated"), help="estimated ignores those in the files (default: stored)"
    )
    group.add_argument("--flip-normals", choices=("none", "source", "target", "both"), help="turn normals round")


def add_matching_options(parser: argparse.ArgumentParser) -> None:
    """Options for which matches are kept; `feature_settings` reads them, too."""
    group = parser.add_argument_group("matches")
    group.add_argument("--mutual", action="store_true", help="keep only matches that are each other's nearest")
    group.add_argument(
        "--ratio", type=float, metavar="Q", help="keep only matches within this share of the second nearest's distance"
    )
    group.add_argument(
        "--surest",
        type=float,
        metavar="SHARE",
        help="keep only this share of all matches, the surest by their features",
    )


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Options for what is said."""
    group = parser.add_argument_group("messages")
    group.add_argument("--quiet", action="store_true", help="print results and errors only")
    group.add_argument("--debug", action="store_true", help="print the traceback of an error")


def feature_settings(options: argparse.Namespace) -> "PairSettings":
    """The settings that the feature and matching options ask for; what was not given keeps its default."""
    from cgf.pipeline import PairSettings

    fields = {
        "model": "model", "descriptor": "descriptor", "dim": "dim", "radius": "support_radius",
        "min_radius": "min_radius", "lrf_radius": "lrf_radius", "voxel": "voxel_size", "mutual": "mutual",
        "ratio": "max_ratio", "surest": "surest", "weights": "weights", "seed": "seed", "unit": "unit",
        "source_scale": "source_scale", "normals": "normals", "flip_normals": "flip_normals",
    }  # fmt: skip
    given = {field: getattr(options, option, None) for option, field in fields.items()}
    return PairSettings(**{field: value for field, value in given.items() if value is not None})


def note(options: argparse.Namespace, text: str) -> None:
    """Tell a person something beside the result, on stderr."""
    if not options.quiet:
        print(text, file=sys.stderr)


@contextlib.contextmanager
def progress_bar(options: argparse.Namespace) -> Iterator["Progress | None"]:
    """A bar on stderr while the block runs, where that is a terminal and `--quiet` was not given."""
    if options.quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description:24}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("Reading", total=1.0)
        yield lambda share, text: bar.update(task, completed=share, description=text)


def _sentence(error: Exception) -> str:
    """One line for a person."""
    text = " ".join(str(error).split())
    if isinstance(error, ValueError) and text:
        return text
    if isinstance(error, MemoryError):
        return "memory does not suffice; choose a larger --voxel"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return f"failed with {type(error).__name__}{': ' if text else ''}{text}; --debug shows where"

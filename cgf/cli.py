"""The commands `cgf describe`, `cgf match` and `cgf register`, and what every command of this project shares.

A command is one entry of `COMMANDS`: its name, a line of help, a function that adds its options, and one that runs it
and returns the exit status. Nothing heavy is imported before a command runs, so that `--help` comes at once.

`cgf-viewer` takes from here: `Parser`, `add_loading_options`, `add_feature_options`, `add_output_options`,
`feature_settings` and `run`, the edge where errors become one readable line and an exit status: 0 done, 1 failed,
2 bad input, 130 interrupted.
"""

import argparse
import contextlib
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from cgf.pipeline import PairResult, PairSettings, ResolvedSettings
    from cgf.types import Pair, Progress

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130


@dataclass(frozen=True)
class Command:
    """One word after `cgf`."""

    name: str
    summary: str
    add_options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that `arguments` (by default the process's own) name, and return the exit status."""
    options = build_parser().parse_args(arguments)
    command: Command = options.command
    return run(lambda: command.run(options), program=f"cgf {command.name}", debug=options.debug)


def build_parser() -> argparse.ArgumentParser:
    """The parser of `cgf`, with a parser of its own for every entry of `COMMANDS`."""
    parser = Parser(prog="cgf", description="Compact Geometric Features of point clouds: describe, match, register.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and stop")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in COMMANDS:
        sub = subparsers.add_parser(command.name, help=command.summary, description=command.summary)
        command.add_options(sub)
        add_output_options(sub)
        sub.set_defaults(command=command)
    return parser


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
    group.add_argument("--descriptor", metavar="NAME", help="cgf, fpfh or pca (default: cgf)")
    group.add_argument("--dim", type=int, metavar="N", help="values of a feature (default: 32)")
    group.add_argument("--radius", type=float, metavar="R", help="radius of the neighbourhood described")
    group.add_argument("--min-radius", type=float, metavar="R", help="radius of its innermost shell")
    group.add_argument("--lrf-radius", type=float, metavar="R", help="radius for the local reference frame")
    group.add_argument(
        "--voxel", type=float, metavar="V", help="edge of the voxels for downsampling; 0 keeps every point"
    )


def add_matching_options(parser: argparse.ArgumentParser) -> None:
    """Options for which matches are kept; `feature_settings` reads them, too."""
    group = parser.add_argument_group("matches")
    group.add_argument("--mutual", action="store_true", help="keep only matches that are each other's nearest")
    group.add_argument(
        "--ratio", type=float, metavar="Q", help="keep only matches within this share of the second nearest's distance"
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
        "ratio": "max_ratio", "seed": "seed",
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


def _describe_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cloud", type=Path, help="the cloud: PLY, PCD, XYZ, OBJ, STL, NPY or NPZ")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="features.npz")
    add_feature_options(parser)
    add_loading_options(parser)


def _describe(options: argparse.Namespace) -> int:
    import numpy as np

    from cgf import io, pipeline
    from cgf.evaluation.matches import check_output, write_whole

    check_output(options.output, (".npz",))
    with progress_bar(options) as progress:
        raw = io.read_cloud(options.cloud, viewpoint=options.viewpoint, drop_invalid=options.drop_invalid)
        settings = pipeline.resolve(feature_settings(options), raw, raw)
        _note_choice(options, settings)
        cloud = pipeline.prepare(raw, settings)
        features = pipeline.at_dim(pipeline.describe(cloud, settings, progress=progress), settings)
    described = cloud.take(features.indices)
    arrays: dict[str, Any] = {
        "points": described.points,
        "normals": described.normals,
        "indices": features.indices,
        "features": features.vectors,
        "settings": json.dumps(asdict(settings)),
    }
    write_whole(options.output, lambda file: np.savez_compressed(file, **arrays))
    note(
        options,
        f"Described {len(features):,} of {len(cloud):,} points ({len(raw):,} in the file) by {features.dim} values.",
    )
    note(options, f"Wrote {options.output}")
    return 0


def _pair_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, help="the cloud that is moved")
    parser.add_argument("target", type=Path, help="the cloud that stays")
    parser.add_argument(
        "--gt", type=Path, metavar="FILE", help="the true pose: a 4x4 that maps the source onto the target, or a gt.log"
    )
    add_feature_options(parser)
    add_matching_options(parser)
    add_loading_options(parser)


def _match_options(parser: argparse.ArgumentParser) -> None:
    _pair_options(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="matches.csv or matches.npz")


def _match(options: argparse.Namespace) -> int:
    import numpy as np

    from cgf.evaluation import matches, metrics

    matches.check_output(options.output)
    pair, result = _run_pair(options, register=False)
    settings = result.settings
    measured = matches.match_errors(
        result.source, result.target, result.table, target_from_source=pair.target_from_source, tau=settings.tau
    )
    matches.export_matches(options.output, result.source, result.target, result.table, result.rows, measured)
    note(options, f"{len(result.rows):,} matches of {len(result.table):,} source points with a feature.")
    if pair.target_from_source is not None:
        errors, partner = measured.errors[result.rows], measured.has_partner[result.rows]
        near = settings.precision_radius
        precision = metrics.precision(errors[partner], threshold=near)
        ratio = metrics.precision(errors, threshold=near)
        note(
            options,
            f"Precision within {near:.3g}: {_percent(precision)} of the {np.count_nonzero(partner):,} matches "
            f"whose point has a partner within {settings.tau:.3g}; inlier ratio {_percent(ratio)}.",
        )
    note(options, f"Wrote {options.output}")
    return 0


def _register_options(parser: argparse.ArgumentParser) -> None:
    _pair_options(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="text file for the 4x4")
    parser.add_argument("--seed", type=int, metavar="N", help="of the random samples (default: 0)")


def _register(options: argparse.Namespace) -> int:
    from cgf import io
    from cgf.geometry import transforms

    pair, result = _run_pair(options, register=True)
    found = result.registration
    if found is None or found.target_from_source is None:
        # The line that says so was among the warnings.
        return FAILED
    pose = found.target_from_source
    print("\n".join(" ".join(f"{value: .9g}".rjust(16) for value in row) for row in pose))
    print(f"fitness {found.fitness:.4f}, rmse {found.inlier_rmse:.4g}, {len(found.inliers):,} correspondences agree")
    if pair.target_from_source is not None:
        turned = transforms.rotation_error_deg(pose, pair.target_from_source)
        shifted = transforms.translation_error(pose, pair.target_from_source)
        print(f"rotation error {turned:.3f} degrees, translation error {shifted:.4g}")
    if options.output is not None:
        io.write_transform(options.output, pose)
        note(options, f"Wrote {options.output}")
    return 0


def _run_pair(options: argparse.Namespace, *, register: bool) -> tuple["Pair", "PairResult"]:
    from cgf import pipeline

    with progress_bar(options) as progress:
        pair = pipeline.load_pair(
            options.source,
            options.target,
            gt=options.gt,
            viewpoint=None if options.viewpoint is None else tuple(options.viewpoint),
            drop_invalid=options.drop_invalid,
        )
        settings = feature_settings(options)
        result = pipeline.run_pair(pair.source, pair.target, settings, register=register, progress=progress)
    _note_choice(options, result.settings)
    for warning in result.warnings:
        print(f"Warning: {warning}", file=sys.stderr)
    return pair, result


def _note_choice(options: argparse.Namespace, settings: "ResolvedSettings") -> None:
    note(options, settings.choice.reason)
    note(
        options,
        f"Descriptor {settings.descriptor}, {settings.dim} dimensions, radius {settings.support_radius:.3g}, "
        f"voxel {settings.voxel_size:.3g}, frame radius {settings.lrf_radius:.3g}.",
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


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


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(version("cgf-viewer"))
        except PackageNotFoundError:
            print("unknown: run from a checkout that is not installed")
        parser.exit()


COMMANDS = (
    Command("describe", "Compute the features of a cloud.", _describe_options, _describe),
    Command(
        "match", "Match the features of two clouds, and measure the matches under a known pose.", _match_options, _match
    ),
    Command("register", "Estimate the pose of one cloud relative to another.", _register_options, _register),
)

"""The command `cgf`: describe, match, register, diagnose, evaluate, train, rooms.

A command is one entry of `COMMANDS`: its name, a line of help, a function that adds its options, and one that runs it
and returns the exit status. `cgf-viewer` takes its options and its edge from `cgf.cli.common`, too.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NoReturn

from cgf.cli import diagnose, evaluate, pairs, rooms, train
from cgf.cli.common import (
    Parser,
    add_feature_options,
    add_loading_options,
    add_matching_options,
    add_output_options,
    feature_settings,
    note,
    run,
)

__all__ = [
    "COMMANDS",
    "Command",
    "Parser",
    "add_feature_options",
    "add_loading_options",
    "add_matching_options",
    "add_output_options",
    "build_parser",
    "feature_settings",
    "main",
    "note",
    "run",
]


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


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(version("cgf-viewer"))
        except PackageNotFoundError:
            print("unknown: run from a checkout that is not installed")
        parser.exit()


COMMANDS = (
    Command("describe", "Compute the features of a cloud.", pairs.describe_options, pairs.describe),
    Command(
        "match",
        "Match the features of two clouds, and measure the matches under a known pose.",
        pairs.match_options,
        pairs.match,
    ),
    Command("register", "Estimate the pose of one cloud relative to another.", pairs.register_options, pairs.register),
    Command("diagnose", "Say why two clouds do not register.", diagnose.add_options, diagnose.run),
    Command("evaluate", "Compare descriptors on data sets with known poses.", evaluate.add_options, evaluate.run),
    Command("train", "Train the network on meshes or scans.", train.add_options, train.run),
    Command("rooms", "Make furnished rooms and scan them, to train on.", rooms.add_options, rooms.run),
)

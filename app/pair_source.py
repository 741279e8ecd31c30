"""Pairs that a session can open, and the command lines that open them elsewhere."""

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from app.settings import ViewSettings
from cgf.types import Pair


@dataclass(frozen=True, eq=False)
class PairSource:
    """A pair that can be opened."""

    name: str
    load: Callable[[], Pair]
    command: tuple[str, ...] = ()
    """Arguments that open it with `cgf match`; empty where it has no files."""
    view: tuple[str, ...] = ()
    """Arguments that open it with `cgf-viewer`, where they are others."""
    files: tuple[Path, Path] | None = None
    """Source and target, where they are the user's own files."""

    def holding(self, pair: Pair) -> "PairSource":
        """The same with the pair read already: it is handed over once, and read again where it is asked for later."""
        waiting = [pair]
        return replace(self, load=lambda: waiting.pop() if waiting else self.load())


def match_command(pair: PairSource, settings: ViewSettings) -> str:
    """The `cgf match` that writes the matches shown."""
    if not pair.command:
        return ""
    options: list[object] = ["--descriptor", settings.descriptor]
    for option, value in (
        ("--model", None if settings.model == "auto" else settings.model),
        ("--weights", settings.pair_settings().weights),
        ("--dim", settings.dim),
        ("--radius", settings.support_radius),
        ("--min-radius", settings.min_radius),
        ("--lrf-radius", settings.lrf_radius),
        ("--voxel", settings.voxel_size),
        ("--ratio", settings.max_ratio),
        ("--surest", settings.surest),
        ("--unit", None if settings.unit == "m" else settings.unit),
        ("--source-scale", None if settings.source_scale == 1 else settings.source_scale),
        ("--normals", None if settings.normals == "stored" else settings.normals),
        ("--flip-normals", None if settings.flip_normals == "none" else settings.flip_normals),
    ):
        if value is not None:
            options += [option, value]
    if settings.mutual:
        options.append("--mutual")
    return shlex.join(["cgf", "match", *pair.command, *map(str, options), "-o", "matches.csv"])


def open_command(pair: PairSource, settings: ViewSettings) -> str:
    """The `cgf-viewer` that opens the pair shown, and no other, with settings at their defaults."""
    arguments = list(pair.view or pair.command)
    if not arguments:
        return ""
    weights = settings.pair_settings().weights
    return shlex.join(["cgf-viewer", *arguments, *([] if weights is None else ["--weights", str(weights)])])

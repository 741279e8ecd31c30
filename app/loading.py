"""Pairs that are opened while the viewer runs: by path, or dropped onto the page."""

import contextlib
import json
import os
import shutil
import tempfile
import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

from app.pair_source import PairSource
from app.session import Session
from app.snapshot import Snapshot
from app.state_text import restored
from cgf import pipeline
from cgf.checks import InputError
from cgf.io import CLOUD_SUFFIXES

MAX_UPLOAD = 1 << 30
"""Bytes of one dropped file; a larger one is opened by its path."""
MAX_RECENT = 10
_POSE_SUFFIXES = (".txt", ".log", ".npy", ".csv")
_KEPT = (
    "descriptor", "mutual", "max_ratio", "surest", "line_count", "line_choice", "palette", "point_size", "layout",
    "coloring",
)  # fmt: skip
"""Settings that hold for the next pair too; the others belong to one pair."""


@dataclass(frozen=True)
class PairPaths:
    """The files of a pair."""

    source: Path
    target: Path
    gt: Path | None = None
    """Of the true pose."""


def pair_source(
    paths: PairPaths,
    *,
    viewpoint: tuple[float, float, float] | None = None,
    drop_invalid: bool = False,
    is_uploaded: bool = False,
) -> PairSource:
    """Offer a pair to a session; it is read when that asks for it."""
    command = [str(paths.source), str(paths.target)]
    if paths.gt is not None:
        command += ["--gt", str(paths.gt)]
    if viewpoint is not None:
        command += ["--viewpoint", *map(str, viewpoint)]
    if drop_invalid:
        command.append("--drop-invalid")
    return PairSource(
        f"{paths.source.name} to {paths.target.name}",
        lambda: pipeline.load_pair(
            paths.source, paths.target, gt=paths.gt, viewpoint=viewpoint, drop_invalid=drop_invalid
        ),
        # Files that were dropped onto the page are gone when the viewer ends.
        () if is_uploaded else tuple(command),
        files=None if is_uploaded else (paths.source, paths.target),
    )


class Recent:
    """The pairs opened last, in a file that may be missing or damaged: then there are none."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()

    def read(self) -> list[PairPaths]:
        """The pairs whose files are still there, the last one first."""
        if self._path is None:
            return []
        try:
            entries = json.loads(self._path.read_text(encoding="utf-8"))
            pairs = [
                PairPaths(Path(entry["source"]), Path(entry["target"]), Path(entry["gt"]) if entry["gt"] else None)
                for entry in entries[:MAX_RECENT]
            ]
            return [pair for pair in pairs if pair.source.is_file() and pair.target.is_file()]
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return []

    def add(self, pair: PairPaths) -> None:
        """Put a pair first; does nothing where that cannot be written."""
        if self._path is None:
            return
        gt = None if pair.gt is None else pair.gt.absolute()
        pair = PairPaths(pair.source.absolute(), pair.target.absolute(), gt)
        with self._lock, contextlib.suppress(OSError):
            pairs = [pair, *(other for other in self.read() if other != pair)][:MAX_RECENT]
            entries = [{name: None if path is None else str(path) for name, path in vars(one).items()} for one in pairs]
            self._path.parent.mkdir(parents=True, exist_ok=True)
            part = self._path.with_suffix(f".{os.getpid()}.part")
            part.write_text(json.dumps(entries, indent=1), encoding="utf-8")
            part.replace(self._path)


def recent_file() -> Path | None:
    """`cgf-viewer/recent.json` in the user's folder for states: `$XDG_STATE_HOME`, or else `~/.local/state`."""
    folder = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not folder.is_absolute():
        try:
            folder = Path.home() / ".local" / "state"
        except RuntimeError:
            return None
    return folder / "cgf-viewer" / "recent.json"


class Loader:
    """Opens pairs in a session. Its methods may be called from any thread."""

    def __init__(self, session: Session, recent: Recent) -> None:
        self._session = session
        self._recent = recent
        self._folder: Path | None = None
        self._lock = threading.Lock()

    def recent(self) -> list[PairPaths]:
        """The pairs opened last, by path."""
        return self._recent.read()

    def open(self, paths: PairPaths, *, drop_invalid: bool = False) -> Snapshot:
        """Read a pair and show it; what is shown stays where that fails.

        Raises:
            InputError: A file cannot be used.
        """
        is_uploaded = any(self._is_ours(path) for path in (paths.source, paths.target))
        source = pair_source(paths, drop_invalid=drop_invalid, is_uploaded=is_uploaded)
        settings = self._session.settings
        kept = restored({name: getattr(settings, name) for name in _KEPT})
        snapshot = self._session.open(source, kept)
        if not is_uploaded:
            self._recent.add(paths)
        return snapshot

    async def receive(self, name: str, chunks: AsyncIterator[bytes]) -> Path:
        """Write a dropped file into a folder of this run that only its user can read.

        Raises:
            InputError: It is no file that could be opened here, or larger than `MAX_UPLOAD`.
        """
        base = Path(name.replace("\\", "/")).name
        if Path(base).suffix.lower() not in (*CLOUD_SUFFIXES, *_POSE_SUFFIXES):
            known = ", ".join(CLOUD_SUFFIXES)
            raise InputError(f"{base or 'The file'} must be a point cloud or mesh ({known}) or a pose; convert it")
        # Two files of one name get a folder each.
        path = Path(tempfile.mkdtemp(dir=self._private())) / base
        size = 0
        try:
            with path.open("xb") as file:
                async for chunk in chunks:
                    size += len(chunk)
                    if size > MAX_UPLOAD:
                        raise InputError(f"{base} must be at most {MAX_UPLOAD >> 20} MB; open it by its path instead")
                    file.write(chunk)
        except BaseException as error:
            shutil.rmtree(path.parent, ignore_errors=True)
            if isinstance(error, OSError):
                raise InputError(f"{base} cannot be kept: {error.strerror}; open it by its path instead") from error
            raise
        return path

    def close(self) -> None:
        """Remove what was dropped."""
        with self._lock:
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)
                self._folder = None

    def _private(self) -> Path:
        with self._lock:
            if self._folder is None:
                self._folder = Path(tempfile.mkdtemp(prefix="cgf-viewer-"))
            return self._folder

    def _is_ours(self, path: Path) -> bool:
        return self._folder is not None and path.is_relative_to(self._folder)

"""The estimate as a file that `--gt`, `--estimate` and other programs read."""

import tempfile
from pathlib import Path

from app.session import Session
from cgf.checks import InputError
from cgf.io import write_transform
from cgf.types import Transform


def pose_text(session: Session) -> bytes:
    """The estimate as four rows of four numbers.

    Raises:
        InputError: There is none.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pose.txt"
        write_transform(path, _estimate(session))
        return path.read_bytes()


def place_beside(session: Session) -> Path:
    """Where the estimate goes beside the source's file.

    Raises:
        InputError: The pair did not come from files of the user's.
    """
    files = session.files()
    if files is None:
        raise InputError("The clouds have no place of their own to save beside; download the pose instead.")
    source, target = (path.absolute() for path in files)
    return source.parent / f"{source.stem}_to_{target.stem}.txt"


def save_beside(session: Session, *, overwrite: bool) -> Path:
    """Write the estimate beside the source's file.

    Raises:
        InputError: There is no estimate or no place for it, or a file is there already and `overwrite` is false.
    """
    path, pose = place_beside(session), _estimate(session)
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; confirm that it may be replaced.")
    write_transform(path, pose)
    return path


def _estimate(session: Session) -> Transform:
    analysis, _, settings, _ = session.shown()
    if analysis is None or analysis.estimate is None:
        raise InputError("There is no estimate yet; wait until the pose is found, or look for it under Poses.")
    if settings.source_scale != 1:
        raise InputError(
            f"The estimate holds for the source scaled by {settings.source_scale:g}, which a pose file cannot say; "
            "scale the file first."
        )
    return analysis.estimate

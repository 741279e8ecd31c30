"""The matches as a file, as `cgf match` writes them."""

import tempfile
from pathlib import Path

from app.analysis import kept_rows
from app.session import Session
from cgf.checks import InputError
from cgf.evaluation.matches import export_matches


def matches_file(session: Session, suffix: str) -> bytes:
    """The matches that pass the filters.

    Args:
        session: Whose matches.
        suffix: `.csv` or `.npz`.

    Raises:
        InputError: There are no matches yet.
    """
    analysis, scores, settings, _ = session.shown()
    if analysis is None or analysis.matches is None or scores is None:
        raise InputError("There are no matches yet; wait until they are computed.")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"matches{suffix}"
        rows = kept_rows(analysis.matches, settings)
        export_matches(path, analysis.source, analysis.target, analysis.matches, rows, scores.forward)
        return path.read_bytes()

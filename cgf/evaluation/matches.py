"""The matches of a pair with what is known of each, for people and for files."""

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Bool, Float64, Int64

from cgf.checks import InputError
from cgf.evaluation import metrics
from cgf.matching import MatchTable
from cgf.types import PointCloud

SUFFIXES = (".csv", ".npz")


@dataclass(frozen=True, eq=False)
class MatchErrors:
    """How wrong every match of a table is under a pose; rows as in the table."""

    errors: Float64[np.ndarray, "C"]
    """Distance to the true place, in cloud units; nan where no pose is known."""
    has_partner: Bool[np.ndarray, "C"]
    """Whether the source point could be matched rightly at all; False where no pose is known."""


def match_errors(
    source: PointCloud,
    target: PointCloud,
    table: MatchTable,
    *,
    target_from_source: Float64[np.ndarray, "4 4"] | None,
    tau: float,
) -> MatchErrors:
    """Measure every match of `table` under a pose.

    Args:
        source: Prepared cloud.
        target: Prepared cloud.
        table: Matches between their rows.
        target_from_source: The true pose or an estimate; None where neither is known.
        tau: A source point has a partner if the target comes at least this near, in cloud units.
    """
    indices = table.correspondences.indices
    if target_from_source is None:
        return MatchErrors(np.full(len(indices), np.nan), np.zeros(len(indices), dtype=np.bool_))
    errors = metrics.correspondence_errors(source.points, target.points, indices, target_from_source)
    partner = metrics.has_partner(source.points, target.points, target_from_source, tau=tau)
    return MatchErrors(errors, partner[indices[:, 0]])


def export_matches(
    path: Path,
    source: PointCloud,
    target: PointCloud,
    table: MatchTable,
    rows: Int64[np.ndarray, "R"],
    measured: MatchErrors,
) -> None:
    """Write `rows` of `table` to a CSV or NPZ file, one column or array a value.

    The columns are `source_index`, `target_index` (rows of the prepared clouds), `source_x` to `target_z` (their
    coordinates, in the files' own frames and units), `feature_distance`, `ratio`, `mutual`, `error` and `has_partner`;
    where the descriptor says them, also `source_quality` and `target_quality`.
    CSV holds every digit a float needs to be read back unchanged; booleans are 0 and 1.

    Raises:
        InputError: The name ends in neither `.csv` nor `.npz`, or the file cannot be written.
    """
    check_output(path)
    columns = _columns(source, target, table, rows, measured)
    if path.suffix.lower() == ".npz":
        write_whole(path, lambda file: np.savez_compressed(file, **columns))
    else:
        write_whole(path, lambda file: _write_csv(file, columns))


def write_whole(path: Path, write: Callable[[BinaryIO], None]) -> None:
    """Let `write` fill a file beside `path` that takes its place when complete, so that there is never half a file.

    Raises:
        InputError: The file cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            write(file)
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}; choose another place") from error
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file as `write_whole` does."""
    write_whole(path, lambda file: file.writelines([text.encode()]))


def check_output(path: Path, suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Refuse an output file before hours are spent on what should go into it.

    Raises:
        InputError: The name has another ending than `suffixes`, or the folder does not exist.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"output must end in {' or '.join(suffixes)}, got {path}")
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}; create it first")


def _columns(
    source: PointCloud,
    target: PointCloud,
    table: MatchTable,
    rows: Int64[np.ndarray, "R"],
    measured: MatchErrors,
) -> dict[str, Any]:
    chosen = table.correspondences.take(rows)
    source_points, target_points = source.points[chosen.indices[:, 0]], target.points[chosen.indices[:, 1]]
    qualities = {"source_quality": table.source_quality, "target_quality": table.target_quality}
    return {
        "source_index": chosen.indices[:, 0],
        "target_index": chosen.indices[:, 1],
        **{f"source_{axis}": source_points[:, column] for column, axis in enumerate("xyz")},
        **{f"target_{axis}": target_points[:, column] for column, axis in enumerate("xyz")},
        "feature_distance": chosen.distances,
        "ratio": chosen.ratios,
        "mutual": table.mutual[rows],
        "error": measured.errors[rows],
        "has_partner": measured.has_partner[rows],
        **{name: values[rows] for name, values in qualities.items() if values is not None},
    }


def _write_csv(file: BinaryIO, columns: dict[str, Any]) -> None:
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    # Booleans become 0 and 1; Python's floats are written with as many digits as they need.
    plain = [values.astype(np.int64) if values.dtype == bool else values for values in columns.values()]
    writer.writerows(zip(*(values.tolist() for values in plain), strict=True))
    text.detach()

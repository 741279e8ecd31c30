"""Goes through all groups and rows, and keeps what is done, so that a run that was stopped goes on where it was."""

import hashlib
import json
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.evaluation.matches import write_text
from cgf.evaluation.metrics import feature_matching_recall
from cgf.evaluation.suite.rows import Row, applies, fingerprint, measured_dims
from cgf.evaluation.suite.scoring import THRESHOLDS, Scorer
from cgf.evaluation.suite.sets import PairGroup
from cgf.types import IsCancelled, Progress, raise_if_cancelled

PROTOCOL = 1
"""Raised where the same features would be given other scores: nothing that was kept before is used then."""
GroupScores = dict[str, Any]
"""What is kept of one row on one group, as JSON holds it."""


def run_suite(
    groups: Sequence[PairGroup],
    rows: Sequence[Row],
    kept: Path,
    *,
    progress: Progress | None = None,
    told: Callable[[str], None] | None = None,
    cancelled: IsCancelled | None = None,
) -> list[GroupScores]:
    """Score every row on every group that it applies to.

    Args:
        groups: Those that share clouds follow each other.
        rows: Descriptors.
        kept: Folder of the scores that are done, a file for each row and group, found by all that they follow from.
        progress: Told the share of the pairs done.
        told: Told a line whenever a row is done on a group.
        cancelled: Asked now and then whether to give up; what is done stays kept.

    Raises:
        Cancelled: `cancelled` returned True.
        InputError: A cloud cannot be read.
    """
    kept.mkdir(parents=True, exist_ok=True)
    used = [row for row in rows if any(applies(row, group) for group in groups)]
    prints = {row: fingerprint(row) for row in used}
    total = sum(len(group.pairs) for group in groups for row in used if applies(row, group))
    results, done = [], 0
    for _, together in groupby(groups, key=lambda group: group.pairs[0].source.parent):
        sharing, scorer = list(together), Scorer(cancelled=cancelled)
        for row in used:
            scorer.forget_features()
            for group in (group for group in sharing if applies(row, group)):
                raise_if_cancelled(cancelled)
                path = kept / f"{_key(group, row, prints[row])}.json"
                if path.is_file():
                    results.append(json.loads(path.read_text("utf-8")))
                    done += len(group.pairs)
                    continue
                scores, before = [], (scorer.described, scorer.describe_s)
                for pair in group.pairs:
                    if progress is not None:
                        progress(done / total, f"{row.key}, {pair.name}")
                    scores.append(scorer.score(pair, group, row))
                    if group.set == "fgr":
                        # Lengths are shares of each pair's own diameter: no features serve two pairs.
                        scorer.forget_features()
                    done += 1
                described, describe_s = scorer.described - before[0], scorer.describe_s - before[1]
                result = {
                    "set": group.set,
                    "group": group.name,
                    "model": group.model,
                    "row": row.name,
                    "variant": row.variant,
                    "labels": {str(dim): row.label(dim) for dim in measured_dims(row, group)},
                    "described": described,
                    "describe_s": round(describe_s, 3),
                    "pairs": scores,
                }
                write_text(path, json.dumps(result))
                results.append(result)
                if told is not None:
                    told(_line(result))
    return results


def _key(group: PairGroup, row: Row, features: str) -> str:
    """A digest of all that the scores of a row on a group follow from."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(repr((PROTOCOL, group.set, group.name, group.model, group.perturbation)).encode())
    digest.update(repr((row.name, row.variant, measured_dims(row, group), features)).encode())
    for pair in group.pairs:
        sizes = [path.stat().st_size for path in (pair.source, pair.target)]
        digest.update(repr((pair.name, pair.source.name, pair.target.name, sizes, pair.viewpoint)).encode())
        digest.update(np.round(np.asarray(pair.target_from_source, np.float64), 6).tobytes())
    return digest.hexdigest()


def _line(result: GroupScores) -> str:
    """The widest features' scores in a line."""
    dim = list(result["labels"])[-1]
    scores = [pair["dims"][dim] for pair in result["pairs"]]
    limit = MODEL_DEFAULTS[result["model"]].precision_radius
    parts = []
    if "curve" in scores[0]:
        curves = np.array([score["curve"] for score in scores], np.float64)
        place = THRESHOLDS[result["model"]].index(limit)
        parts.append(f"precision {100 * np.nanmean(curves[:, place]):.1f} %")
    if "inlier_ratio" in scores[0]:
        ratios = np.array([score["inlier_ratio"] for score in scores], np.float64)
        parts += [
            f"recall at {100 * at:g} % {100 * feature_matching_recall(ratios, threshold=at):.1f} %"
            for at in (0.05, 0.2)
        ]
    name = f"{result['labels'][dim]} {result['variant']}".strip()
    return (
        f"{result['set']}, {result['group']}, {len(scores)} pair{'s' * (len(scores) > 1)}: {name}: {', '.join(parts)}"
    )

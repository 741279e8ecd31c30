"""What rules share: how findings are put together, and evidence that several of them give."""

from typing import Any

from cgf.diagnosis.findings import Evidence, Finding, Severity, Stage
from cgf.diagnosis.measures import RELIABLE_COUNT, RELIABLE_LEAD, RELIABLE_STABILITY, Measures
from cgf.diagnosis.trials import Trial

FEW_NEIGHBORS = 12
"""A frame from fewer points is chance."""
LOW_OVERLAP = 0.3
"""3DLoMatch begins below 30 %."""


def finding(
    kind: str,
    stage: Stage,
    severity: Severity,
    sentence: str,
    evidence: tuple[Evidence, ...],
    remedy: str,
    changes: dict[str, Any],
    confidence: float,
) -> Finding:
    """A finding whose changes are also given as options of the command line."""
    return Finding(
        kind, stage, severity, sentence, evidence, remedy, changes, command_options(changes).strip(), confidence
    )


def command_options(changes: dict[str, Any]) -> str:
    """The changes as options of the command line."""
    names = {
        "model": "--model", "support_radius": "--radius", "min_radius": "--min-radius", "lrf_radius": "--lrf-radius",
        "voxel_size": "--voxel", "max_ratio": "--ratio", "surest": "--surest", "unit": "--unit",
        "source_scale": "--source-scale", "normals": "--normals", "flip_normals": "--flip-normals",
    }  # fmt: skip
    shown = {name: f"{value:g}" if isinstance(value, float) else value for name, value in changes.items()}
    given = [f"{names[name]} {value}" for name, value in shown.items() if name in names and value is not None]
    left_out = [names[name] for name, value in changes.items() if name in names and value is None]
    if changes.get("mutual"):
        given.append("--mutual")
    return " ".join(given) + (f" (without {', '.join(left_out)})" if left_out else "")


def trial_evidence(trial: Trial | None) -> tuple[Evidence, ...]:
    """What a trial gave; nothing without one."""
    if trial is None:
        return ()
    return (
        Evidence(f"Of {trial.asked} sampled matches, agree on one pose then", trial.agreeing, "count"),
        Evidence("As it is", trial.before, "count"),
    )


def agreement_evidence(measured: Measures) -> tuple[Evidence, ...]:
    """How many matches stand behind the best pose, and how firmly."""
    first, second = measured.counts
    return (
        Evidence(f"Of {len(measured.asked)} mutual matches, agree on one pose", first, "count", RELIABLE_COUNT),
        Evidence("That many times those of the next pose", first / max(second, 1), "ratio", RELIABLE_LEAD),
        Evidence(
            "Weakest constraint of these over the strongest", measured.pose_stability, "ratio", RELIABLE_STABILITY
        ),
    )


def least_frame(measured: Measures) -> int:
    """Neighbours in a frame of the cloud that has fewer."""
    return min(measured.source.frame_neighbors, measured.target.frame_neighbors)


def rounded(value: float, digits: int = 3) -> float:
    """A length or factor as a person would type it."""
    return float(f"{value:.{digits}g}")

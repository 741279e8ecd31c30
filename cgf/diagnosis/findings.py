"""What a diagnosis says: plain values, ready to be printed or to become JSON."""

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64

Stage = Literal["input", "overlap", "radius", "features", "matching", "estimator"]
"""Where on the way from files to a pose something goes wrong."""
Severity = Literal["problem", "caution", "fine"]
Outcome = Literal["registered", "failed", "doubtful"]
Quantity = Literal["share", "count", "length", "ratio", "degrees"]


@dataclass(frozen=True)
class Evidence:
    """One number that was measured, and what it is judged against."""

    name: str
    value: float | int
    quantity: Quantity
    """Lengths are in cloud units."""
    threshold: float | int | None = None
    """None where the number is told, not judged."""
    rule: Literal["at least", "at most"] = "at least"
    """How the value should lie to the threshold."""
    estimated: bool = False
    """Whether it rests on an estimate in place of a known pose."""

    @property
    def holds(self) -> bool:
        """Whether the value is as it should be."""
        if self.threshold is None:
            return True
        return self.value >= self.threshold if self.rule == "at least" else self.value <= self.threshold


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or was checked and is not."""

    kind: str
    """What it is about, e.g. `normals` or `overlap`; the same word for a problem and for its absence."""
    stage: Stage
    severity: Severity
    sentence: str
    """What is the matter, in one sentence."""
    evidence: tuple[Evidence, ...] = ()
    remedy: str = ""
    """What to do about it, in one sentence; empty where nothing is to be done."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Settings (of `cgf.PairSettings`) that mend it; empty where none does."""
    options: str = ""
    """The same as options of the command line."""
    confidence: float = 1.0
    """From 0 to 1: how sure the sentence is."""


@dataclass(frozen=True, eq=False)
class Place:
    """Points that a finding concerns, as rows of the prepared clouds."""

    source: Int64[np.ndarray, "K"]
    target: Int64[np.ndarray, "L"]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Whether two clouds register, and if not, why."""

    outcome: Outcome
    verdict: str
    """One sentence: what came out, the main reason, and what to try."""
    is_judged_by_truth: bool
    """Whether the true pose was known; without it the outcome itself is an estimate."""
    findings: tuple[Finding, ...]
    """Worst first, then in the order of the stages; those that are fine come last."""
    places: dict[str, Place] = field(default_factory=dict)
    """By the kind of the finding, where it concerns some points more than others."""
    pose: Float64[np.ndarray, "4 4"] | None = None
    """`target_from_source` that most matches agree on, found apart from the estimate; None where it is not reliable."""

    @property
    def problems(self) -> tuple[Finding, ...]:
        """The findings that are problems."""
        return tuple(finding for finding in self.findings if finding.severity == "problem")

    def finding(self, kind: str) -> Finding | None:
        """The finding of that kind, if there is one."""
        return next((finding for finding in self.findings if finding.kind == kind), None)

    def as_plain(self) -> dict[str, Any]:
        """Everything but the points concerned, as dictionaries, lists, numbers and text."""
        findings = [
            {
                **asdict(finding),
                "evidence": [{**asdict(item), "holds": item.holds} for item in finding.evidence],
                "has_place": finding.kind in self.places,
            }
            for finding in self.findings
        ]
        return {
            "outcome": self.outcome,
            "verdict": self.verdict,
            "is_judged_by_truth": self.is_judged_by_truth,
            "findings": findings,
            "pose": None if self.pose is None else self.pose.tolist(),
        }

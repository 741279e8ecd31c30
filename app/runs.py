"""Poses that were looked for from the page."""

from dataclasses import dataclass

from cgf.pipeline import RegistrationSettings
from cgf.types import RegistrationResult

MAX_RUNS = 12
"""How many are kept; the oldest goes first."""
_METHODS = {"ransac": "RANSAC", "fgr": "FGR", "icp": "ICP"}
_STARTS = {"loaded": "as loaded", "ground_truth": "the truth", "estimate": "the estimate", "automatic": "the estimate",
           "between": "the pose shown"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Run:
    """One search for the pose."""

    number: int
    """From 1, in the order they were asked for."""
    wanted: RegistrationSettings
    start: str | None
    """Name of the pose that ICP alone started from."""
    result: RegistrationResult
    elapsed_s: float

    @property
    def name(self) -> str:
        """How settings refer to its pose."""
        return f"run-{self.number}"

    @property
    def label(self) -> str:
        """What a person reads, such as `3: FGR, ICP`."""
        words = [_METHODS[self.wanted.method]]
        if self.wanted.method == "icp":
            start = self.start or "loaded"
            words = [f"ICP, {self.wanted.metric}s", f"from {_STARTS.get(start, start.replace('run-', ''))}"]
        elif self.wanted.refine:
            words.append("ICP")
        return f"{self.number}: {', '.join(words)}"

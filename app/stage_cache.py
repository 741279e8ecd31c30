"""Results of the stages of one run, in memory."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

Value = TypeVar("Value")

_KEPT = {"load": 3, "correct": 3, "prepare": 6, "show": 6, "describe": 16, "match": 32, "matched": 32, "register": 64}
"""How many results of each stage are kept; features are the largest, 33 MB for 65,000 points in 128 dimensions."""


class StageCache:
    """Results of stages by what they depend on; the longest unused one goes first. For any number of threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._results: dict[str, OrderedDict[Hashable, Any]] = {stage: OrderedDict() for stage in _KEPT}

    def has(self, stage: str, key: Hashable) -> bool:
        """Whether `get` would find something."""
        return key in self._results[stage]

    def get(self, stage: str, key: Hashable, compute: Callable[[], Value]) -> Value:
        """The result kept under `key`, or else a new one; a failed or cancelled computation leaves nothing behind."""
        with self._lock:
            results = self._results[stage]
            if key in results:
                results.move_to_end(key)
                kept: Value = results[key]
                return kept
        # Two threads that want the same at the same time both compute it, which is seldom and harms nothing.
        value = compute()
        with self._lock:
            results[key] = value
            if len(results) > _KEPT[stage]:
                results.popitem(last=False)
        return value

    def peek(self, stage: str, key: Hashable) -> Any:
        """The result kept under `key`, or None."""
        with self._lock:
            return self._results[stage].get(key)

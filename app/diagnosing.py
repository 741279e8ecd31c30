"""The diagnosis of the pair that is shown, made in the background once everything else is done."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from app.analysis import Analysis, Analyst, kept_rows
from app.colors import NO_MATCH, SOURCE_TINT, TARGET_TINT, Colors
from app.jobs import Job
from app.legend import hexed
from app.picture import CloudPicture, Picture
from app.settings import ViewSettings
from app.snapshot import DiagnosisInfo, Legend, Swatch
from app.workbench import Host, Workbench
from cgf.checks import InputError
from cgf.diagnosis import Case, Diagnosis, Place, diagnose, diagnose_loaded

_PLACES = {
    "overlap": "points with a partner",
    "normals": "neighbours' normals oppose theirs",
    "features": "points with distinctive features",
    "agreement": "points whose matches agree",
    "repetition": "points whose matches agree on the best pose",
    "estimator": "points whose matches agree",
}
"""What is highlighted, by the kind of the finding."""


class Diagnosing:
    """Keeps the diagnosis of what is shown up to date. Methods may be called from any thread."""

    def __init__(self, host: Host, analyst: Analyst, workbench: Workbench, *, patience_s: float) -> None:
        """Nothing runs before the first `update`, and for `patience_s` after it."""
        self._patience_s = patience_s
        self._host = host
        self._analyst = analyst
        self._tasks = workbench.tasks
        self._lock = threading.Lock()
        self._key: tuple[object, ...] | None = None
        self._number = 0
        self._found: Diagnosis | None = None

    def update(self, analysis: Analysis, settings: ViewSettings) -> None:
        """Diagnose a pair whose matches and pose are there, unless that has been done."""
        if analysis.matches is None:
            return
        pose = analysis.estimate
        key = (analysis.index, settings.pair_settings(), None if pose is None else pose.tobytes())
        with self._lock:
            if key == self._key:
                return
            self._key, self._found = key, None
        case = _case(analysis, settings)
        self._run(key, lambda job: diagnose(case, progress=job.progress, cancelled=job.is_cancelled))

    def explain(self, settings: ViewSettings, error: ValueError) -> None:
        """Diagnose a pair that cannot be computed at all, because of `error`."""
        wanted = settings.pair_settings()
        key = (settings.pair, wanted, str(error))
        with self._lock:
            self._key, self._found = key, None

        def work(job: Job) -> Diagnosis:
            pair = self._analyst.corrected(settings.pair, wanted)
            return diagnose_loaded(wanted, pair.source, pair.target, str(error), cancelled=job.is_cancelled)

        self._run(key, work, is_explanation=True)

    def stop(self) -> None:
        """What is shown is about to change."""
        with self._lock:
            is_under_way = self._key is not None and self._found is None
            if is_under_way:
                self._key = None
        if is_under_way:
            self._tasks.cancel("diagnose")

    def info(self) -> DiagnosisInfo | None:
        """The diagnosis in short, once it is there."""
        with self._lock:
            found, number = self._found, self._number
        if found is None:
            return None
        counts = [
            sum(finding.severity == severity for finding in found.findings) for severity in ("problem", "caution")
        ]
        return DiagnosisInfo(number, found.outcome, found.verdict, *counts)

    def plain(self) -> dict[str, Any]:
        """The whole diagnosis, ready to become JSON.

        Raises:
            InputError: There is none yet.
        """
        with self._lock:
            found, number = self._found, self._number
        if found is None:
            raise InputError("There is no diagnosis yet; wait until it is made.")
        return {"number": number, **found.as_plain()}

    def highlight(self, picture: Picture, analysis: Analysis, settings: ViewSettings) -> Picture:
        """The picture with the points of the chosen finding in colour and all others dark."""
        place = self._place(settings)
        if place is None:
            return picture
        return replace(
            picture,
            source=_painted(picture.source, place.source, len(analysis.source), SOURCE_TINT),
            target=_painted(picture.target, place.target, len(analysis.target), TARGET_TINT),
        )

    def legend(self, legend: Legend, settings: ViewSettings) -> Legend:
        """What the colours of `highlight` mean; `legend` itself where nothing is highlighted."""
        place = self._place(settings)
        if place is None or settings.highlight is None:
            return legend
        meaning = _PLACES[settings.highlight]
        sides = (("source", place.source, SOURCE_TINT), ("target", place.target, TARGET_TINT))
        swatches = [Swatch(hexed(tint), side) for side, rows, tint in sides if len(rows)]
        return replace(
            legend, coloring="original", title=f"Highlighted: {meaning}", ramp=(), scale=None,
            swatches=(*swatches, Swatch(hexed(NO_MATCH), "all others")),
        )  # fmt: skip

    def _place(self, settings: ViewSettings) -> Place | None:
        with self._lock:
            found = self._found
        return None if found is None or settings.highlight is None else found.places.get(settings.highlight)

    def _run(self, key: tuple[object, ...], make: Callable[[Job], Diagnosis], *, is_explanation: bool = False) -> None:
        def work(job: Job) -> None:
            job.pause(self._patience_s)
            found = make(job)
            with self._lock:
                job.check()
                if self._key != key:
                    return
                self._found = found
                self._number += 1
            self._host.renewed()
            if is_explanation and found.findings[0].kind == "scale":
                # The error that is shown names what came of it, not the cause.
                self._host.failed(InputError(f"{found.verdict} See the tab Diagnosis."))

        self._tasks.submit("diagnose", "Looking for what is wrong", work)


def _case(analysis: Analysis, settings: ViewSettings) -> Case:
    assert analysis.matches is not None
    assert analysis.source_features is not None
    assert analysis.target_features is not None
    return Case(
        wanted=settings.pair_settings(),
        settings=analysis.resolved,
        loaded_source=analysis.pair.source,
        loaded_target=analysis.pair.target,
        source=analysis.source,
        target=analysis.target,
        source_features=analysis.source_features,
        target_features=analysis.target_features,
        table=analysis.matches,
        rows=kept_rows(analysis.matches, settings),
        truth=analysis.truth,
        estimate=analysis.estimate,
    )


def _painted(cloud: CloudPicture, rows: np.ndarray, count: int, tint: tuple[int, int, int]) -> CloudPicture:
    colors: Colors = np.tile(np.asarray(NO_MATCH, dtype=np.uint8), (count, 1))
    colors[rows] = tint
    return replace(cloud, colors=colors[cloud.prepared_rows])

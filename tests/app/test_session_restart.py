"""What a second run of the viewer finds on disk."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from app.session import Session
from cgf import pipeline
from tests.app.scenes import LONG_S, SETTINGS, hills, run, source_of


def test_a_second_run_of_the_viewer_computes_nothing_again(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = pipeline.DiskCache(tmp_path_factory.mktemp("cache"))
    snapshots = []
    described: list[int] = []
    describe = pipeline.describe

    def noting(*arguments: Any, indices: npt.NDArray[np.int64], **named: Any) -> object:
        described.append(len(indices))
        return describe(*arguments, indices=indices, **named)

    monkeypatch.setattr(pipeline, "describe", noting)
    for _ in range(2):
        described.clear()
        session = Session([source_of(hills())], SETTINGS, disk=disk)
        snapshots.append(run(session))
        assert snapshots[-1].settled, snapshots[-1].messages
        session.close()
        monkeypatch.setattr("cgf.pipeline.cache.describe", None)
        monkeypatch.setattr("cgf.pipeline.cache.match_both_features", None)
    assert snapshots[0].numbers == snapshots[1].numbers
    assert len(list(disk.folder.iterdir())) == 3
    assert described == []
    monkeypatch.undo()
    monkeypatch.setattr(pipeline, "describe", noting)
    session = Session([source_of(hills())], SETTINGS, disk=disk, patience_s=1e-3)
    run(session)
    # With a browser that is waited for, kernels are loaded and other dimensions matched before they are asked for.
    assert session.ahead.wait(LONG_S)
    dimensions = session.workbench.plots().dims.points
    session.close()
    assert len(described) == 1
    assert described[0] < 10
    assert len(dimensions) > 1
    assert all(point.precision is not None for point in dimensions)

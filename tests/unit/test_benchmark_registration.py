"""`python -m benchmarks.registration` measures poses as the set's own evaluation does."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import main, set_rmse
from cgf.datasets.fgr import load_fgr
from cgf.geometry import transforms


def test_the_error_of_the_truth_is_the_noise_and_grows_with_a_shift(shared: Path) -> None:
    (pair,) = load_fgr(shared / "data/objects/fgr_level_01", [3])
    truth = pair.target_from_source
    assert truth is not None
    # The published evaluation has 0.0037 on average over all pairs, 0.0039 at most.
    assert 0.003 < set_rmse(pair, truth) < 0.004
    shift = transforms.rigid(np.eye(3), [0.2, 0.0, 0.0])
    assert set_rmse(pair, shift @ truth) == pytest.approx(0.1, abs=0.005)
    assert np.isnan(set_rmse(pair, None))


@pytest.mark.slow
def test_every_estimator_registers_a_pair_of_the_set(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(shared / "data/objects/fgr_level_01"), "--pairs", "3"])
    table = capsys.readouterr().out.split("\n\n")[1].splitlines()
    assert [line[:18].strip() for line in table[1:]] == [
        "the truth itself",
        "fgr",
        "ransac",
        "fgr, then icp",
        "ransac, then icp",
    ]
    assert all("1 of 1" in line for line in table[1:])

"""How well and how fast the estimators do on the synthetic pairs of Fast Global Registration (Zhou, Park, Koltun 2016).

`python -m benchmarks.registration objects/fgr_level_01` takes some minutes for all 25 pairs, nearly all of them for the
features. The error is the set's own: the root mean square distance of the source points that have a target point nearer
than 0.0125 under the true pose to that point, divided by 2.
"""

import argparse
import math
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from cgf import pipeline
from cgf.datasets.fgr import find_fgr
from cgf.geometry import transforms
from cgf.geometry.neighbors import nearest
from cgf.io import read_pairs
from cgf.pipeline import PairSettings, RegistrationSettings
from cgf.types import Pair, Transform

NEAR = 0.0125
METHODS = (
    RegistrationSettings("fgr", refine=False),
    RegistrationSettings("ransac", refine=False),
    RegistrationSettings("fgr"),
    RegistrationSettings("ransac"),
)


def set_rmse(pair: Pair, pose: Transform | None) -> float:
    """The error of a pose as the set measures it; nan without one."""
    assert pair.target_from_source is not None
    if pose is None:
        return math.nan
    rows, distances = nearest(pair.target.points, transforms.apply(pair.target_from_source, pair.source.points))
    near = distances < NEAR
    moved = transforms.apply(pose, pair.source.points[near])
    return float(np.sqrt(np.mean(np.square(moved - pair.target.points[rows[near]]).sum(axis=1)))) / 2


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of one noise level, with pair_01 and so on")
    parser.add_argument("--pairs", type=int, nargs="+", metavar="N", help="numbers of the pairs (default: all)")
    options = parser.parse_args(arguments)
    errors, seconds = defaultdict(list), defaultdict(list)
    for pair in read_pairs(find_fgr(options.data, options.pairs)):
        errors["the truth itself"].append(set_rmse(pair, pair.target_from_source))
        result = pipeline.run_pair(pair.source, pair.target, PairSettings())
        for wanted in METHODS:
            name = f"{wanted.method}, then icp" if wanted.refine else wanted.method
            started = time.perf_counter()
            found = pipeline.register_pair(
                result.source, result.target, result.correspondences, result.settings, wanted
            )
            seconds[name].append(time.perf_counter() - started)
            errors[name].append(set_rmse(pair, found.target_from_source))
        print(pair.name, *(f"{name} {values[-1]:.4f}" for name, values in errors.items()), sep="  ", flush=True)
    print(f"\n{'method':18}{'mean':>8}{'largest':>9}{'below .01':>11}{'seconds':>9}")
    for name, values in errors.items():
        below = f"{sum(value < 0.01 for value in values)} of {len(values)}"
        took = f"{np.mean(seconds[name]):.2f}" if name in seconds else ""
        print(f"{name:18}{np.nanmean(values):>8.4f}{np.nanmax(values):>9.4f}{below:>11}{took:>9}")


if __name__ == "__main__":
    main()

"""Which pairs are measured: the benchmark sets, in groups of pairs that share clouds."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from cgf.checks import InputError
from cgf.datasets.demo import find_demo
from cgf.datasets.fgr import find_fgr
from cgf.datasets.match3d import find_scene
from cgf.datasets.stanford import find_stanford
from cgf.descriptors.settings import ModelName
from cgf.evaluation.suite.perturbation import Perturbation, perturbations
from cgf.io import PairFiles

SetName = Literal["demo", "fgr", "happy", "radii", "rooms", "lomatch", "cross", "robustness"]
SETS: tuple[SetName, ...] = get_args(SetName)

FGR = Path("objects/fgr_level_01")
HAPPY = Path("objects/stanford_happy")
SCENES = Path("indoor/3dmatch")
VALIDATION_PAIRS = tuple(f"pair_{number:02d}" for number in range(6, 11))
"""Of the FGR set: they chose among weights, so figures without them stand beside those of all."""
TEST_SCENES = ("7-scenes-redkitchen", "sun3d-home_at-home_at_scan1_2013_jan_1")
"""No weights but those for cross-validation were trained on them or chosen by them."""
_LOGS: dict[SetName, str] = {"rooms": "gt.log", "cross": "gt.log", "lomatch": "gt_lomatch.log"}
VALIDATION_SCENE = "sun3d-mit_lab_hj-lab_hj_tea_nov_2_2012_scan1_erika"
RADII_PAIRS = 15
"""Of the validation scene, on which FPFH's radius is chosen."""
ROBUSTNESS_PAIRS = 4
"""Of the FGR set, and of each test scene half as many."""
QUICK_PAIRS = 2
"""Of each group, for `--quick`."""


@dataclass(frozen=True, eq=False)
class PairGroup:
    """Pairs of one set that share clouds, or settings."""

    set: SetName
    name: str
    """The scene, or what is done to the clouds."""
    model: ModelName
    pairs: tuple[PairFiles, ...]
    perturbation: Perturbation | None = None
    """What is done to the source, or to the radius, before it is described."""
    has_one_scale: bool = False
    """Whether shares of the diameter are those of the largest cloud, so that each is described once."""

    @property
    def with_precision(self) -> bool:
        """Whether every target point may be matched, which precision needs."""
        return self.set not in ("lomatch", "cross")

    @property
    def with_recall(self) -> bool:
        """Whether inlier ratios are measured by the protocol of the 3DMatch benchmark."""
        return self.set in ("rooms", "lomatch", "cross")


def find_groups(data: Path, only: Collection[SetName] = SETS, *, limit: int | None = None) -> list[PairGroup]:
    """The groups of the sets `only`, of which all that share clouds follow each other.

    Args:
        data: Folder of the benchmark data, with `objects` and `indoor`.
        only: Sets wanted.
        limit: Most pairs of a group, spread evenly; None takes all.

    Raises:
        InputError: A set that is wanted is missing or damaged.
    """
    if not data.is_dir():
        raise InputError(f"--data must be the folder of the benchmark data, got {data}; check the path")
    groups: list[PairGroup] = []
    if "demo" in only:
        groups.append(PairGroup("demo", "demo", "indoor", (find_demo(),)))
    if "fgr" in only:
        groups.append(PairGroup("fgr", "fgr", "object", _spread(find_fgr(data / FGR), limit)))
    if "happy" in only:
        pairs = _spread(find_stanford(data / HAPPY), limit)
        groups.append(PairGroup("happy", "happy", "object", pairs, has_one_scale=True))
    if "radii" in only:
        chosen = find_fgr(data / FGR, [int(name.removeprefix("pair_")) for name in VALIDATION_PAIRS])
        groups.append(PairGroup("radii", "fgr", "object", _spread(chosen, limit)))
        pairs = _spread(find_scene(data / SCENES / VALIDATION_SCENE), min(limit or RADII_PAIRS, RADII_PAIRS))
        groups.append(PairGroup("radii", VALIDATION_SCENE, "indoor", pairs))
    for scene in _scenes(data) if {"rooms", "lomatch", "cross"} & set(only) else ():
        for name, log in _LOGS.items():
            if name in only and (name == "cross" or scene.name in TEST_SCENES):
                groups.append(PairGroup(name, scene.name, "indoor", _spread(find_scene(scene, log=log), limit)))
    if "robustness" in only:
        groups += _robustness(data, limit)
    return groups


def _robustness(data: Path, limit: int | None) -> list[PairGroup]:
    count = ROBUSTNESS_PAIRS if limit is None else min(limit, ROBUSTNESS_PAIRS)
    objects = _spread([pair for pair in find_fgr(data / FGR) if pair.name not in VALIDATION_PAIRS], count)
    rooms = [
        replace(pair, name=f"{scene} {pair.name}")
        for scene in TEST_SCENES
        for pair in _spread(find_scene(data / SCENES / scene), max(count // 2, 1))
    ]
    of_model: dict[ModelName, tuple[PairFiles, ...]] = {"object": objects, "indoor": tuple(rooms)}
    return [
        PairGroup("robustness", f"{model}: {change.label}", model, pairs, change)
        for model, pairs in of_model.items()
        for change in perturbations()
    ]


def _scenes(data: Path) -> list[Path]:
    found = sorted(log.parent for log in (data / SCENES).glob("*/gt.log"))
    if not found:
        raise InputError(f"{data / SCENES} must have scenes with a gt.log, got none; check --data")
    return found


def _spread(pairs: Sequence[PairFiles], limit: int | None) -> tuple[PairFiles, ...]:
    """So many of the pairs, evenly spread."""
    if limit is None or limit >= len(pairs):
        return tuple(pairs)
    return tuple(pairs[row * len(pairs) // limit] for row in range(limit))

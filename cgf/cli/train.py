"""The command `cgf train`: weights from somebody's own meshes or scans."""

import argparse
import os
import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any

from cgf.cli.cards import find_folders, options_of_card
from cgf.cli.common import note, progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf train`."""
    _add_settings(parser)
    again = parser.add_argument_group("weights made before")
    again.add_argument(
        "--config", type=Path, metavar="CARD.json", help="train as this card says; options beside it come first"
    )
    again.add_argument(
        "--data-root", type=Path, metavar="FOLDER", help="where the card's data lies, at any depth (default: here)"
    )


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Options of the names in `TrainSettings`, which has their meaning and defaults."""
    data = parser.add_argument_group("data (one of the two)")
    data.add_argument("--meshes", type=Path, metavar="FOLDER", help="meshes, of which range images are rendered")
    data.add_argument(
        "--scenes",
        type=Path,
        nargs="+",
        metavar="FOLDER",
        help="scenes, each with fragments cloud_bin_N.ply and logs of their relative poses",
    )
    data.add_argument("--logs", nargs="+", metavar="NAME", help="names of the logs in those folders (default: gt.log)")
    data.add_argument("--view-sets", type=int, metavar="N", help="sets of 14 range images a mesh, each turned anew")
    data.add_argument("--noise", type=float, nargs=2, metavar=("LOW", "HIGH"), help="of range images, in diameters")
    data.add_argument("--voxel-sizes", type=float, nargs="+", metavar="V", help="densities of scenes, in metres")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="NAME.safetensors", help="weights to write")
    parser.add_argument(
        "--model",
        choices=("object", "indoor"),
        help="lengths as shares of the diameter, or in metres (default: object)",
    )
    recipe = parser.add_argument_group("recipe")
    recipe.add_argument(
        "--recipe",
        choices=("contrastive", "paper", "pca"),
        help="ours; triplets as published; or principal components (default: contrastive)",
    )
    recipe.add_argument(
        "--network", choices=("azimuth", "paper"), help="default: azimuth, or paper for the recipe paper"
    )
    recipe.add_argument("--frame", choices=("normal", "paper"), help="default: normal, or paper for the recipe paper")
    recipe.add_argument(
        "--histogram",
        choices=("normals", "roots", "counts"),
        help="what the network is given (default: roots and means of normals, or counts for paper)",
    )
    recipe.add_argument("--dims", type=int, nargs="+", metavar="N", help="widths; paper and pca take the last alone")
    recipe.add_argument("--width", type=int, metavar="N", help="channels of the azimuth network (default: 192)")
    recipe.add_argument("--steps", type=int, metavar="N", help="minibatches (default: 6000, or 3 epochs for paper)")
    recipe.add_argument("--support-radius", type=float, metavar="R", help="described, in diameters or metres")
    recipe.add_argument("--min-radius", type=float, metavar="R", help="of the innermost shell")
    recipe.add_argument(
        "--insets", type=int, nargs="+", metavar="N", help="join supports smaller by N shells (default: 0, one support)"
    )
    recipe.add_argument(
        "--context", type=float, nargs="+", metavar="R", help="join means of features within R innermost shells"
    )
    recipe.add_argument("--join-steps", type=int, metavar="N", help="minibatches in which that is learned, at the end")
    recipe.add_argument("--batch", type=int, metavar="N", help="correspondences or triplets a minibatch")
    recipe.add_argument("--overlaps-per-batch", type=int, metavar="N", help="pairs of clouds a minibatch draws from")
    recipe.add_argument(
        "--scenes-per-batch", type=int, metavar="N", help="scenes or meshes these are of (default: any)"
    )
    recipe.add_argument(
        "--negatives",
        choices=("overlap", "place"),
        help="of the same scene: from the same pair of clouds, or wherever poses are known (default: overlap)",
    )
    recipe.add_argument("--learning-rate", type=float, metavar="X", help="default: 1e-3, or 1e-4 for paper")
    recipe.add_argument("--temperature", type=float, metavar="X", help="of the contrastive loss")
    recipe.add_argument("--weight-decay", type=float, metavar="X", help="of the contrastive recipe (default: 0.01)")
    recipe.add_argument("--dropout", type=float, metavar="SHARE", help="in the azimuth network (default: 0)")
    augmentation = parser.add_argument_group("augmentation of the contrastive recipe, drawn anew for every batch")
    augmentation.add_argument(
        "--normal-radii", type=float, nargs="+", metavar="R", help="clouds with normals estimated anew, in voxels"
    )
    augmentation.add_argument("--stretch", type=float, metavar="X", help="clouds along random axes, by up to 1 + X")
    augmentation.add_argument("--bend", type=float, metavar="X", help="clouds by waves, each of which stretches by X")
    augmentation.add_argument("--mirror", type=float, metavar="SHARE", help="of overlaps that are mirrored")
    augmentation.add_argument("--holes", type=float, metavar="SHARE", help="of clouds that lose some balls of points")
    augmentation.add_argument("--cut", type=float, metavar="SHARE", help="of clouds that end at a random plane")
    recipe.add_argument("--seed", type=int, metavar="N", help="same seed and threads, same weights (default: 1)")
    machine = parser.add_argument_group("machine")
    machine.add_argument("--precision", choices=("bfloat16", "float32"), help="bfloat16 is quick where there is AMX")
    machine.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda", "mps"),
        help="where the network is trained; auto takes a GPU where there is one (default: cpu)",
    )
    machine.add_argument("--threads", type=int, metavar="N", help="of torch (default: 1)")
    machine.add_argument("--checkpoint-every", type=int, metavar="N", help="minibatches between checkpoints")


def run(options: argparse.Namespace) -> int:
    """Train, or go on with a run that was cut off."""
    from cgf.checks import InputError
    from cgf.training.settings import TrainSettings

    if os.environ.get("RANK", "0") != "0":
        options.quiet = True  # Of the processes that torchrun starts, the first speaks.
    given = _given(options)
    if options.config is not None:
        given = _of_card(options, given) | given
    elif options.data_root is not None:
        raise InputError("--data-root must come with --config")
    settings = TrainSettings(**given)
    if not settings.output.parent.is_dir():
        raise InputError(f"{settings.output} cannot be written: there is no folder {settings.output.parent}; create it")
    try:
        from cgf.training import recipes
    except ModuleNotFoundError as error:
        remedy = "install the extra `train`, for example by uv sync --frozen --inexact --extra train"
        raise InputError(f"training needs {error.name}, which is not installed; {remedy}") from error
    with progress_bar(options) as progress:
        network = recipes.run(settings, command=_command(given), progress=progress or _silent)
    note(options, f"Wrote {settings.output} and its card, {settings.output.with_suffix('.json')}")
    note(options, f"Trained on {network.card.training['clouds']:,} clouds: {network.card.data}")
    return 0


def _given(options: argparse.Namespace) -> dict[str, Any]:
    """The settings that are not left to their defaults."""
    from cgf.training.settings import TrainSettings

    values = {item.name: getattr(options, item.name) for item in fields(TrainSettings)}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in values.items() if v is not None}


def _of_card(options: argparse.Namespace, given: dict[str, Any]) -> dict[str, Any]:
    """The settings that a card was made with; its data is looked for unless other data is given."""
    stored = _given(options_of_card(options.config, _add_settings))
    meshes, scenes = stored.pop("meshes", None), stored.pop("scenes", None)
    root = Path() if options.data_root is None else options.data_root
    if "meshes" not in given and "scenes" not in given:
        if meshes is not None:
            stored["meshes"] = find_folders([str(meshes)], root, option="--meshes")[0]
        if scenes is not None:
            stored["scenes"] = tuple(find_folders(list(map(str, scenes)), root, option="--scenes"))
    return stored


def _command(given: dict[str, Any]) -> str:
    """The command that makes these weights again, with names of folders instead of paths."""
    from cgf.training.settings import TrainSettings

    words = ["cgf", "train"]
    defaults = {item.name: item.default for item in fields(TrainSettings)}
    for name, value in given.items():
        if value == defaults[name] and name != "seed":
            continue
        words.append(f"--{name.replace('_', '-')}")
        parts = value if isinstance(value, tuple) else (value,)
        words.extend(part.resolve().name if isinstance(part, Path) else str(part) for part in parts)
    if "seed" not in given:
        words += ["--seed", "1"]
    return shlex.join(words)


def _silent(share: float, text: str) -> None:
    """Progress that nobody sees."""

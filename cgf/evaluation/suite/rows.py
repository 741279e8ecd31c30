"""Which descriptors are measured: those that come with the package, and one for every weights file in a folder."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cgf import pipeline
from cgf.checks import InputError
from cgf.datasets.demo import find_demo
from cgf.descriptors.network import load_network, shipped_weights
from cgf.descriptors.settings import MODEL_DEFAULTS, ModelName
from cgf.evaluation.suite.sets import PairGroup
from cgf.pipeline import PairSettings

FPFH_RADII: dict[ModelName, tuple[float, ...]] = {"object": (0.03, 0.05, 0.08, 0.12), "indoor": (0.15, 0.25, 0.4)}
"""Of FPFH's own neighbourhood: shares of the diameter, metres; the best of them on validation pairs is its default."""
FPFH_DEFAULT: dict[ModelName, float] = {"object": 0.08, "indoor": 0.4}
COMPARED_DIMS = (8, 16, 32)
CROSS = "cross-"
"""Weights so named are for cross-validation: they appear only on scenes that they were not trained on."""
_FINGERPRINT_POINTS = 64


@dataclass(frozen=True)
class Row:
    """A descriptor for one model."""

    name: str
    model: ModelName
    settings: PairSettings
    dims: tuple[int, ...]
    """Widths measured, ascending; `settings` name the largest."""
    variant: str = ""
    """What distinguishes rows of one name, of which the best counts."""
    is_default: bool = True
    """Whether it is the variant measured everywhere."""
    radius_factor: float = 1.0
    """By which the support radius differs from the model's."""
    weights: Path | None = None
    """File of the network, those of the package included."""
    trained_on: str = ""
    """As the card says it."""
    title: str = ""
    """What tables call it, without the dimension."""
    place: int = 0
    """In the order of the tables."""

    @property
    def key(self) -> str:
        """Unlike that of every other row of the model."""
        return f"{self.name} {self.variant}".strip()

    def label(self, dim: int) -> str:
        """What tables call the row in `dim` dimensions."""
        single = self.name == "fpfh" or self.name.endswith(f"-{dim}")
        return self.name if single else f"{self.name}-{dim}"


def find_rows(folder: Path | None = None) -> list[Row]:
    """All rows, those of the package first, then those of the files in `folder` by their place and name.

    The row of `NAME-object.safetensors` and `NAME-indoor.safetensors` is called NAME. What its card holds under
    `training` as `label` is its title, and as `place` its number in the order of the tables.

    Raises:
        InputError: The folder is missing, or a file in it is no weights.
    """
    rows = [_learned("cgf", shipped_weights(f"cgf-{model}")) for model in MODEL_DEFAULTS]
    rows += [_fpfh(model, radius) for model, radii in FPFH_RADII.items() for radius in radii]
    rows += [_projected(model) for model in MODEL_DEFAULTS]
    if folder is not None:
        if not folder.is_dir():
            raise InputError(f"--weights-folder must be a folder of weights, got {folder}; check the path")
        rows += sorted(
            (_learned(None, path) for path in folder.glob("*.safetensors")), key=lambda row: (row.place, row.name)
        )
    return rows


def applies(row: Row, group: PairGroup) -> bool:
    """Whether a row is measured on a group: never on scenes that it was trained on, and where it adds something."""
    if row.model != group.model or group.name in row.trained_on:
        return False
    if group.set == "cross":
        return row.name.startswith(CROSS)
    if row.name.startswith(CROSS):
        return False
    if group.set == "radii":
        return row.name == "fpfh"
    if group.set == "robustness":
        return row.name in ("cgf", "fpfh") and row.is_default
    return row.is_default


def measured_dims(row: Row, group: PairGroup) -> tuple[int, ...]:
    """The widths of a row that are measured on a group: all on the set for the curve over dimensions."""
    if group.set == "fgr" or len(row.dims) == 1:
        return row.dims
    if group.set == "robustness" or row.name != "cgf":
        return (max(dim for dim in row.dims if dim <= COMPARED_DIMS[-1]),)
    return tuple(dim for dim in row.dims if dim in COMPARED_DIMS)


def fingerprint(row: Row) -> str:
    """A digest of features that the row gives on the demo, and of its settings there.

    It changes with weights and with code wherever either changes features, and with nothing else.
    """
    pair = find_demo().read()
    settings = pipeline.resolve(row.settings, pair.source, pair.target)
    cloud = pipeline.prepare(pair.target, settings)
    places = np.linspace(0, len(cloud) - 1, _FINGERPRINT_POINTS).astype(np.int64)
    features = pipeline.describe(cloud, settings)
    digest = hashlib.blake2b(digest_size=16)
    values = [
        array[np.isin(features.indices, places)] for array in (features.vectors, features.quality) if array is not None
    ]
    for array in values:
        digest.update((np.round(array, 3) + np.float32(0)).tobytes())
    lengths = [settings.voxel_size]
    if row.name != "fpfh":
        lengths += [settings.support_radius, settings.min_radius, settings.lrf_radius]
    digest.update(repr((row.dims, *(f"{length:.6g}" for length in lengths))).encode())
    return digest.hexdigest()


def _learned(name: str | None, path: Path) -> Row:
    """A network's row; those of the package are named, others named after their file."""
    try:
        card = load_network("cgf", None, path).card
    except ValueError as error:
        raise InputError(str(error)) from error
    if name is None:
        dims = tuple(dim for dim in card.dims if card.nested and dim in COMPARED_DIMS) or card.dims[-1:]
        return Row(
            name=path.stem.removesuffix(f"-{card.model}"),
            model=card.model,
            settings=PairSettings(model=card.model, dim=dims[-1], weights=path),
            dims=dims,
            weights=path,
            trained_on=card.data,
            title=str(card.training.get("label", "")),
            place=int(card.training.get("place", 0)),
        )
    settings = PairSettings(model=card.model, dim=card.dims[-1])
    return Row(name, card.model, settings, card.dims, weights=path, trained_on=card.data, title="CGF")


def _fpfh(model: ModelName, radius: float) -> Row:
    defaults, usual = MODEL_DEFAULTS[model], FPFH_DEFAULT[model]
    # The descriptor's own radius is a fixed share of the support's; see `cgf.descriptors.fpfh`.
    factor = radius / usual
    text = f"{100 * radius:g} %" if defaults.relative else f"{radius:g} m"
    return Row(
        "fpfh",
        model,
        PairSettings(model=model, descriptor="fpfh"),
        (33,),
        variant=text,
        is_default=factor == 1,
        radius_factor=factor,
        title="FPFH",
    )


def _projected(model: ModelName) -> Row:
    path = shipped_weights(f"pca-{model}")
    card = load_network("pca", model).card
    settings = PairSettings(model=model, descriptor="pca", dim=card.dims[-1])
    dims = tuple(dim for dim in COMPARED_DIMS if dim <= card.dims[-1])
    return Row("pca", model, settings, dims, weights=path, trained_on=card.data, title="PCA of the histogram")

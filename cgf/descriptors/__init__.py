"""Descriptors by name, all behind the protocol `cgf.types.Descriptor`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cgf.descriptors.settings import MODEL_DEFAULTS, DescriptorSettings, ModelDefaults, ModelName
from cgf.types import Descriptor, Features

__all__ = [
    "MODEL_DEFAULTS",
    "NESTED",
    "DescriptorSettings",
    "ModelDefaults",
    "ModelName",
    "available",
    "dimensions",
    "make_descriptor",
    "truncate",
]

NESTED = frozenset({"cgf"})
"""Descriptors whose features of fewer dimensions are prefixes of those of more: one description serves all."""


def available() -> tuple[str, ...]:
    """Names that `make_descriptor` takes."""
    return tuple(_MAKERS)


def make_descriptor(name: str, settings: DescriptorSettings) -> Descriptor:
    """Make a descriptor ready to describe clouds; weights are loaded here.

    Raises:
        ValueError: There is no descriptor `name`, or it has no such dimension.
    """
    if name not in _MAKERS:
        raise ValueError(f"descriptor must be one of {', '.join(_MAKERS)}, got {name}")
    choices = dimensions(name, settings.model, weights=settings.weights)
    if settings.dim not in choices:
        listed = ", ".join(str(choice) for choice in choices)
        raise ValueError(f"dim must be one of {listed} for descriptor {name}, got {settings.dim}; choose one of them")
    return _MAKERS[name](settings)


def dimensions(name: str, model: ModelName, *, weights: Path | None = None) -> tuple[int, ...]:
    """Numbers of dimensions that a descriptor offers, ascending.

    Raises:
        ValueError: There is no descriptor `name`, or its weights cannot be used.
    """
    if name == "fpfh":
        return (33,)
    if name in {"cgf", "pca"}:
        from cgf.descriptors.network import load_network

        dims = load_network(name, model, weights).card.dims
        return dims if name in NESTED else tuple(dim for dim in (8, 16, 24, 32) if dim <= dims[-1])
    raise ValueError(f"descriptor must be one of {', '.join(_MAKERS)}, got {name}")


def truncate(features: Features, dim: int) -> Features:
    """The features in fewer dimensions: a prefix, divided by its length.

    Raises:
        ValueError: The descriptor is not nested, or the features have fewer dimensions than `dim`.
    """
    if features.descriptor not in NESTED:
        raise ValueError(
            f"features must come from a nested descriptor ({', '.join(NESTED)}), got {features.descriptor}"
        )
    if not 1 <= dim <= features.dim:
        raise ValueError(f"dim must lie between 1 and {features.dim}, got {dim}")
    from cgf.descriptors.network import unit_rows

    return replace(features, vectors=unit_rows(np.ascontiguousarray(features.vectors[:, :dim])))


def _cgf(settings: DescriptorSettings) -> Descriptor:
    from cgf.descriptors.cgf import HistogramDescriptor

    return HistogramDescriptor("cgf", settings)


def _pca(settings: DescriptorSettings) -> Descriptor:
    from cgf.descriptors.cgf import HistogramDescriptor

    return HistogramDescriptor("pca", settings)


def _fpfh(settings: DescriptorSettings) -> Descriptor:
    from cgf.descriptors.fpfh import Fpfh

    return Fpfh(settings)


_MAKERS: dict[str, Callable[[DescriptorSettings], Descriptor]] = {"cgf": _cgf, "fpfh": _fpfh, "pca": _pca}

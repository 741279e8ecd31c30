"""Weights that judge the quality of features, at random."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from cgf.descriptors.network import read_network, shipped_weights, write_network


def write_judging(path: Path, *, name: str = "cgf-indoor", width: int = 8) -> Path:
    """The shipped weights with a head that spreads its estimates between 0 and 1."""
    network, rng = read_network(shipped_weights(name)), np.random.default_rng(5)
    hidden = len(network.card.insets) * network.weights["out.weight"].shape[1]
    head = {
        "quality.0.weight": rng.normal(size=(width, hidden)),
        "quality.0.bias": rng.normal(size=width),
        "quality.1.weight": rng.normal(size=(1, width)),
        "quality.1.bias": np.zeros(1),
    }
    weights = network.weights | {key: values.astype(np.float32) for key, values in head.items()}
    write_network(path, replace(network, weights=weights))
    return path

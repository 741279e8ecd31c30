"""The network on tile registers against the one of plain matrix products; skipped where there are no such registers."""

import numpy as np
import pytest

from cgf.descriptors import amx
from cgf.descriptors.network import read_network, shipped_weights
from cgf.descriptors.tile_layout import to_bfloat16
from tests.histograms import random_histograms
from tests.networks import random_weights

tiles = pytest.mark.skipif(not amx.has_tiles(), reason="the processor multiplies no tiles of bfloat16 (AMX)")


def as_float(rounded):
    return (rounded.astype(np.uint32) << 16).view(np.float32)


def network_by_definition(weights, rows):
    """In double precision, with what the tiles are given rounded to bfloat16."""

    def rounded(numbers):
        return as_float(to_bfloat16(np.ascontiguousarray(numbers, np.float32))).astype(np.float64)

    def layer(inputs, name):
        return np.maximum(rounded(inputs) @ rounded(weights[f"{name}.weight"]).T + weights[f"{name}.bias"], 0)

    columns = (16 * (np.sqrt(rows) if rows.shape[1] == 2244 else rows)).reshape(len(rows), 12, -1)
    for k in range(3):
        around = [np.roll(columns, 1, axis=1), columns, np.roll(columns, -1, axis=1)]
        columns = layer(np.concatenate(around, axis=2), f"columns.{k}")
    return layer(np.concatenate([columns.max(axis=1), columns.mean(axis=1)], axis=1), "hidden")


def test_rounding_is_to_the_nearest_and_ties_go_to_even():
    values = np.array([1.0, 1 + 2**-8, 1 + 3 * 2**-8, 1 + 2**-8 + 2**-20, -3.14159, 0.0], np.float32)
    expected = [1.0, 1.0, 1 + 2**-6, 1 + 2**-7, -3.140625, 0.0]
    assert as_float(to_bfloat16(values)).tolist() == expected


@tiles
@pytest.mark.parametrize("histogram", ["roots", "normals"])
@pytest.mark.parametrize(("count", "width", "hidden"), [(1, 192, 384), (32, 32, 64), (75, 24, 40), (33, 100, 97)])
def test_equals_the_definition_for_any_number_of_points_and_channels(histogram, count, width, hidden):
    rows = random_histograms(count, histogram)
    weights = random_weights(width, hidden, rows.shape[1])
    found, expected = amx.pack_network(weights, histogram).hidden(rows), network_by_definition(weights, rows)
    # Sums differ in the last digit of single precision, which may round a value the other way.
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert np.abs(found - expected).mean() < 1e-4


@tiles
@pytest.mark.parametrize("model", ["object", "indoor"])
def test_features_are_those_of_single_precision(model, monkeypatch):
    network = read_network(shipped_weights(f"cgf-{model}"))
    rows = random_histograms(200, network.card.histogram)
    rows = rows.reshape(200 // len(network.card.insets), len(network.card.insets), -1)
    monkeypatch.setenv("CGF_PRECISION", "float32")
    exact, exact_quality = network.embed_and_judge(rows)
    monkeypatch.setenv("CGF_PRECISION", "bfloat16")
    rounded, rounded_quality = network.embed_and_judge(rows)
    assert (exact != rounded).any()
    assert np.linalg.norm(exact - rounded, axis=1).max() < 0.02
    np.testing.assert_allclose(rounded_quality, exact_quality, atol=0.02)

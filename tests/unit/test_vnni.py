"""The network of bytes against its definition and single precision; skipped where there are no such instructions."""

import subprocess
import sys

import numpy as np
import pytest

from cgf.descriptors import vnni
from cgf.descriptors.network import read_network, shipped_weights
from tests.histograms import random_histograms
from tests.networks import random_weights

needs_bytes = pytest.mark.skipif(not vnni.has_bytes(), reason="the processor multiplies no vectors of bytes (VNNI)")
WITHOUT_AVX512 = """
import numpy as np
from cgf.descriptors import vnni
from tests.histograms import random_histograms
from tests.networks import random_weights

assert "+avx512vnni" not in vnni._features()
rows = random_histograms(9, "normals")
np.save("{path}", vnni.pack_network(random_weights(40, 8, rows.shape[1])).pooled(rows))
"""


def network_by_definition(weights, rows):
    """In double precision, with what is multiplied rounded to bytes."""
    columns = 16.0 * rows.reshape(len(rows), 12, -1).astype(np.float64)
    for k in range(3):
        weight = weights[f"columns.{k}.weight"].astype(np.float64)
        steps = np.abs(weight).max(axis=1, keepdims=True) / 127
        weight = np.rint(weight / steps) * steps
        steps = np.maximum(np.abs(columns).max(axis=(1, 2), keepdims=True), 1e-30) / (127 if k == 0 else 255)
        columns = np.rint(columns / steps) * steps
        around = np.concatenate([np.roll(columns, 1, axis=1), columns, np.roll(columns, -1, axis=1)], axis=2)
        columns = np.maximum(around @ weight.T + weights[f"columns.{k}.bias"], 0)
    return np.concatenate([columns.max(axis=1), columns.mean(axis=1)], axis=1)


def sparse_histograms(count):
    """Of which most bins are empty, some whole sectors, and the last all."""
    rows = random_histograms(count, "normals").reshape(count, 12, 4, 187)
    rng = np.random.default_rng(8)
    rows = rows * (rng.random((count, 12, 1, 187)) < 0.1) * (rng.random((count, 12, 1, 1)) < 0.8)
    rows[-1] = 0
    return rows.reshape(count, -1).astype(np.float32)


@needs_bytes
@pytest.mark.parametrize(("count", "width"), [(1, 192), (8, 96), (21, 24), (10, 100)])
@pytest.mark.parametrize("histograms", [sparse_histograms, lambda count: random_histograms(count, "normals")])
def test_equals_the_definition_for_any_number_of_points_and_channels(histograms, count, width):
    rows = histograms(count)
    weights = random_weights(width, 8, rows.shape[1])
    found, expected = vnni.pack_network(weights).pooled(rows), network_by_definition(weights, rows)
    # Scales differ in the last digit of single precision, which may round a value the other way.
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())
    assert np.abs(found - expected).mean() < 1e-3 * np.abs(expected).mean()


@needs_bytes
def test_no_histograms_give_no_rows():
    weights = random_weights(24, 8, 8976)
    assert vnni.pack_network(weights).pooled(np.empty((0, 8976), np.float32)).shape == (0, 48)


@needs_bytes
@pytest.mark.parametrize("model", ["object", "indoor"])
def test_features_are_nearly_those_of_single_precision(model, monkeypatch):
    network = read_network(shipped_weights(f"cgf-{model}"))
    rows = sparse_histograms(200)[: 200 // len(network.card.insets) * len(network.card.insets)]
    rows = rows.reshape(-1, len(network.card.insets), rows.shape[1])
    monkeypatch.setenv("CGF_PRECISION", "float32")
    exact, exact_quality = network.embed_and_judge(rows)
    monkeypatch.setenv("CGF_PRECISION", "int8")
    rounded, rounded_quality = network.embed_and_judge(rows)
    assert (exact != rounded).any()
    cosines = np.einsum("kd,kd->k", exact, rounded) / np.linalg.norm(exact, axis=1) / np.linalg.norm(rounded, axis=1)
    assert cosines.min() > 0.995
    np.testing.assert_allclose(rounded_quality, exact_quality, atol=0.05)


@needs_bytes
@pytest.mark.slow
@pytest.mark.skipif("+avxvnni" not in vnni._features(), reason="the processor multiplies no vectors of 32 bytes")
def test_vectors_of_half_the_length_give_the_same(tmp_path, monkeypatch):
    path = tmp_path / "pooled.npy"
    features = (f"-{name[1:]}" if "avx512" in name or "avx10" in name else name for name in vnni._features())
    monkeypatch.setenv("NUMBA_CPU_FEATURES", ",".join(features))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    subprocess.run([sys.executable, "-c", WITHOUT_AVX512.format(path=path)], check=True)
    rows = random_histograms(9, "normals")
    expected = vnni.pack_network(random_weights(40, 8, rows.shape[1])).pooled(rows)
    np.testing.assert_allclose(np.load(path), expected, rtol=1e-5, atol=1e-6)

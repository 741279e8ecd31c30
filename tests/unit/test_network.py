import json
from dataclasses import replace

import numpy as np
import pytest

from cgf.descriptors.network import (
    HISTOGRAM_BINS,
    Network,
    NetworkCard,
    read_network,
    shipped_weights,
    unit_rows,
    write_network,
)
from cgf.descriptors.settings import MODEL_DEFAULTS

AZIMUTH = NetworkCard(
    kind="azimuth",
    model="object",
    dims=(8, 16),
    frame="normal",
    relative=True,
    support_radius=0.17,
    min_radius=0.015,
    lrf_radius=0.02,
    voxel_sizes=(0.006,),
)
PAPER = replace(AZIMUTH, kind="paper", dims=(16,), frame="paper", root=False, nested=False, pooled=False)

CARDS = {"azimuth": AZIMUTH, "paper": PAPER, "joined": replace(AZIMUTH, insets=(0, 3))}


def torch_network(kind):
    torch = pytest.importorskip("torch")
    from cgf.training.modules import AzimuthNetwork, PaperNetwork, joined

    torch.manual_seed(1)
    module = PaperNetwork(16) if kind == "paper" else AzimuthNetwork(16, width=24)
    if kind == "joined":
        module = joined(module, 2)
        torch.nn.init.normal_(module.join.weight)
    weights = {name: value.numpy().copy() for name, value in module.state_dict().items()}
    return module, Network(CARDS[kind], weights)


def histograms(count=20):
    rows = np.random.default_rng(2).random((count, HISTOGRAM_BINS), dtype=np.float32) ** 8
    return rows / rows.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("kind", ["azimuth", "paper", "joined"])
def test_inference_equals_torch(kind, monkeypatch):
    import torch

    monkeypatch.setenv("CGF_PRECISION", "float32")
    module, network = torch_network(kind)
    rows = histograms().reshape(10, 2, -1) if kind == "joined" else histograms()
    expected = module(torch.from_numpy(rows)).detach().numpy()
    vectors, quality = network.embed_and_judge(rows)
    nested = kind != "paper"
    np.testing.assert_allclose(vectors, unit_rows(expected[:, :16]) if nested else expected, rtol=2e-3, atol=2e-5)
    assert (quality is not None) == nested
    if nested:
        np.testing.assert_allclose(quality, 1 / (1 + np.exp(-expected[:, 16])), atol=1e-5)


def test_turning_by_a_sector_changes_nothing():
    network = torch_network("azimuth")[1]
    rows = histograms()
    turned = np.roll(rows.reshape(-1, 12, 187), 5, axis=1).reshape(-1, HISTOGRAM_BINS)
    np.testing.assert_allclose(network.embed(turned), network.embed(rows), atol=1e-5)


def test_weights_survive_writing_and_reading(tmp_path):
    network = torch_network("azimuth")[1]
    write_network(tmp_path / "a.safetensors", network)
    again = read_network(tmp_path / "a.safetensors")
    assert again.card == network.card
    np.testing.assert_array_equal(again.embed(histograms()), network.embed(histograms()))


def test_weights_that_contradict_their_card_are_refused(tmp_path):
    network = torch_network("azimuth")[1]
    write_network(tmp_path / "a.safetensors", network)
    card = json.loads((tmp_path / "a.json").read_text())
    (tmp_path / "a.json").write_text(json.dumps(card | {"dims": [8, 32]}))
    with pytest.raises(ValueError, match=r"weights must fit their card .*out.weight must have shape \(32, 48\)"):
        read_network(tmp_path / "a.safetensors")


def test_a_card_without_weights_is_refused(tmp_path):
    (tmp_path / "a.json").write_text(AZIMUTH.to_json())
    with pytest.raises(ValueError, match=r"weights must consist of a.safetensors and a.json, got no file"):
        read_network(tmp_path / "a.safetensors")


def test_a_broken_card_is_refused(tmp_path):
    write_network(tmp_path / "a.safetensors", torch_network("azimuth")[1])
    (tmp_path / "a.json").write_text('{"kind": "azimuth"}')
    with pytest.raises(ValueError, match="must be a network card written by cgf train"):
        read_network(tmp_path / "a.safetensors")


def test_broken_weights_are_refused(tmp_path):
    write_network(tmp_path / "a.safetensors", torch_network("azimuth")[1])
    (tmp_path / "a.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="must be a safetensors file"):
        read_network(tmp_path / "a.safetensors")


@pytest.mark.parametrize("name", ["cgf-object", "cgf-indoor", "pca-object", "pca-indoor"])
def test_shipped_cards_say_how_to_remake_their_weights(name):
    network = read_network(shipped_weights(name))
    assert network.card.command.startswith("cgf train ")
    assert f"--seed {network.card.seed}" in network.card.command
    assert network.card.data


@pytest.mark.parametrize("model", ["object", "indoor"])
def test_shipped_features_come_in_nested_dimensions(model):
    network = read_network(shipped_weights(f"cgf-{model}"))
    assert {8, 16, 24, 32} <= set(network.card.dims)
    features = network.embed(histograms(40).reshape(-1, len(network.card.insets), HISTOGRAM_BINS))
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, rtol=1e-5)
    # Every prefix carries something: none is a multiple of one direction.
    assert all(np.linalg.matrix_rank(features[:, :dim]) == dim for dim in (8, 16))


@pytest.mark.parametrize("name", ["cgf-object", "cgf-indoor", "pca-object", "pca-indoor"])
def test_shipped_weights_were_trained_with_the_lengths_they_are_used_with(name):
    card = read_network(shipped_weights(name)).card
    assert card.defaults() == MODEL_DEFAULTS[card.model]

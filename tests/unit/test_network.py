import json
from dataclasses import replace

import numpy as np
import pytest

from cgf.descriptors.network import (
    Network,
    NetworkCard,
    read_network,
    shipped_weights,
    unit_rows,
    write_network,
)
from cgf.descriptors.settings import MODEL_DEFAULTS
from tests.histograms import random_histograms

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
PAPER = replace(AZIMUTH, kind="paper", dims=(16,), frame="paper", histogram="counts", nested=False, pooled=False)

CARDS = {
    "azimuth": AZIMUTH,
    "paper": PAPER,
    "joined": replace(AZIMUTH, insets=(0, 3)),
    "context": replace(AZIMUTH, insets=(0, 3), context=(1.0, 4.0)),
}


def torch_network(kind):
    torch = pytest.importorskip("torch")
    from cgf.training.modules import AzimuthNetwork, PaperNetwork, joined

    torch.manual_seed(1)
    module = PaperNetwork(16) if kind == "paper" else AzimuthNetwork(16, width=24)
    if kind in ("joined", "context"):
        module = joined(module, 2, len(CARDS[kind].context))
        torch.nn.init.normal_(module.join.weight)
    weights = {name: value.numpy().copy() for name, value in module.state_dict().items()}
    return module, Network(CARDS[kind], weights)


@pytest.mark.parametrize("kind", list(CARDS))
def test_inference_equals_torch(kind, monkeypatch):
    import torch

    monkeypatch.setenv("CGF_PRECISION", "float32")
    module, network = torch_network(kind)
    rows = random_histograms(20, network.card.histogram)
    if len(network.card.insets) > 1:
        rows = rows.reshape(10, 2, -1)
    expected = module(torch.from_numpy(rows)).detach().numpy()
    vectors, quality = network.embed_and_judge(rows)
    nested, width = kind != "paper", 16 * network.parts
    assert width == (48 if kind == "context" else 16)
    # Parts that a context is added to get their length afterwards.
    wanted = unit_rows(expected[:, :16]) if nested and width == 16 else expected[:, :width]
    np.testing.assert_allclose(vectors, wanted, rtol=2e-3, atol=2e-5)
    assert (quality is not None) == nested
    if nested:
        np.testing.assert_allclose(quality, 1 / (1 + np.exp(-expected[:, width])), atol=1e-5)


def test_turning_by_a_sector_changes_nothing():
    network = torch_network("azimuth")[1]
    rows = random_histograms(20, "normals")
    turned = np.roll(rows.reshape(20, 12, -1), 5, axis=1).reshape(20, -1)
    np.testing.assert_allclose(network.embed(turned), network.embed(rows), atol=1e-5)


def test_weights_survive_writing_and_reading(tmp_path):
    network = torch_network("azimuth")[1]
    write_network(tmp_path / "a.safetensors", network)
    again = read_network(tmp_path / "a.safetensors")
    assert again.card == network.card
    rows = random_histograms(20, "normals")
    np.testing.assert_array_equal(again.embed(rows), network.embed(rows))


def test_weights_of_half_precision_take_half_the_room(tmp_path):
    network = torch_network("azimuth")[1]
    rounded = {name: values.astype(np.float16).astype(np.float32) for name, values in network.weights.items()}
    write_network(tmp_path / "a.safetensors", network)
    write_network(tmp_path / "b.safetensors", Network(network.card, rounded))
    whole, half = ((tmp_path / f"{name}.safetensors").stat().st_size for name in "ab")
    assert half < 0.6 * whole
    for name, values in read_network(tmp_path / "b.safetensors").weights.items():
        np.testing.assert_array_equal(values, rounded[name])


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


@pytest.mark.parametrize(
    ("kind", "root", "histogram"), [("azimuth", None, "roots"), ("paper", None, "counts"), ("paper", True, "roots")]
)
def test_older_cards_say_what_the_network_takes(kind, root, histogram):
    values = json.loads(AZIMUTH.to_json()) | {"kind": kind} | ({} if root is None else {"root": root})
    del values["histogram"]
    assert NetworkCard.from_json(json.dumps(values), source="card").histogram == histogram


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
    rows = random_histograms(40, network.card.histogram)
    features = network.embed(rows.reshape(40 // len(network.card.insets), len(network.card.insets), -1))
    parts = np.split(features, network.parts, axis=1)
    assert len(parts) == 5
    # Every prefix carries something: none is a multiple of one direction.
    assert all(np.linalg.matrix_rank(part[:, :dim]) == dim for part in parts for dim in (8, 16))


@pytest.mark.parametrize("name", ["cgf-object", "cgf-indoor", "pca-object", "pca-indoor"])
def test_shipped_weights_were_trained_with_the_lengths_they_are_used_with(name):
    card = read_network(shipped_weights(name)).card
    assert card.defaults() == MODEL_DEFAULTS[card.model]

"""The path for accelerators against the one for processors: on a processor everywhere, on a GPU where there is one."""

import numpy as np
import pytest

from cgf.datasets.demo import load_demo
from cgf.descriptors import DescriptorSettings, make_descriptor
from cgf.descriptors.device import embed_on_device, requested_device
from cgf.descriptors.pooling import add_context
from cgf.geometry.lrf import estimate_lrf

torch = pytest.importorskip("torch")
SETTINGS = DescriptorSettings(support_radius=0.9, min_radius=0.075, lrf_radius=0.25, dim=32, model="indoor")
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")),
]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["cgf", "pca"])
def test_features_are_those_of_the_processor(name, device, monkeypatch):
    monkeypatch.setenv("CGF_PRECISION", "float32")
    cloud = load_demo().target
    rows = np.arange(0, len(cloud), 17)
    descriptor = make_descriptor(name, SETTINGS)
    expected = descriptor.describe(cloud, rows)
    frames, defined = estimate_lrf(
        cloud.points, cloud.normals, rows, radius=SETTINGS.lrf_radius, kind=descriptor.network.card.frame
    )
    rows = rows[defined]
    network = descriptor.network
    found = np.empty((len(rows), network.parts * network.card.dims[-1]), np.float32)
    parts = embed_on_device(
        cloud,
        cloud.points[rows],
        frames[defined],
        network,
        support_radius=SETTINGS.support_radius,
        min_radius=SETTINGS.min_radius,
        device=device,
    )
    for part, vectors, quality, counts in parts:
        found[part] = vectors
        assert quality is None or len(quality) == len(part)
        assert (counts > 0).all()
    if name == "cgf":
        stacked = np.stack(np.split(found, network.parts, axis=1))
        radii = tuple(share * SETTINGS.min_radius for share in network.card.context)
        found = add_context(cloud.points[rows], stacked, radii=radii)[:, :32]
        found /= np.linalg.norm(found, axis=1, keepdims=True)
    np.testing.assert_array_equal(expected.indices, rows)
    # Single precision may put a neighbour on the other side of an edge, which moves a feature a little.
    distances = np.linalg.norm(found - expected.vectors, axis=1)
    assert np.median(distances) < 1e-5
    assert distances.max() < 0.02


def test_the_environment_names_the_device(monkeypatch):
    monkeypatch.setenv("CGF_DEVICE", "meta")
    assert requested_device() == "meta"
    for name in ("", "cpu"):
        monkeypatch.setenv("CGF_DEVICE", name)
        assert requested_device() is None


def test_an_unknown_device_is_refused(monkeypatch):
    monkeypatch.setenv("CGF_DEVICE", "abacus")
    with pytest.raises(ValueError, match="CGF_DEVICE must be cpu or a device that torch has, got abacus"):
        requested_device()

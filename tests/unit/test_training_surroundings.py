"""What a network with a context is taught with: the means that the descriptor takes."""

from dataclasses import replace

import numpy as np
import pytest

from cgf.descriptors.cgf import HistogramDescriptor
from cgf.descriptors.network import Network, NetworkCard, unit_rows
from cgf.descriptors.settings import DescriptorSettings
from cgf.descriptors.spherical_histogram import histogram_grid
from cgf.geometry.lrf import estimate_lrf
from cgf.training.fragments import Fragments
from cgf.training.surroundings import Surroundings
from cgf.types import PointCloud

torch = pytest.importorskip("torch")

INSETS, CONTEXT = (0, 3), (1.0, 3.0)
CARD = NetworkCard(
    kind="azimuth", model="object", dims=(8, 16), frame="normal", relative=True, support_radius=0.4, min_radius=0.08,
    lrf_radius=0.1, voxel_sizes=(0.02,), insets=INSETS, context=CONTEXT,
)  # fmt: skip


@pytest.fixture
def cloud():
    x, y = np.random.default_rng(0).uniform(0, 2, (2, 2_500))
    normals = np.column_stack([-0.5 * np.cos(5 * x), 0.3 * np.sin(3 * y), np.ones(len(x))])
    points = np.column_stack([x, y, 0.1 * np.sin(5 * x) * np.cos(3 * y)])
    points[-1] += 50  # alone, so without a feature
    return PointCloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def test_features_are_those_that_were_trained(cloud, monkeypatch):
    from cgf.training.modules import AzimuthNetwork, joined

    monkeypatch.setenv("CGF_PRECISION", "float32")
    torch.manual_seed(1)
    module = AzimuthNetwork(16, width=24)
    single = Network(replace(CARD, insets=(0,), context=()), weights_of(module))
    surroundings = Surroundings(Fragments([cloud], [], []), single, insets=INSETS, context=CONTEXT)
    module = joined(module, len(INSETS), len(CONTEXT))
    torch.nn.init.normal_(module.join.weight)
    settings = DescriptorSettings(
        support_radius=CARD.support_radius, min_radius=CARD.min_radius, lrf_radius=CARD.lrf_radius, dim=16,
        model="object",
    )  # fmt: skip
    descriptor = HistogramDescriptor("cgf", settings, network=Network(CARD, weights_of(module)))
    everything = descriptor.describe(cloud, np.arange(len(cloud)))
    assert len(everything) < len(cloud)
    described = slice(3, None, 41)
    rows = everything.indices[described]
    frames, _ = estimate_lrf(cloud.points, cloud.normals, rows, radius=CARD.lrf_radius, kind="normal")
    grid = histogram_grid(
        cloud.points, support_radius=CARD.support_radius, min_radius=CARD.min_radius, normals=cloud.normals
    )
    histograms, _ = grid.nested_histograms(cloud.points[rows], frames, soft=True, insets=INSETS)
    around = surroundings.around(0, rows)
    assert around.shape == (len(rows), 2, 32)
    taught = module(torch.from_numpy(histograms), torch.from_numpy(around)).detach().numpy()
    # Means are taken of features at half precision.
    np.testing.assert_allclose(everything.vectors[described], unit_rows(taught[:, :16]), atol=5e-3)
    alone = module(torch.from_numpy(histograms), torch.zeros(around.shape)).detach().numpy()
    assert np.abs(unit_rows(alone[:, :16]) - unit_rows(taught[:, :16])).max() > 0.1


def test_joining_begins_with_the_mean_of_the_supports_within_the_first_radius():
    from cgf.training.modules import AzimuthNetwork, joined

    module = joined(AzimuthNetwork(16, width=24), 2, 2)
    rows, around = torch.rand(5, 2, 8976), torch.rand(5, 2, 32)
    expected = (around[:, 0, :16] + around[:, 0, 16:]) / 2
    torch.testing.assert_close(module(rows, around)[:, :16], expected)


def weights_of(module):
    return {name: value.detach().numpy().copy() for name, value in module.state_dict().items()}

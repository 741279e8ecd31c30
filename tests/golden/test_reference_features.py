"""Matching and precision on the demo pair with features that were published for it."""

import numpy as np
import pytest

from cgf.descriptors.fpfh import Fpfh
from cgf.descriptors.settings import DescriptorSettings
from cgf.evaluation.metrics import correspondence_errors, has_partner, precision
from cgf.io import read_cloud
from cgf.matching import match
from cgf.types import Features


@pytest.fixture(scope="module")
def clouds(shared):
    folder = shared / "data/demo/open3d_feature"
    return [read_cloud(folder / f"cloud_bin_{number}.pcd") for number in (0, 1)]


def read_features(path):
    dim, count = np.fromfile(path, dtype="<i4", count=2)
    vectors = np.fromfile(path, dtype="<f8", offset=8).reshape(count, dim).astype(np.float32)
    return Features(np.arange(count), vectors, path.suffixes[0][1:])


@pytest.mark.parametrize(("kind", "percentages"), [("d32", (57.5, 68.9, 75.0)), ("fpfh", (8.5, 13.2, 17.1))])
def test_precision_is_as_published_features_have_it(shared, clouds, kind, percentages):
    target, source = (
        read_features(shared / f"data/demo/open3d_feature/cloud_bin_{number}.{kind}.bin") for number in (0, 1)
    )
    indices = match(source, target).correspondences.indices
    points = clouds[1].points, clouds[0].points
    errors = correspondence_errors(*points, indices, np.eye(4))
    for threshold, expected in zip((0.05, 0.075, 0.1), percentages, strict=True):
        partner = has_partner(*points, np.eye(4), tau=threshold)
        assert 100 * precision(errors[partner[indices[:, 0]]], threshold=threshold) == pytest.approx(expected, abs=0.06)


def test_fpfh_correlates_with_published_fpfh(shared, clouds):
    published = read_features(shared / "data/demo/open3d_feature/cloud_bin_0.fpfh.bin").vectors
    # Of this support, FPFH takes 0.25 m.
    settings = DescriptorSettings(support_radius=0.675, min_radius=0.05, lrf_radius=0.25, model="indoor")
    ours = Fpfh(settings).describe(clouds[0], np.arange(len(clouds[0])))
    assert len(ours) == len(clouds[0])
    correlations = [np.corrcoef(a, b)[0, 1] for a, b in zip(ours.vectors, published, strict=True)]
    # The number of neighbours was limited when they were published.
    assert np.median(correlations) > 0.98

"""Frames turn with the cloud; histograms do not change with it, nor with the order of points."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cgf.descriptors.spherical_histogram import histogram_grid
from cgf.geometry.lrf import estimate_lrf
from cgf.geometry.transforms import move
from tests.strategies import permutations_of, rigid_motions, surfaces

RADIUS = 0.8
KINDS = pytest.mark.parametrize("kind", ["normal", "paper"])


def frames_of(cloud, kind):
    return estimate_lrf(cloud.points, cloud.normals, np.arange(len(cloud)), radius=RADIUS, kind=kind)


def histograms_of(cloud, frames):
    return histogram_grid(cloud.points, support_radius=RADIUS, min_radius=0.1).histograms(cloud.points, frames)


def agreeing(first, second):
    """Rows of frames that agree: signs may flip where as many neighbours lie on either side but for rounding."""
    return np.abs(first - second).max(axis=(1, 2)) < 1e-3


@KINDS
@given(surfaces(), rigid_motions())
def test_frames_turn_with_the_cloud(kind, cloud, motion):
    frames, defined = frames_of(cloud, kind)
    moved, still_defined = frames_of(move(motion, cloud), kind)
    # A neighbour at the very rim may be lost to rounding.
    assert np.mean(defined == still_defined) > 0.95
    both = defined & still_defined
    assume(both.any())
    assert agreeing(frames[both] @ motion[:3, :3].T, moved[both]).mean() > 0.9


@KINDS
@given(surfaces(), rigid_motions())
def test_histograms_do_not_change_under_rigid_motion(kind, cloud, motion):
    frames, defined = frames_of(cloud, kind)
    turned = move(motion, cloud)
    rows, counts = histograms_of(cloud, frames)
    # The same frames, turned: what is left is the histogram's own invariance.
    turned_rows, turned_counts = histograms_of(turned, frames @ motion[:3, :3].T)
    shift = np.abs(rows - turned_rows).sum(axis=1)[defined]
    assert np.median(shift) < 0.02
    assert np.abs(counts - turned_counts).max() <= 2


@given(surfaces(), st.data())
def test_histograms_do_not_depend_on_the_order_of_points(cloud, data):
    order = data.draw(permutations_of(len(cloud)))
    frames, defined = frames_of(cloud, "paper")
    shuffled = cloud.take(order)
    again, still_defined = frames_of(shuffled, "paper")
    np.testing.assert_array_equal(defined[order], still_defined)
    # Sums are taken in another order, so a tie may fall to the other side.
    assert agreeing(frames[order], again).mean() > 0.95
    np.testing.assert_array_equal(histograms_of(cloud, frames)[0][order], histograms_of(shuffled, frames[order])[0])


@given(surfaces())
def test_histograms_sum_to_one(cloud):
    rows, counts = histograms_of(cloud, frames_of(cloud, "normal")[0])
    np.testing.assert_allclose(rows[counts > 0].sum(axis=1), 1, rtol=1e-5)


@given(surfaces(), st.floats(0.01, 100))
def test_scaling_everything_changes_nothing(cloud, factor):
    frames, defined = frames_of(cloud, "normal")
    scaled = replace(cloud, points=cloud.points * factor)
    grid = histogram_grid(scaled.points, support_radius=RADIUS * factor, min_radius=0.1 * factor)
    shift = np.abs(grid.histograms(scaled.points, frames)[0] - histograms_of(cloud, frames)[0]).sum(axis=1)
    assert np.median(shift[defined]) < 0.02

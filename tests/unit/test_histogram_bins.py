"""Run by the tests on this processor, and in a process of its own as for the simplest of its kind."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from cgf.descriptors.histogram_bins import find_bins, padded_edges
from cgf.geometry.lanes import LANES, gather_offsets

RADIUS = np.float32(0.875)
CENTER = np.array([0.25, -0.125, 0.5], np.float32)
# Three axes of the lattice, one of them turned around: nothing is rounded, so points on edges are on them exactly.
FRAME = np.array([[0, 0, 1], [-1, 0, 0], [0, 1, 0]], np.float32)


@njit
def gathered(xyz, runs, center, sq_radius):
    offsets = np.zeros((4, xyz.shape[1] + LANES), np.float32)
    count = 0
    for start, end in runs:
        columns, to = (xyz[0], xyz[1], xyz[2], xyz[1]), (offsets[0], offsets[1], offsets[2], offsets[3])
        count = gather_offsets(columns, start, end, center, sq_radius, to, count)
    return offsets, count


@njit
def found(offsets, count, frame, sq_radius, sq_edges, edges):
    bins = np.empty(offsets.shape[1], np.int32)
    find_bins(offsets[0], offsets[1], offsets[2], count, frame, sq_radius, sq_edges, edges, bins)
    return bins[:count]


def lattice():
    steps = np.arange(-1, 1.125, 0.125, np.float32)
    return np.stack(np.meshgrid(steps, steps, steps)).reshape(3, -1)


def expected_bins(offsets, sq_edges):
    """Counted edge by edge, for all points together."""
    x, y, z = FRAME @ offsets
    sq_distances = np.square(offsets).sum(axis=0)
    shell = np.searchsorted(sq_edges, sq_distances, side="right")
    cosines = np.cos(np.arange(1, 6) * np.pi / 11).astype(np.float32)
    steps = (np.abs(z) > cosines[:, None] * np.sqrt(sq_distances)).sum(axis=0)
    elevation = np.where(z >= 0, 5 - steps, 5 + steps)
    turns = np.arange(1, 6) * np.pi / 12
    cosines, sines = np.cos(turns).astype(np.float32)[:, None], np.sin(turns).astype(np.float32)[:, None]
    steps = (np.abs(y) * cosines >= np.abs(x) * sines).sum(axis=0)
    half_sector = np.where((x >= 0) == (y >= 0), steps, 11 - steps) + 12 * (y >= 0)
    is_neighbor = (sq_distances <= RADIUS**2) & (sq_distances > 0)
    shells = len(sq_edges) + 1
    return np.where(is_neighbor, shell + shells * (elevation + 11 * half_sector), shells * 11 * 24)


def check_bins(edges):
    sq_edges = np.square(np.linspace(0.125, 0.75, edges)).astype(np.float32)
    offsets = lattice() - CENTER[:, None]
    count = offsets.shape[1]
    bins = found(np.pad(offsets, ((0, 0), (0, LANES))), count, FRAME, RADIUS**2, padded_edges(sq_edges), edges)
    np.testing.assert_array_equal(bins, expected_bins(offsets, sq_edges))


def check_runs():
    points = lattice()
    count = points.shape[1]
    # Of every length from none to a few vectors, to the very end.
    starts = np.cumsum(np.arange(97))
    runs = np.stack([starts, np.append(starts[1:], count)], axis=1)
    offsets, filled = gathered(np.pad(points, ((0, 0), (0, LANES))), runs, CENTER, RADIUS**2)
    offsets, copied = offsets[:3, :filled], offsets[3, :filled]
    np.testing.assert_array_equal(copied, offsets[1] + CENTER[1])
    wanted = points - CENTER[:, None]
    is_near = [np.square(values).sum(axis=0) <= RADIUS**2 for values in (offsets, wanted)]
    np.testing.assert_array_equal(offsets[:, is_near[0]], wanted[:, is_near[1]])
    assert filled in (count, np.count_nonzero(is_near[1]))


@pytest.mark.parametrize("edges", [1, 15, 16, 24, 31])
def test_points_on_edges_fall_into_the_same_bins_however_many_shells(edges):
    check_bins(edges)


def test_runs_are_appended_in_order_without_what_lies_between():
    check_runs()


def test_a_processor_without_wide_vectors_finds_the_same():
    program = "from tests.unit.test_histogram_bins import *; check_runs(); [check_bins(edges) for edges in (1, 16, 31)]"
    plain = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | plain,
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr

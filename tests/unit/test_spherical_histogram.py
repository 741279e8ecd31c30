import numpy as np
import pytest

from cgf.descriptors.settings import CHANNELS
from cgf.descriptors.spherical_histogram import HISTOGRAM_BINS, histogram_grid, nested_scales
from cgf.descriptors.tile_layout import histogram_order, histogram_room, to_bfloat16

SUPPORT, LEAST = 0.9, 0.08


def histogram_by_formula(points, center, frame):
    """The definition, with logarithm, arc cosine and arc tangent, one neighbour at a time."""
    row = np.zeros(HISTOGRAM_BINS)
    for point in points:
        x, y, z = frame @ (point - center)
        distance = np.linalg.norm(point - center)
        if not 0 < distance <= SUPPORT:
            continue
        shell = min(max(int(16 * np.log(distance / LEAST) / np.log(SUPPORT / LEAST) + 1), 0), 16)
        elevation = min(int(11 * np.arccos(z / distance) / np.pi), 10)
        azimuth = min(int(12 * (np.arctan2(y, x) + np.pi) / (2 * np.pi)), 11)
        row[shell + 17 * elevation + 187 * azimuth] += 1
    return row / row.sum()


def random_frame(rng):
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return frame * np.sign(np.linalg.det(frame))


def test_equals_the_formula():
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, size=(3000, 3))
    centers = points[:40]
    frames = np.stack([random_frame(rng) for _ in centers])
    rows, counts = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST).histograms(centers, frames)
    for row, count, center, frame in zip(rows, counts, centers, frames, strict=True):
        # Single precision may put a neighbour on the other side of an edge.
        assert np.abs(row - histogram_by_formula(points, center, frame)).sum() * count / 2 <= 1.01


@pytest.mark.parametrize("soft", [False, True])
def test_nested_supports_are_those_described_one_by_one(soft):
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, size=(3000, 3))
    frames = np.stack([random_frame(rng) for _ in range(40)])
    insets = (0, 3, 7)
    grid = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST)
    rows, counts = grid.nested_histograms(points[:40], frames, soft=soft, insets=insets)
    np.testing.assert_allclose(rows.sum(axis=2), 1, atol=1e-6)
    for place, scale in enumerate(nested_scales(insets, support_radius=SUPPORT, min_radius=LEAST)):
        alone = histogram_grid(points, support_radius=SUPPORT * scale, min_radius=LEAST * scale)
        expected, neighbors = alone.histograms(points[:40], frames, soft=soft)
        # Edges are rounded, so a neighbour may fall on the other side of one.
        assert (np.abs(rows[:, place] - expected).sum(axis=1) * neighbors / 2 <= 1.01).all()
        if place == 0:
            np.testing.assert_array_equal(counts, neighbors)


def means_by_formula(points, normals, center, frame):
    """Counts of soft sectors, and sums of components of normals, one neighbour at a time."""
    sums = np.zeros((4, 12, 187))
    for point, normal in zip(points, normals, strict=True):
        x, y, z = frame @ (point - center)
        distance = np.linalg.norm(point - center)
        if not 0 < distance <= SUPPORT:
            continue
        shell = min(max(int(16 * np.log(distance / LEAST) / np.log(SUPPORT / LEAST) + 1), 0), 16)
        place = shell + 17 * min(int(11 * np.arccos(z / distance) / np.pi), 10)
        half = min(int(24 * (np.arctan2(y, x) + np.pi) / (2 * np.pi)), 23)
        beside = half // 2 + (1 if half % 2 else -1)
        away = np.array([x, y, 0]) / np.hypot(x, y)
        around = np.array([-y, x, 0]) / np.hypot(x, y)
        turned = frame @ normal
        values = np.array([1.0, turned[2], turned @ away, turned @ around])
        sums[:, half // 2, place] += 0.75 * values
        sums[:, beside % 12, place] += 0.25 * values
    return sums


def test_oriented_histograms_hold_the_means_of_normals():
    rng = np.random.default_rng(6)
    points, normals = rng.uniform(-1, 1, size=(2000, 3)), rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centers = points[:20]
    frames = np.stack([random_frame(rng) for _ in centers])
    grid = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST, normals=normals)
    rows, counts = grid.nested_histograms(centers, frames, soft=True, insets=(0,))
    plain = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST)
    shares, neighbors = plain.histograms(centers, frames, soft=True)
    np.testing.assert_array_equal(counts, neighbors)
    channels = rows.reshape(20, 12, 4, 187).transpose(2, 0, 1, 3)
    np.testing.assert_allclose(channels[0] ** 2, shares.reshape(20, 12, 187), atol=1e-7)
    assert not channels[1:, channels[0] == 0].any()
    for k, (center, frame) in enumerate(zip(centers, frames, strict=True)):
        count, *sums = means_by_formula(points, normals, center, frame)
        is_filled = count > 0
        found = channels[1:, k][:, is_filled] / channels[0, k][is_filled]
        off = np.abs(found - np.stack(sums)[:, is_filled] / count[is_filled])
        # Components are told to a 31st; single precision may put a neighbour on the other side of an edge.
        assert np.median(off) < 0.5 / 31
        assert (off > 0.51 / 31).mean() < 0.005


def test_oriented_histograms_of_nested_supports_are_those_described_one_by_one():
    rng = np.random.default_rng(7)
    points, normals = rng.uniform(-1, 1, size=(3000, 3)), rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = np.stack([random_frame(rng) for _ in range(40)])
    insets = (0, 3, 7)
    grid = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST, normals=normals)
    rows, _ = grid.nested_histograms(points[:40], frames, soft=True, insets=insets)
    for place, scale in enumerate(nested_scales(insets, support_radius=SUPPORT, min_radius=LEAST)):
        alone = histogram_grid(points, support_radius=SUPPORT * scale, min_radius=LEAST * scale, normals=normals)
        expected, _ = alone.nested_histograms(points[:40], frames, soft=True, insets=(0,))
        # Edges are rounded, so a neighbour may fall on the other side of one, which changes the scale of all.
        assert (np.abs(rows[:, place] - expected[:, 0]) > 0.002).mean() < 1e-3


def test_tiles_hold_the_same_histograms_rounded():
    rng = np.random.default_rng(8)
    points, normals = rng.uniform(-1, 1, size=(400, 3)), rng.normal(size=(400, 3))
    points[:, 2] *= 0.1  # as most surfaces do, these leave most bins empty
    frames, insets = np.stack([random_frame(rng) for _ in range(35)]), (0, 3, 7)
    grid = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST, normals=normals)
    rows, neighbors = grid.nested_histograms(points[:35], frames, soft=True, insets=insets)
    tiles = histogram_room(35 * len(insets))
    assert tiles.numbers.ctypes.data % 64 == 0
    tiles.used[:] = True
    counts = grid.fill_tiles(points[:35], frames, soft=True, insets=insets, tiles=tiles)
    np.testing.assert_array_equal(counts, neighbors)
    order = histogram_order(CHANNELS)
    assert sorted(order) == list(range(4 * 187))
    np.testing.assert_array_equal(tiles.used, tiles.numbers.any(axis=(3, 4)))
    assert not tiles.used.all()
    found = tiles.numbers.transpose(0, 3, 1, 2, 4).reshape(-1, 12, 24 * 32)
    expected = to_bfloat16(rows).reshape(-1, 12, 4 * 187)[:, :, order]
    np.testing.assert_array_equal(found[: len(expected), :, : len(order)], expected)
    assert not found[len(expected) :].any()
    assert not found[:, :, len(order) :].any()


def test_tiles_are_filled_only_where_they_hold_all_and_there_are_normals():
    rng = np.random.default_rng(8)
    points, frames = rng.uniform(-1, 1, size=(40, 3)), np.stack([random_frame(rng) for _ in range(40)])
    oriented = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST, normals=points)
    with pytest.raises(ValueError, match="must hold 80 histograms, got 2 blocks of 32"):
        oriented.fill_tiles(points, frames, soft=True, insets=(0, 3), tiles=histogram_room(40))
    plain = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST)
    with pytest.raises(ValueError, match="must have normals, got none"):
        plain.fill_tiles(points, frames, soft=True, insets=(0,), tiles=histogram_room(40))


def test_normals_have_a_direction_only():
    rng = np.random.default_rng(9)
    points, normals = rng.uniform(-1, 1, size=(500, 3)), rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:50], frames = 0, np.stack([random_frame(rng) for _ in range(20)])
    rows = []
    for given in (normals, 7 * normals, np.where(normals == 0, np.nan, normals)):
        grid = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST, normals=given)
        rows.append(grid.nested_histograms(points[:20], frames, soft=True, insets=(0,))[0])
    # Dividing by seven times the length may round a component to the next step.
    assert (np.abs(rows[1] - rows[0]) > 1e-6).mean() < 1e-3
    np.testing.assert_array_equal(rows[2], rows[0])


@pytest.mark.parametrize("degrees", range(15, 360, 30))
def test_each_sector_is_thirty_degrees(degrees):
    angle = np.deg2rad(degrees)
    point = 0.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
    cloud = np.array([[0.0, 0.0, 0.0], point])
    rows, _ = histogram_grid(cloud, support_radius=SUPPORT, min_radius=LEAST).histograms(
        np.zeros((1, 3)), np.eye(3)[None]
    )
    assert np.flatnonzero(rows[0])[0] // 187 == ((degrees + 180) % 360) // 30


def test_soft_sectors_share_a_neighbor_with_the_nearer_one():
    for degrees in range(7, 360, 10):
        angle = np.deg2rad(degrees)
        cloud = np.array([[0.0, 0.0, 0.0], [0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.0]])
        grid = histogram_grid(cloud, support_radius=SUPPORT, min_radius=LEAST)
        rows, _ = grid.histograms(np.zeros((1, 3)), np.eye(3)[None], soft=True)
        sectors = rows[0].reshape(12, 187).sum(axis=1)
        own = ((degrees + 180) % 360) // 30
        nearer = (own + (1 if degrees % 30 > 15 else -1)) % 12
        expected = np.zeros(12)
        expected[own], expected[nearer] = 0.75, 0.25
        np.testing.assert_allclose(sectors, expected)


def test_soft_sectors_are_means_of_frames_turned_by_half_a_sector():
    rng = np.random.default_rng(8)
    points = rng.uniform(-1, 1, size=(2000, 3))
    grid = histogram_grid(points, support_radius=SUPPORT, min_radius=LEAST)
    frames = np.stack([random_frame(rng) for _ in range(30)])
    half = np.deg2rad(15)
    turn = np.array([[np.cos(half), np.sin(half), 0], [-np.sin(half), np.cos(half), 0], [0, 0, 1]])
    plain, turned = (grid.histograms(points[:30], axes)[0].reshape(30, 12, 187) for axes in (frames, turn @ frames))
    soft, _ = grid.histograms(points[:30], frames, soft=True)
    expected = plain / 2 + turned / 4 + np.roll(turned, 1, axis=1) / 4
    # Single precision may put a neighbour on the other side of an edge.
    assert np.abs(soft.reshape(30, 12, 187) - expected).sum(axis=(1, 2)).max() < 0.01


def test_a_lonely_point_has_a_row_of_zeros():
    cloud = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    rows, counts = histogram_grid(cloud, support_radius=SUPPORT, min_radius=LEAST).histograms(
        cloud, np.eye(3)[None].repeat(2, 0)
    )
    assert counts.tolist() == [0, 0]
    assert not rows.any()


def test_does_not_depend_on_the_number_of_threads(monkeypatch):
    points = np.random.default_rng(4).uniform(size=(2000, 3))
    frames = np.eye(3)[None].repeat(2000, 0)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("CGF_THREADS", threads)
        results.append(histogram_grid(points, support_radius=0.3, min_radius=0.03).histograms(points, frames)[0])
    np.testing.assert_array_equal(*results)


def test_far_from_the_origin_nothing_changes():
    rng = np.random.default_rng(5)
    points = np.round(rng.uniform(size=(800, 3)), 3)
    frames = np.stack([random_frame(rng) for _ in range(50)])
    offset = np.array([651_204.0, 5_402_117.0, 311.0])  # UTM
    near, _ = histogram_grid(points, support_radius=0.4, min_radius=0.04).histograms(points[:50], frames)
    far, _ = histogram_grid(points + offset, support_radius=0.4, min_radius=0.04).histograms(
        points[:50] + offset, frames
    )
    assert np.abs(near - far).sum(axis=1).max() < 0.05


@pytest.mark.parametrize(("least", "support"), [(0.0, 1.0), (-0.1, 1.0), (1.0, 1.0), (2.0, 1.0)])
def test_radii_must_increase(least, support):
    with pytest.raises(ValueError, match="min_radius must lie between 0 and support_radius"):
        histogram_grid(np.zeros((1, 3)), support_radius=support, min_radius=least)

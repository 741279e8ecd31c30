"""What minibatches are drawn: changed clouds, and which points of others are negatives."""

import numpy as np
import pytest

from cgf.geometry.transforms import apply, invert
from cgf.io.poses import LogEntry
from cgf.training.augmentation import Augmentation
from cgf.training.batches import Batches
from cgf.training.fragments import Fragments, Overlap, _places
from cgf.types import PointCloud


def unit_rows(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def pose(rng):
    motion = np.eye(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    motion[:3, :3] = turn * np.sign(np.linalg.det(turn))
    motion[:3, 3] = rng.normal(size=3)
    return motion


def test_stretching_and_mirroring_keep_frames_right():
    """A mirrored cloud is described as if it had been scanned that way: z is its normal, frames are right-handed."""
    augmentation, rng = Augmentation(stretch=0.3, mirror=0.5), np.random.default_rng(0)
    shapes = [augmentation.draw_shape(rng) for _ in range(40)]
    determinants = np.linalg.det(shapes)
    assert {-1.0, 1.0} == set(np.sign(determinants))
    stretches = np.linalg.svd(shapes, compute_uv=False)
    assert stretches.max() < 1.3
    assert stretches.min() > 1 / 1.3
    assert stretches.max() > 1.2
    frames = augmentation.draw_frames(unit_rows(rng.normal(size=(50, 3))), rng)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1)


def test_holes_and_edges_take_points_away():
    points, rng = np.random.default_rng(1).normal(scale=0.2, size=(400, 3)), np.random.default_rng(0)
    plain = Augmentation(keep_at_least=1.0)
    assert plain.draw_kept(points, 0.17, rng).all()
    for other in (Augmentation(keep_at_least=1.0, holes=1.0), Augmentation(keep_at_least=1.0, cut=1.0)):
        shares = [other.draw_kept(points, 0.17, rng).mean() for _ in range(10)]
        assert 0.3 < np.mean(shares) < 1
    few = Augmentation(holes=1.0, cut=1.0)
    assert all(few.draw_kept(points[:12], 9.0, rng).sum() >= 10 for _ in range(20))


def test_bending_keeps_normals_upright_and_neighbours_near():
    augmentation, rng = Augmentation(bend=0.25), np.random.default_rng(0)
    points, normals = rng.normal(scale=0.5, size=(300, 3)), unit_rows(rng.normal(size=(300, 3)))
    tangents = np.cross(normals, rng.normal(size=normals.shape))
    stretched = []
    for _ in range(20):
        bend = augmentation.draw_bend(0.5, rng)
        moved, turned = bend(points, normals)
        along = (bend(points + 1e-6 * tangents, normals)[0] - moved) / 1e-6
        assert np.abs(np.einsum("ij,ij->i", along, unit_rows(turned))).max() < 1e-4
        # Nothing is turned inside out.
        outwards = (bend(points + 1e-6 * normals, normals)[0] - moved) / 1e-6
        assert (np.einsum("ij,ij->i", outwards, turned) > 0).all()
        stretched.append(np.linalg.norm(along, axis=1) / np.linalg.norm(tangents, axis=1))
    assert np.max(stretched) < 2
    assert np.std(stretched) > 0.05
    unchanged = Augmentation().draw_bend(0.5, rng)(points, normals)
    assert unchanged[0] is points
    assert unchanged[1] is normals


def test_clouds_that_poses_join_share_a_place():
    rng = np.random.default_rng(1)
    true = [pose(rng) for _ in range(6)]
    pairs = [(1, 0), (2, 1), (2, 4), (3, 5)]
    entries = [LogEntry(target, source, 6, invert(true[target]) @ true[source]) for source, target in pairs]
    places = _places(entries)
    assert {number: place for number, (place, _) in places.items()} == {0: 0, 1: 0, 2: 0, 4: 0, 3: 3, 5: 3}
    for number, (place, found) in places.items():
        np.testing.assert_allclose(found, invert(true[place]) @ true[number], atol=1e-12)


@pytest.fixture
def rooms():
    """Two scenes of three fragments of a plane each, in frames of their own; those of one scene are joined by poses."""
    rng = np.random.default_rng(2)
    clouds, overlaps = [], []
    for scene in range(2):
        points = np.column_stack([rng.uniform(0, 3, (1500, 2)), 0.05 * rng.normal(size=1500)])
        normals = np.tile([0.0, 0.0, 1.0], (1500, 1))
        first, from_scene = len(clouds), [pose(rng) for _ in range(3)]
        clouds += [PointCloud(apply(motion, points), normals @ motion[:3, :3].T) for motion in from_scene]
        for i, j in ((1, 0), (2, 1)):
            target_from_source = from_scene[j] @ invert(from_scene[i])
            overlaps.append(Overlap(first + i, first + j, target_from_source, scene, 0.05, invert(from_scene[j]), 0))
    return Fragments(clouds, overlaps, [])


def drawn(rooms, step, **changes):
    values = {"size": 64, "per_batch": 8, "augmentation": Augmentation(), "seed": 3, "tau": 0.1}
    lengths = {"support_radius": 0.5, "min_radius": 0.05, "lrf_radius": 0.1, "frame": "random"}
    return Batches(rooms, **lengths | values | changes).draw(step)


def test_where_poses_are_known_all_of_a_scene_are_negatives(rooms):
    own, all_known = drawn(rooms, 0), drawn(rooms, 0, negatives="place")
    np.testing.assert_array_equal(own.source, all_known.source)
    assert not (all_known.ignored & ~own.ignored).any()
    within_overlap = np.kron(np.eye(8), np.ones((8, 8))) > 0
    np.testing.assert_array_equal(own.ignored[within_overlap], all_known.ignored[within_overlap])
    # Of the half of them that are of the same scene, most lie farther away than a few times tau.
    assert own.ignored[~within_overlap].mean() > 0.3
    assert 0 < all_known.ignored[~within_overlap].mean() < 0.1


def test_places_whose_relation_is_unknown_are_no_negatives(rooms):
    apart = [Overlap(o.source, o.target, o.target_from_source, o.scene, 0.05, o.place_from_target, n)
             for n, o in enumerate(rooms.overlaps)]  # fmt: skip
    batch = drawn(Fragments(rooms.clouds, apart, []), 0, negatives="place", scenes=1)
    joined = drawn(rooms, 0, negatives="place", scenes=1)
    assert batch.ignored.mean() > joined.ignored.mean() + 0.2


def test_a_batch_can_be_of_one_scene(rooms):
    # What is of the same scene, but not of the same overlap, is ignored here.
    apart = np.kron(np.eye(8), np.ones((8, 8))) == 0
    assert all(drawn(rooms, step, scenes=1).ignored[apart].all() for step in range(4))
    assert not any(drawn(rooms, step).ignored[apart].all() for step in range(4))

"""Pairs of each data set, with poses that really lay them over each other."""

import numpy as np
import pytest

from cgf.checks import InputError, check_transform
from cgf.datasets.demo import load_demo
from cgf.datasets.fgr import find_fgr, load_fgr
from cgf.datasets.folder import find_folder, load_folder
from cgf.datasets.match3d import find_scene, load_scene
from cgf.datasets.stanford import find_stanford, load_stanford
from cgf.geometry.neighbors import overlap_mask
from cgf.geometry.normals import estimate_normals
from cgf.geometry.transforms import apply, random_rigid, rotation_error_deg, rotation_of_quaternion
from cgf.io import write_cloud
from cgf.types import PointCloud
from tests.cloud_files import PYRAMIDS, ply_header, save, text_rows

RNG = np.random.default_rng(31)


def overlap(pair, tau, pose=None):
    moved = apply(pair.target_from_source if pose is None else pose, pair.source.points)
    return float(overlap_mask(moved, pair.target.points, tau).mean())


def write_scene(folder, numbers, blocks):
    """Clouds of one shape in frames of their own, and the log of the true poses between them."""
    folder.mkdir(parents=True)
    poses = {number: random_rigid(RNG) for number in numbers}
    for number, pose in poses.items():
        write_cloud(folder / f"Depth_{number:04d}.ply", PointCloud(apply(np.linalg.inv(pose), PYRAMIDS)))
    text = ""
    for target, source in blocks:
        matrix = np.linalg.inv(poses[target]) @ poses[source]
        text += f"{target} {source} {len(numbers)}\n"
        text += "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in matrix)
    save(folder, "gt.log", text.encode())
    return folder


def test_demo_pair_is_displaced_and_fits_under_its_pose():
    pair = load_demo()
    check_transform(pair.target_from_source)
    assert (len(pair.source), len(pair.target)) == (3458, 3903)
    assert (pair.source.name, pair.target.name) == ("cloud_bin_1 (moved)", "cloud_bin_0")
    assert overlap(pair, 0.05) > 0.8
    assert overlap(pair, 0.05, np.eye(4)) < 0.1
    assert abs(rotation_error_deg(pair.target_from_source, np.eye(4)) - 40) < 1e-9
    assert pair.source.normals is not None
    assert pair.source.colors is not None


def test_demo_sensor_moves_with_its_cloud():
    pair = load_demo()
    np.testing.assert_array_equal(pair.target.viewpoint, np.zeros(3))
    np.testing.assert_allclose(
        apply(pair.target_from_source, pair.source.viewpoint[None]), np.zeros((1, 3)), atol=1e-12
    )


def test_folders_of_one_or_many_scenes(tmp_path):
    write_scene(tmp_path / "b", (0, 1), [(0, 1)])
    write_scene(tmp_path / "a", (4, 5, 7), [(4, 5), (7, 4)])
    (tmp_path / "empty").mkdir()
    assert [pair.name for pair in find_folder(tmp_path)] == ["a 5 to 4", "a 4 to 7", "b 1 to 0"]
    assert [pair.name for pair in find_folder(tmp_path / "a")] == ["a 5 to 4", "a 4 to 7"]
    for pair in load_folder(tmp_path):
        assert overlap(pair, 1e-9) == 1


def test_folders_without_poses_are_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"must have a gt\.log beside its clouds or in its folders, got none; add the "
    ):
        find_folder(tmp_path)
    with pytest.raises(InputError, match=r"none must be a folder, got no such folder; check the path$"):
        find_folder(tmp_path / "none")


def test_fgr_pairs_go_by_number(tmp_path):
    for number in (10, 2):
        write_scene(tmp_path / f"pair_{number:02d}", (0, 1), [(0, 1)])
    (tmp_path / "pair_notes").mkdir()
    assert [pair.name for pair in find_fgr(tmp_path)] == ["pair_02", "pair_10"]
    (pair,) = load_fgr(tmp_path, pairs=[10])
    assert (pair.source.name, pair.target.name) == ("Depth_0001.ply", "Depth_0000.ply")
    assert overlap(pair, 1e-9) == 1
    with pytest.raises(InputError, match=r"^pairs must be among 2 to 10 of .*, got 3$"):
        find_fgr(tmp_path, pairs=[2, 3])
    with pytest.raises(InputError, match=r"must have folders pair_01, pair_02 and so on, got none; check the path$"):
        find_fgr(tmp_path / "pair_02")


def test_scene_pairs_that_follow_each_other_are_left_out(tmp_path):
    blocks = [(0, 1), (0, 2), (1, 2), (1, 3), (3, 0), (2, 3)]
    scene = write_scene(tmp_path / "scene", range(4), blocks)
    assert [pair.name for pair in find_scene(scene)] == ["scene 2 to 0", "scene 3 to 1", "scene 0 to 3"]
    assert len(find_scene(scene, consecutive=True)) == 6
    assert all(overlap(pair, 1e-9) == 1 for pair in load_scene(scene))


def test_a_limit_spreads_pairs_evenly(tmp_path):
    scene = write_scene(tmp_path / "scene", range(9), [(0, source) for source in range(1, 9)])
    found = find_scene(scene, consecutive=True, limit=4)
    assert [pair.name for pair in found] == [f"scene {source} to 0" for source in (1, 3, 5, 7)]
    assert len(find_scene(scene, limit=100)) == 7
    with pytest.raises(ValueError, match=r"^limit must be 1 or more, got 0$"):
        find_scene(scene, limit=0)


def write_scans(folder, text=None):
    quaternions = RNG.normal(size=(3, 4))
    lines = ["camera 0 0 0 0 0 0 1"]
    shape = np.concatenate([PYRAMIDS, PYRAMIDS + 0.3, PYRAMIDS - 0.4])
    for number, quaternion in enumerate(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)):
        shift = RNG.normal(size=3)
        # The last scan is of something else.
        seen = (shape + (100 if number == 2 else 0) - shift) @ rotation_of_quaternion(quaternion)
        header = ply_header("ascii", [("x", "float"), ("y", "float"), ("z", "float")]).replace(b" 24", b" 45")
        save(folder, f"scan_{number}.ply", header + text_rows(seen))
        w, x, y, z = quaternion
        lines.append(f"bmesh scan_{number}.ply {shift[0]} {shift[1]} {shift[2]} {x} {y} {z} {-w}")
    save(folder, "all.conf", ("\n".join(lines) if text is None else text).encode())


def test_stanford_pairs_overlap_under_their_poses(tmp_path):
    write_scans(tmp_path)
    (pair,) = load_stanford(tmp_path, tau=1e-3)
    assert pair.name == "scan_1 to scan_0"
    assert overlap(pair, 1e-3) == 1


def test_stanford_folders_that_cannot_be_used(tmp_path):
    with pytest.raises(InputError, match=r"must have one \.conf file, got 0; check the path$"):
        find_stanford(tmp_path)
    write_scans(tmp_path, "camera 0\n")
    with pytest.raises(InputError, match=r"must have lines 'bmesh file tx ty tz qx qy qz qw', got none$"):
        find_stanford(tmp_path)
    write_scans(tmp_path, "bmesh scan_0.ply 1 2 3 0 0\n")
    with pytest.raises(
        InputError, match=r"must have 7 numbers after the file in 'bmesh' lines, got 'bmesh scan_0\.ply 1 "
    ):
        find_stanford(tmp_path)


# The real data sets


def test_all_fgr_pairs_fit(shared):
    pairs = list(load_fgr(shared / "data/objects/fgr_level_01"))
    assert len(pairs) == 25
    for pair in pairs:
        assert pair.source.normals is not None
        assert overlap(pair, 0.0125) > 0.3


def test_redkitchen_has_the_official_pairs(shared):
    scene = shared / "data/indoor/3dmatch/7-scenes-redkitchen"
    assert len(find_scene(scene)) == 449
    for pair in load_scene(scene, limit=8):
        assert overlap(pair, 0.05) > 0.2
    for pair in load_scene(scene, limit=4, log="gt_lomatch.log"):
        assert overlap(pair, 0.05) > 0.05


def test_stanford_scans_make_45_pairs(shared):
    found = find_stanford(shared / "data/objects/stanford_happy")
    assert len(found) == 45
    pairs = [pair.read() for pair in found[:3]]
    assert min(overlap(pair, 0.0015) for pair in pairs) >= 0.29
    # Nearly all of a scan is seen from the scanner's side, under a right choice of that side.
    seen = estimate_normals(pairs[0].source.take(np.arange(0, len(pairs[0].source), 10)), radius=0.004)
    assert np.mean(seen.normals[:, 2] > 0) > 0.99

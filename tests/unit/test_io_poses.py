"""Poses in files, and the pairs of clouds that they belong to."""

import re

import numpy as np
import pytest

from cgf.checks import InputError
from cgf.geometry.transforms import invert, random_rigid
from cgf.io import (
    LogEntry,
    PairFiles,
    index_in_name,
    logged_pairs,
    numbered_clouds,
    read_info,
    read_log,
    read_pairs,
    read_transform,
    write_cloud,
    write_log,
    write_transform,
)
from tests.cloud_files import save, small_cloud

RNG = np.random.default_rng(21)
POSE, OTHER = random_rigid(RNG), random_rigid(RNG)


def matrix_text(matrix, separator=" "):
    return "".join(separator.join(repr(float(value)) for value in row) + "\n" for row in matrix)


def block(target, source, matrix):
    return f"{target}\t {source}\t 3\t\n{matrix_text(matrix)}"


def refuse(message, call, *arguments, **settings):
    with pytest.raises(InputError, match=message) as caught:
        call(*arguments, **settings)
    assert "\n" not in str(caught.value)


def test_written_poses_read_back_to_the_last_digit(tmp_path):
    write_transform(tmp_path / "pose.txt", POSE)
    np.testing.assert_array_equal(read_transform(tmp_path / "pose.txt"), POSE)
    refuse(r"pose\.txt must be writable, got 'No such file ", write_transform, tmp_path / "none" / "pose.txt", POSE)


@pytest.mark.parametrize("separator", [" ", "\t", ",", ", "])
def test_matrices_as_text(tmp_path, separator):
    text = f"# from somewhere\n\n{matrix_text(POSE, separator)}\n"
    np.testing.assert_array_equal(read_transform(save(tmp_path, "pose.txt", text.encode())), POSE)


def test_matrices_of_numpy(tmp_path):
    np.save(tmp_path / "pose.npy", POSE)
    np.testing.assert_array_equal(read_transform(tmp_path / "pose.npy"), POSE)
    np.save(tmp_path / "pose.npy", POSE[:3])
    refuse(r"pose\.npy must have shape \(4, 4\), got \(3, 4\)$", read_transform, tmp_path / "pose.npy")


def test_the_only_block_of_a_log_needs_no_names(tmp_path):
    path = save(tmp_path, "gt.log", block(0, 1, POSE).encode())
    np.testing.assert_array_equal(read_transform(path), POSE)
    np.testing.assert_array_equal(read_transform(path, source_name="a.ply", target_name="b.ply"), POSE)
    np.testing.assert_array_equal(read_transform(path, source_name="x_1.ply", target_name="x_0.ply"), POSE)


def test_a_reversed_pair_gets_the_inverse(tmp_path):
    path = save(tmp_path, "gt.log", block(0, 1, POSE).encode())
    found = read_transform(path, source_name="x_0.ply", target_name="x_1.ply")
    np.testing.assert_allclose(found, invert(POSE), atol=1e-14)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


def test_names_choose_among_blocks(tmp_path):
    path = save(tmp_path, "gt.log", (block(0, 7, POSE) + block(7, 12, OTHER)).encode())
    found = read_transform(path, source_name="/data/cloud_bin_12.ply", target_name="cloud_bin_7.ply")
    np.testing.assert_array_equal(found, OTHER)
    message = (
        r"gt\.log must have a block '0 12' \(target and source: the last numbers in the names of the files\), "
        r"got 0 7, 7 12; rename the files or give a 4x4 matrix$"
    )
    refuse(message, read_transform, path, source_name="a_12.ply", target_name="a_0.ply")
    refuse(r"must have a block '\? \?' ", read_transform, path, source_name="a.ply")


def test_long_logs_are_shown_in_part(tmp_path):
    path = save(tmp_path, "gt.log", "".join(block(0, row, POSE) for row in range(1, 12)).encode())
    refuse(r"got 0 1, .*, 0 8 and 3 more; rename", read_transform, path, source_name="a1.ply", target_name="a2.ply")


def test_logs_keep_their_order_and_counts(tmp_path):
    path = save(tmp_path, "gt.log", (block(4, 7, POSE) + "\n" + block(0, 1, OTHER)).encode())
    found = read_log(path)
    assert [(entry.target, entry.source, entry.total) for entry in found] == [(4, 7, 3), (0, 1, 3)]
    np.testing.assert_array_equal(found[1].target_from_source, OTHER)


def test_information_matrices(tmp_path):
    matrix = np.arange(36.0).reshape(6, 6)
    found = read_info(save(tmp_path, "gt.info", block(0, 1, matrix).encode()))
    assert (found[0].target, found[0].source, found[0].total) == (0, 1, 3)
    np.testing.assert_array_equal(found[0].information, matrix)


SCALED = 2 * POSE
SCALED[3, 3] = 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"pose\.txt must hold data, got an empty file; copy or export it again$"),
        (
            "1 0 0 0\n0 1 0 0\n",
            r"pose\.txt must have 4 rows of 4 numbers from line 1 on, got 2 rows of 4; "
            r"the file may be truncated or of another format$",
        ),
        ("# nothing\n", r"pose\.txt must have 4 rows of 4 numbers, got 0 rows of none; "),
        ("x\ny 1\n", r"pose\.txt must have 4 rows of 4 numbers from line 1 on, got 2 rows of 1, 2; "),
        ("\x89PNG\r\n", r"pose\.txt must have 4 rows of 4 numbers from line 1 on, got 1 rows of 1; "),
        (matrix_text(SCALED), r"^.*pose\.txt must be rigid, got a 3x3 part that deviates .* \(scale 2\); remove scale"),
        (block(0, 1, SCALED), r"^block 0 1 of .*pose\.txt must be rigid, "),
        (
            block(0, 1, POSE) + "1 2\n",
            r"pose\.txt must have blocks of three integers and a 4x4 matrix, got '1 2' in line 6$",
        ),
        (block(0, 1, POSE)[:-8], r"pose\.txt must have 4 rows of 4 numbers from line 2 on, got 4 rows of 2, 4; "),
        (block(0, 1, POSE) + "0 2 3\n", r"pose\.txt must have 4 rows of 4 numbers, got 0 rows of none; "),
    ],
)
def test_poses_that_cannot_be_used(tmp_path, text, message):
    refuse(message, read_transform, save(tmp_path, "pose.txt", text.encode("latin-1")))


def test_pose_files_that_are_not_there(tmp_path):
    refuse(r"none\.log must exist, got no such file; check the path$", read_log, tmp_path / "none.log")
    refuse(r"must be a file, got a folder; name a file in it$", read_transform, tmp_path)
    comments = save(tmp_path, "gt.log", b"# nothing\n")
    refuse(r"gt\.log must have blocks of three integers and a 4x4 matrix, got none$", read_log, comments)


def test_pose_files_that_cannot_be_opened(tmp_path, monkeypatch):
    def refused(self):
        raise PermissionError(13, "Permission denied")

    path = save(tmp_path, "gt.log", block(0, 1, POSE).encode())
    monkeypatch.setattr("pathlib.Path.read_bytes", refused)
    refuse(r"gt\.log must be readable, got 'Permission denied'; check its permissions$", read_log, path)


@pytest.mark.parametrize(
    ("name", "index"),
    [("cloud_bin_7.ply", 7), ("a/3/Depth_0012.ply", 12), ("scan2_4.v.ply", 4), ("a.ply", None), ("", None)],
)
def test_the_last_number_of_a_name_counts(name, index):
    assert index_in_name(name) == index


@pytest.fixture
def folder(tmp_path):
    for number in (0, 1, 2):
        write_cloud(tmp_path / f"cloud_{number}.ply", small_cloud())
    save(tmp_path, "notes_9.txt", b"text beside clouds is no cloud")
    save(tmp_path, "readme.ply", b"a name without a number is no cloud")
    save(tmp_path, "gt.log", (block(0, 1, POSE) + block(1, 2, OTHER)).encode())
    return tmp_path


def test_clouds_of_a_folder_go_by_their_numbers(folder):
    assert {number: path.name for number, path in numbered_clouds(folder).items()} == {
        0: "cloud_0.ply",
        1: "cloud_1.ply",
        2: "cloud_2.ply",
    }
    write_cloud(folder / "other_02.npz", small_cloud())
    refuse(
        r"must have one cloud for each number, got cloud_2\.ply and other_02\.npz; move one away$",
        numbered_clouds,
        folder,
    )
    missing = folder / "none"
    refuse(
        rf"^{re.escape(str(missing))} must be a folder of point clouds, got no such folder; check the path$",
        numbered_clouds,
        missing,
    )


def test_logged_pairs_have_the_second_number_as_source(folder):
    pairs = logged_pairs(folder)
    assert [pair.name for pair in pairs] == [f"{folder.name} 1 to 0", f"{folder.name} 2 to 1"]
    pair = pairs[1].read()
    assert (pair.source.name, pair.target.name) == ("cloud_2.ply", "cloud_1.ply")
    np.testing.assert_array_equal(pair.target_from_source, OTHER)
    (folder / "cloud_1.ply").unlink()
    refuse(r"must have the cloud 1 that gt\.log names, got none with that number$", logged_pairs, folder)


def test_a_cloud_of_two_pairs_is_read_once(folder):
    first, second = read_pairs(logged_pairs(folder))
    assert first.source is second.target


def test_clouds_beyond_the_limit_are_read_again(folder, monkeypatch):
    monkeypatch.setattr("cgf.io.pairs._CACHED_POINTS", 30)
    first, second = read_pairs(logged_pairs(folder))
    assert first.source is not second.target
    assert len(second.source) == len(second.target) == 24


def test_pairs_without_pose_can_be_read(folder):
    pair = PairFiles("two", folder / "cloud_0.ply", folder / "cloud_1.ply").read()
    assert pair.target_from_source is None


def test_a_written_log_reads_back_to_the_last_digit(tmp_path):
    entries = [LogEntry(target=0, source=3, total=4, target_from_source=POSE), LogEntry(1, 2, 4, OTHER)]
    write_log(tmp_path / "gt.log", entries)
    for found, entry in zip(read_log(tmp_path / "gt.log"), entries, strict=True):
        assert (found.target, found.source, found.total) == (entry.target, entry.source, entry.total)
        np.testing.assert_array_equal(found.target_from_source, entry.target_from_source)
    with pytest.raises(InputError, match=r"gt\.log must be writable, got 'No such file or directory'; choose another"):
        write_log(tmp_path / "missing" / "gt.log", entries)

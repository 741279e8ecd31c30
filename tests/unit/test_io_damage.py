"""The one sentence that each kind of damaged or unfit file gives."""

import re
import struct

import numpy as np
import pytest

from cgf.checks import InputError
from cgf.io import CLOUD_SUFFIXES, read_cloud, write_cloud
from cgf.io.clouds import _READERS
from cgf.types import PointCloud
from tests.cloud_files import COUNT, FACE, PCD, XYZ, ply_header, refuse, samples, save, small_cloud, text_rows


@pytest.fixture
def cloud():
    return small_cloud()


def test_files_that_are_not_there_or_no_files(tmp_path):
    refuse(tmp_path / "none.ply", r" must exist, got no such file; check the path$")
    (tmp_path / "folder.ply").mkdir()
    refuse(tmp_path / "folder.ply", r" must be a file, got a folder; name a file in it$")
    refuse(tmp_path / ("x" * 300 + ".ply"), r" must be readable, got 'File name too long'; check its permissions$")


def test_files_that_cannot_be_opened(cloud, tmp_path, monkeypatch):
    def refused(path):
        raise PermissionError(13, "Permission denied")

    write_cloud(tmp_path / "a.ply", cloud)
    monkeypatch.setitem(_READERS, ".ply", refused)
    refuse(tmp_path / "a.ply", r" must be readable, got 'Permission denied'; check its permissions$")


def test_unknown_formats(cloud, tmp_path):
    refuse(
        tmp_path / "a.docx",
        r" must be a point cloud or mesh \(.ply, .pcd, .*, .pts\), got the suffix '\.docx'; convert it$",
    )
    with pytest.raises(InputError, match=r"a\.pcd must end in \.ply or \.npz, got '\.pcd'; choose one of these$"):
        write_cloud(tmp_path / "a.pcd", cloud)
    with pytest.raises(InputError, match=r"a\.ply must be writable, got 'No such file or directory'; choose another"):
        write_cloud(tmp_path / "none" / "a.ply", cloud)


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_empty_files(tmp_path, suffix):
    path = save(tmp_path, f"a{suffix}", b"")
    refuse(path, r" must hold data, got an empty file; copy or export it again$")


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_files_of_another_format(tmp_path, suffix):
    refuse(save(tmp_path, f"a{suffix}", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" * 20), " must ")
    refuse(save(tmp_path, f"a{suffix}", b"<html>hello</html>\n"), " must ")


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((9, 3)), r" must have 10 points or more, got 9$"),
        (np.ones((12, 3)), r" must spread in space, got 12 points that are all equal to 1 1 1$"),
        (np.arange(36.0).reshape(12, 3), r" must spread in space, got 12 points on one line, or one far from all"),
        (np.zeros((0, 3)), r" must have 10 points or more, got 0$"),
    ],
)
def test_points_that_show_no_surface(tmp_path, points, message):
    np.save(tmp_path / "a.npy", points)
    refuse(tmp_path / "a.npy", message)
    write_cloud(tmp_path / "a.ply", PointCloud(points))
    refuse(tmp_path / "a.ply", message)


HEADER = ply_header("ascii", XYZ)
GOOD = text_rows(np.arange(COUNT * 3).reshape(-1, 3) % 7)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"plx\n", r" must be a PLY file, got one that does not begin with 'ply'; check its format$"),
        (HEADER[:40], r" must have a PLY header that ends with 'end_header'; the file may be truncated$"),
        (HEADER.replace(b"format ascii 1.0\n", b""), r" must have a PLY header with a 'format' line, got none$"),
        (
            HEADER.replace(b"format ascii", b"format utf8"),
            r" must have a valid PLY header, got 'format utf8 1\.0' in line 2$",
        ),
        (HEADER.replace(b"float x", b"floor x"), r" must have a valid PLY header, got 'property floor x' in line 5$"),
        (HEADER.replace(b"float y", b"float x"), r" must have a valid PLY header, got 'property float x' in line 6$"),
        (
            HEADER.replace(b"vertex 24", b"vertex -4"),
            r" must have a valid PLY header, got 'element vertex -4' in line 4$",
        ),
        (
            HEADER.replace(b"property float x", b"property list float int x"),
            r" must have a valid PLY header, got 'property list float int x' in line 5$",
        ),
        (
            HEADER.replace(b"end_h", b"element face 3\nend_h"),
            r" must have a PLY header with properties for each element, got an element without any$",
        ),
        (HEADER + GOOD[:-9], r" must have 24 rows after its header, got 2\d; the file may be truncated$"),
        (
            HEADER + GOOD.replace(b"\n", b"", 1).rsplit(b" ", 2)[0] + b"\n" * 2 + b"1",
            r" must have 3 numbers in every row, got 1 in line 31; the file may be truncated$",
        ),
        (HEADER + b"a" + GOOD, r" must hold numbers, got 'a0' in line 9; the file may be damaged$"),
        (HEADER + GOOD.replace(b"1", b"1_1", 1), r" must hold rows of numbers; the file may be damaged$"),
        (HEADER.replace(b"float z", b"float w") + GOOD, r" must have a vertex element with x, y and z, got 'x, y, w'$"),
        (HEADER.replace(b"element vertex", b"element corner") + GOOD, r" must have .* x, y and z, got 'no vertices'$"),
        (
            HEADER.replace(b"float z", b"list uchar int z") + GOOD,
            r" must have single values at its vertices, got a list property$",
        ),
        (
            ply_header("binary_little_endian", [("x", "list uchar int")]) + bytes(100),
            r" must have single values at its vertices, got a list property$",
        ),
        (
            ply_header("binary_little_endian", XYZ) + bytes(287),
            r" must have 24 rows of 'vertex', got 287 bytes for them; the file may be truncated$",
        ),
        (
            ply_header("binary_little_endian", XYZ, FACE.format(2)) + bytes(288) + b"\3",
            r" must have 2 rows of 'face', got 1 bytes for them; the file may be truncated$",
        ),
        (
            ply_header("binary_little_endian", XYZ, FACE.format(2))
            + bytes(288)
            + b"\3"
            + bytes(12)
            + b"\4"
            + bytes(15),
            r" must hold all of its faces, got an end within them; the file may be truncated$",
        ),
        (
            ply_header("ascii", XYZ, FACE.format(1)) + GOOD + b"three 0 1 2\n",
            r" must have faces that begin with their number of corners, got 'three' in line 35; ",
        ),
        (
            ply_header("ascii", XYZ, FACE.format(2)) + GOOD + b"3 0 1 2\n3 0 1 24\n",
            r" must have faces between its 24 vertices, got vertex 24 in triangle 1; the file may be damaged$",
        ),
    ],
)
def test_damaged_ply(tmp_path, data, message):
    refuse(save(tmp_path, "a.ply", data), message)


def pcd_with(old, new, body=b"DATA ascii\n"):
    return PCD.replace(old, new).encode() + body


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            PCD.encode(),
            r" must be a PCD file with a header that ends with a DATA line, got none; "
            r"the file may be truncated or of another format$",
        ),
        (pcd_with("", "", b"DATA zip\n"), r" must have DATA ascii, binary or binary_compressed, got 'zip'$"),
        (pcd_with("FIELDS", "FILDES"), r" must have FIELDS in its header, got none$"),
        (pcd_with("SIZE 4", "SIZE"), r" must have as many SIZE, TYPE and COUNT as FIELDS in its header, all of them d"),
        (pcd_with("TYPE F", "TYPE C"), r" must have fields of type F, I or U of 1 to 8 bytes, got 'C4'$"),
        (pcd_with("COUNT 1", "COUNT 0"), r" must have a COUNT of 1 or more for each field, got '0'$"),
        (pcd_with("POINTS 24", "POINTS many"), r" must have a number after POINTS in its header, got 'many'$"),
        (
            pcd_with("VIEWPOINT 1", "VIEWPOINT nan"),
            r" must have 3 numbers or more after VIEWPOINT, got 'nan 2 3 1 0 0 0'$",
        ),
        (pcd_with("", ""), r" must have 24 points, got 0 rows; the file may be truncated$"),
        (
            pcd_with("", "", b"DATA ascii\n" + b"1 2 3\n" * 24),
            r" must have 11 numbers in every row, got 3 in line 12; ",
        ),
        (
            pcd_with("", "", b"DATA binary\n" + bytes(99)),
            r" must have 24 points of 32 bytes, got 99 bytes; the file may be truncated$",
        ),
        (
            pcd_with("", "", b"DATA binary_compressed\n\1\0"),
            r" must have 24 points of 32 bytes in 1 compressed bytes, got 0 bytes for 0; the file may be truncated$",
        ),
        (
            pcd_with("", "", b"DATA binary_compressed\n" + struct.pack("<II", 9, 768) + bytes(9)),
            r" must have 768 bytes after decompression; the file may be damaged$",
        ),
        (
            pcd_with("", "", b"DATA binary_compressed\n" + struct.pack("<II", 3, 768) + b"\xff\xff\xff"),
            r" must have 768 bytes after decompression; the file may be damaged$",
        ),
        (
            pcd_with("FIELDS x", "FIELDS w", b"DATA binary\n" + bytes(768)),
            r" must have the fields x, y and z, got 'w y z _3 normal_x normal_y normal_z rgb'$",
        ),
    ],
)
def test_damaged_pcd(tmp_path, data, message):
    refuse(save(tmp_path, "a.pcd", data), message)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.xyz", b"1 2 3\n4 5\n", r" must have 3 numbers in every row, got 2 in line 2; the file may be truncated$"),
        ("a.xyz", b"# nothing\n", r" must have rows of x, y and z, got none$"),
        ("a.xyz", b"1 2\n3 4\n", r" must have 3 columns or more, x y z first, got shape \(2, 2\)$"),
        ("a.pts", b"3\n1 2 3\n4 5 6\n", r" must have 3 points, got 2 rows; the file may be truncated$"),
        ("a.csv", b"x,y,z,w\n1,2,3\n", r" must have a column for each of its 4 names, got 3 columns$"),
        ("a.obj", b"f 1 2 3\n", r" must have vertices, lines that begin with 'v', got none; check its format$"),
        (
            "a.obj",
            b"v 0 0 0\nf 1 1 2\n",
            r" must have faces between vertices that are there, got '1 1 2' in line 2; the file may be damaged$",
        ),
        ("a.stl", bytes(84), r" must have triangles, got none$"),
        (
            "a.stl",
            bytes(80) + b"\2\0\0\0" + bytes(50),
            r" must be an STL file, got 134 bytes where its header announces 184; the file may be truncated or of an",
        ),
        (
            "a.stl",
            b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0 1 0\n",
            r" must end with 'endsolid' after whole triangles, got 2 corners; the file may be truncated$",
        ),
        (
            "a.npy",
            b"\x93NUMPY\1\0",
            r" must be a numpy file of plain numbers, got one that numpy cannot read; the file may be truncated or of",
        ),
    ],
)
def test_damaged_tables_and_meshes(tmp_path, name, data, message):
    refuse(save(tmp_path, name, data), message)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"rows": np.zeros((20, 3))}, r"^{path} must have an array 'points', got 'rows'$"),
        ({"points": np.array(["a"])}, r"^'points' of {path} must hold real numbers, got '<U1'$"),
        ({"points": np.zeros(5)}, r"^{path} must have 3 columns or more, x y z first, got shape \(5,\)$"),
        (
            {"points": np.eye(3), "normals": np.eye(2)},
            r"^'normals' of {path} must have shape \(3, 3\) as the points have, got \(2, 2\)$",
        ),
        (
            {"points": np.eye(3), "colors": np.eye(2)},
            r"^'colors' of {path} must have shape \(3, 3\) as the points have, got \(2, 2\)$",
        ),
        (
            {"points": np.eye(3), "viewpoint": np.full(3, np.nan)},
            r"^'viewpoint' of {path} must be 3 finite numbers, got shape \(3,\)$",
        ),
    ],
)
def test_archives_with_other_arrays(tmp_path, arrays, message):
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message.replace("{path}", re.escape(str(path)))):
        read_cloud(path)


def test_an_archive_is_no_single_array(cloud, tmp_path):
    write_cloud(tmp_path / "a.npz", cloud)
    path = (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    refuse(path, r" must hold one array, got an archive of several; give it the suffix \.npz$")


def test_pickled_objects_are_never_opened(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    refuse(tmp_path / "a.npy", r" must be a numpy file of plain numbers, ")


@pytest.mark.parametrize("suffix", [".npy", ".npz", *(None,)])
def test_files_cut_off_or_scrambled_anywhere_give_one_sentence_or_points(cloud, tmp_path, suffix):
    rng = np.random.default_rng(13)
    files = samples(cloud)
    if suffix is not None:
        path = tmp_path / f"whole{suffix}"
        np.save(path, cloud.points) if suffix == ".npy" else write_cloud(path, cloud)
        files = {path.name: path.read_bytes()}
    for name, data in files.items():
        assert len(read_cloud(save(tmp_path, name, data))) >= 10
        for trial in range(60):
            damaged = bytearray(data[: rng.integers(1, len(data))] if trial % 2 else data)
            for _ in range(0 if trial % 2 else 1 + trial % 7):
                damaged[rng.integers(len(damaged) if trial % 4 else min(400, len(damaged)))] = rng.integers(256)
            path = save(tmp_path, name, bytes(damaged))
            message = ""
            try:
                assert np.isfinite(read_cloud(path).points).all()
            except InputError as error:
                message = str(error)
            assert message == "" or str(path) in message
            assert message.isprintable()

"""What is read from files of points in each format."""

import struct
from types import SimpleNamespace

import numpy as np
import pytest

from cgf.checks import InputError
from cgf.io import import_open3d, read_cloud, write_cloud
from cgf.types import PointCloud
from tests.cloud_files import (
    ALL,
    COUNT,
    FACE,
    FACES,
    GRID,
    PCD,
    PYRAMIDS,
    QUADS,
    XYZ,
    binary_rows,
    columns,
    compressed_body,
    pcd_table,
    ply_header,
    refuse,
    save,
    small_cloud,
    text_rows,
)


@pytest.fixture
def cloud():
    return small_cloud()


def assert_same(found, cloud, *, normals=True, colors=True):
    np.testing.assert_array_equal(found.points, cloud.points)
    assert (found.normals is not None) == normals
    assert (found.colors is not None) == colors
    if normals:
        np.testing.assert_array_equal(found.normals, cloud.normals)
    if colors:
        np.testing.assert_array_equal(found.colors, cloud.colors)


# Formats


@pytest.mark.parametrize("suffix", [".ply", ".npz"])
def test_written_clouds_read_back_the_same(cloud, tmp_path, suffix):
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, cloud)
    found = read_cloud(path)
    assert_same(found, cloud)
    assert found.name == path.name
    write_cloud(path, PointCloud(cloud.points / 3))
    np.testing.assert_array_equal(read_cloud(path).points, cloud.points / 3)


def test_npz_keeps_the_viewpoint(cloud, tmp_path):
    write_cloud(tmp_path / "a.npz", cloud)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npz").viewpoint, cloud.viewpoint)


def test_viewpoint_can_be_given_and_is_the_origin_otherwise(cloud, tmp_path):
    write_cloud(tmp_path / "a.ply", cloud)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").viewpoint, np.zeros(3))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply", viewpoint=(0, 0, 9)).viewpoint, [0, 0, 9])
    with pytest.raises(InputError, match=r"^viewpoint must be 3 finite numbers, got \[1\.0, 2\.0\]$"):
        read_cloud(tmp_path / "a.ply", viewpoint=(1, 2))


@pytest.mark.parametrize("newline", [b"\n", b"\r\n", b"\r"])
def test_text_ply_with_any_line_ends(cloud, tmp_path, newline):
    data = ply_header("ascii", ALL) + text_rows(columns(cloud))
    assert_same(read_cloud(save(tmp_path, "a.ply", data.replace(b"\n", newline))), cloud)


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_ply_in_both_byte_orders(cloud, tmp_path, form, order):
    data = ply_header(form, ALL) + binary_rows(cloud, order)
    assert_same(read_cloud(save(tmp_path, "a.ply", data)), cloud)


def test_colours_that_are_all_black_count_as_none(cloud, tmp_path):
    write_cloud(tmp_path / "a.ply", PointCloud(cloud.points, colors=np.zeros((COUNT, 3), dtype=np.uint8)))
    assert read_cloud(tmp_path / "a.ply").colors is None


@pytest.mark.parametrize(("kind", "factor"), [("float", 1 / 255), ("double", 1.0), ("ushort", 256.0)])
def test_ply_colours_of_other_types(cloud, tmp_path, kind, factor):
    properties = [*XYZ, *((name, kind) for name in ("red", "green", "blue"))]
    rows = np.hstack([cloud.points, cloud.colors * factor])
    found = read_cloud(save(tmp_path, "a.ply", ply_header("ascii", properties) + text_rows(rows)))
    np.testing.assert_array_equal(found.colors, cloud.colors)


def test_range_grids_are_seen_from_the_scanner(cloud, tmp_path):
    rows = text_rows(cloud.points) + b"0\n1 0\n0\n1 1\n"
    plain = read_cloud(save(tmp_path, "a.ply", ply_header("ascii", XYZ, GRID) + rows))
    assert_same(plain, cloud, normals=False, colors=False)
    np.testing.assert_array_equal(plain.viewpoint, np.zeros(3))
    # Quirk: raw Cyberware scans look along z; the repository's README and the surfaces agree on the side.
    header = ply_header("ascii", XYZ, GRID).replace(b"comment made", b"obj_info is_cyberware_data 1\ncomment made")
    seen = read_cloud(save(tmp_path, "a.ply", header + rows))
    assert seen.viewpoint[2] > seen.points[:, 2].max() + 5 * seen.diameter


def test_binary_range_grids_are_skipped(cloud, tmp_path):
    grid = b"".join(struct.pack("<Bi", 1, row) if row % 2 else b"\0" for row in range(4))
    data = ply_header("binary_little_endian", ALL, GRID) + binary_rows(cloud, "<") + grid
    assert_same(read_cloud(save(tmp_path, "a.ply", data)), cloud)


def assert_pyramids(found):
    assert len(found) == 15
    order = np.lexsort(np.rint(found.points).T)
    expected = np.lexsort(PYRAMIDS.T)
    np.testing.assert_allclose(found.points[order], PYRAMIDS[expected])
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1)
    top = found.points[:, 2] == 1
    np.testing.assert_allclose(found.normals[top], np.tile([0.0, 0, 1], (3, 1)), atol=1e-12)
    middle = PYRAMIDS.reshape(3, 5, 3)[:, :4].mean(axis=1)[None] - found.points[:, None]
    nearest = middle[np.arange(15), np.linalg.norm(middle, axis=2).argmin(axis=1)]
    outward = np.einsum("ij,ij->i", found.normals, -nearest)
    assert (outward > 0).all()


@pytest.mark.parametrize("quads", [False, True])
def test_mesh_normals_come_from_the_faces(tmp_path, quads):
    faces = FACES + (QUADS if quads else [])
    header = ply_header("ascii", XYZ, FACE.format(len(faces))).replace(f"vertex {COUNT}".encode(), b"vertex 15")
    rows = "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces).encode()
    assert_pyramids(read_cloud(save(tmp_path, "a.ply", header + text_rows(PYRAMIDS) + rows)))
    header = header.replace(b"ascii", b"binary_little_endian")
    rows = b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    data = header + PYRAMIDS.astype("<f4").tobytes() + rows
    assert_pyramids(read_cloud(save(tmp_path, "a.ply", data)))


def test_obj_with_faces_gives_normals_of_the_faces(tmp_path):
    rows = [f"v {x:g} {y:g} {z:g}" for x, y, z in PYRAMIDS]
    plain = [f"f {a + 1} {b + 1}/1 {c - 15}//" for a, b, c in FACES]
    path = save(tmp_path, "a.obj", "\n".join(["# made by a test", "o thing", *rows, *plain]).encode())
    assert_pyramids(read_cloud(path))


def test_obj_normals_and_colours(cloud, tmp_path):
    rows = ["v " + " ".join(f"{value:.6g}" for value in (*point, *color / 255)) for point, color in
            zip(cloud.points, cloud.colors, strict=True)]  # fmt: skip
    directions = ["vn " + " ".join(f"{value:g}" for value in 2 * normal) for normal in cloud.normals]
    assert_same(read_cloud(save(tmp_path, "a.obj", "\n".join([*rows, *directions]).encode())), cloud)
    # The order of normals is that of the corners, which name them.
    corners = [f"f {row + 1}//{COUNT - row} {row + 2}//{COUNT - row - 1} {row + 3}//{COUNT - row - 2}"
               for row in range(COUNT - 2)]  # fmt: skip
    data = "\n".join([*rows, *directions[::-1], *corners]).encode()
    assert_same(read_cloud(save(tmp_path, "b.obj", data)), cloud)


@pytest.mark.parametrize("text", [False, True])
def test_stl_corners_are_joined(tmp_path, text):
    triangles = PYRAMIDS[np.array(FACES)]
    if text:
        parts = [
            "facet normal 0 0 0\nouter loop\n"
            + "".join("  vertex " + " ".join(f"{value:g}" for value in corner) + "\n" for corner in triangle)
            + "endloop\nendfacet\n"
            for triangle in triangles
        ]
        data = f"solid thing\n{''.join(parts)}endsolid thing\n".encode()
    else:
        rows = b"".join(bytes(12) + triangle.astype("<f4").tobytes() + b"\0\0" for triangle in triangles)
        data = bytes(80) + struct.pack("<I", len(triangles)) + rows
    assert_pyramids(read_cloud(save(tmp_path, "a.stl", data)))


def test_pcd_in_all_three_modes(cloud, tmp_path):
    table = pcd_table(cloud)
    rows = np.column_stack([table["points"], table["pad"], table["normals"], table["rgb"].astype(float)])
    text = "".join(" ".join(f"{value:.10g}" for value in row) + "\n" for row in rows).encode()
    for mode, body in (("ascii", text), ("binary", table.tobytes()), ("binary_compressed", compressed_body(cloud))):
        found = read_cloud(save(tmp_path, f"{mode}.pcd", f"{PCD}DATA {mode}\n".encode() + body))
        assert_same(found, cloud)
        np.testing.assert_array_equal(found.viewpoint, [1, 2, 3])


def test_pcd_without_points_line_multiplies_the_sides(cloud, tmp_path):
    header = PCD.replace(f"POINTS {COUNT}\n", "").replace(f"WIDTH {COUNT}\nHEIGHT 1", f"WIDTH {COUNT // 4}\nHEIGHT 4")
    assert_same(
        read_cloud(save(tmp_path, "a.pcd", f"{header}DATA binary\n".encode() + pcd_table(cloud).tobytes())), cloud
    )


def test_pcd_colours_in_three_fields(cloud, tmp_path):
    header = f"FIELDS x y z r g b\nSIZE 4 4 4 1 1 1\nTYPE F F F U U U\nPOINTS {COUNT}\nDATA ascii\n"
    data = header.encode() + text_rows(np.hstack([cloud.points, cloud.colors]))
    assert_same(read_cloud(save(tmp_path, "a.pcd", data)), cloud, normals=False)


@pytest.mark.parametrize(
    ("name", "separator", "first"),
    [
        ("a.xyz", " ", ""),
        ("a.txt", "\t", "# made by a test\n\n"),
        ("a.csv", ",", "x,y,z,nx,ny,nz,red,green,blue\n"),
        ("a.csv", "; ", ""),
        ("a.asc", " ", "//X Y Z Nx Ny Nz R G B\n"),
        ("a.pts", " ", f"{COUNT}\n"),
    ],
)
def test_text_tables(cloud, tmp_path, name, separator, first):
    rows = text_rows(columns(cloud)).decode().replace(" ", separator)
    assert_same(read_cloud(save(tmp_path, name, (first + rows).encode())), cloud)


def test_columns_after_the_coordinates_are_told_by_their_values(cloud, tmp_path):
    def read(*parts):
        return read_cloud(save(tmp_path, "a.xyz", text_rows(np.hstack([cloud.points, *parts]))))

    other = np.full((COUNT, 3), 0.3)
    assert_same(read(cloud.normals), cloud, colors=False)
    assert_same(read(cloud.colors), cloud, normals=False)
    assert_same(read(cloud.colors, cloud.normals), cloud)
    assert_same(read(other[:, :1], cloud.colors), cloud, normals=False)
    assert_same(read(other), cloud, normals=False, colors=False)
    assert_same(read(other[:, :1]), cloud, normals=False, colors=False)


def test_named_columns_may_come_in_any_order(cloud, tmp_path):
    table = np.hstack([cloud.colors, cloud.points[:, ::-1]])
    path = save(tmp_path, "a.csv", b'"R","G","B","Z","Y","X"\n' + text_rows(table).replace(b" ", b","))
    assert_same(read_cloud(path), cloud, normals=False)


def test_numpy_arrays(cloud, tmp_path):
    np.save(tmp_path / "a.npy", cloud.points.astype(np.float32))
    assert_same(read_cloud(tmp_path / "a.npy"), cloud, normals=False, colors=False)
    np.save(tmp_path / "a.npy", np.hstack([cloud.points, cloud.normals]))
    assert_same(read_cloud(tmp_path / "a.npy"), cloud, colors=False)
    np.savez(tmp_path / "a.npz", pcd=cloud.points, normals=2 * cloud.normals, colors=cloud.colors / 255)
    assert_same(read_cloud(tmp_path / "a.npz"), cloud)


@pytest.mark.parametrize("name", ["a.ply", "b.ply", "a.pcd", "b.pcd", "c.pcd", "m.ply", "m.obj", "m.stl"])
def test_files_of_open3d_read_as_open3d_reads_them(tmp_path, name):
    open3d = import_open3d()
    path = str(tmp_path / name)
    if name.startswith("m"):
        mesh = open3d.geometry.TriangleMesh.create_sphere(0.5, 8)
        mesh.compute_vertex_normals()
        mesh.compute_triangle_normals()
        if name == "m.obj":
            mesh.triangle_normals = open3d.utility.Vector3dVector()
        assert open3d.io.write_triangle_mesh(path, mesh, write_ascii=name == "m.ply")
        points, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    else:
        rng = np.random.default_rng(12)
        points, normals = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
        # Many equal points, so that LZF has something to copy.
        points[50:] = np.round(points[50:])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        written = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        written.normals = open3d.utility.Vector3dVector(normals)
        written.colors = open3d.utility.Vector3dVector(rng.integers(0, 256, (200, 3)) / 255)
        assert open3d.io.write_point_cloud(path, written, write_ascii=name[0] == "a", compressed=name[0] == "c")
        read = open3d.io.read_point_cloud(path)
        np.testing.assert_array_equal(read_cloud(path).colors, np.rint(np.asarray(read.colors) * 255))
    found = read_cloud(path)
    if name == "m.stl":
        assert len(found) == len(points)
        return
    np.testing.assert_allclose(found.points, points, atol=1e-5)
    np.testing.assert_allclose(found.normals, normals, atol=1e-5)


# Normals and rows that cannot be used


def test_normals_become_unit_length(cloud, tmp_path):
    scales = np.geomspace(1e-200, 1e200, COUNT)[:, None]
    np.savez(tmp_path / "a.npz", points=cloud.points, normals=cloud.normals * scales)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npz").normals, cloud.normals)


def test_few_normals_without_direction_take_that_of_the_nearest_point(tmp_path):
    points = np.stack([*np.mgrid[0:20, 0:20].reshape(2, -1), np.zeros(400)], axis=1) * (1.0, 1.5, 1.0)
    normals = np.where(points[:, :1] < 9.5, [[0.0, 0, 1]], [[1.0, 0, 0]])
    damaged = normals.copy()
    damaged[[5, 300]] = [[0, 0, 0], [0, np.nan, 1]]
    np.savez(tmp_path / "a.npz", points=points, normals=damaged)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npz").normals, normals)


def test_many_normals_without_direction_count_as_none(cloud, tmp_path):
    np.savez(tmp_path / "a.npz", points=cloud.points, normals=cloud.normals * (np.arange(COUNT) > 3)[:, None])
    assert read_cloud(tmp_path / "a.npz").normals is None


def test_rows_with_nan_are_refused_or_left_out(cloud, tmp_path):
    points = cloud.points.copy()
    points[[4, 9], 1] = np.nan, np.inf
    path = tmp_path / "a.npz"
    np.savez(path, points=points, normals=cloud.normals, colors=cloud.colors)
    refuse(
        path,
        r" must be finite, got 2 of 24 rows with NaN or inf \(first at row 4\); "
        r"leave them out with --drop-invalid \(drop_invalid=True in Python\)$",
    )
    assert_same(read_cloud(path, drop_invalid=True), cloud.take(np.delete(np.arange(COUNT), [4, 9])))


def patch_import(monkeypatch, import_module):
    """Only where Open3D is imported: finding the library that comes with a package imports modules as well."""
    monkeypatch.setattr("cgf.io.libraries.importlib", SimpleNamespace(import_module=import_module))


def test_libusb_is_found_where_the_system_lacks_it(monkeypatch):
    attempts = []

    def import_once(name):
        attempts.append(name)
        if len(attempts) == 1:
            raise ImportError("libusb-1.0.so.0: cannot open shared object file")
        return pytest

    patch_import(monkeypatch, import_once)
    assert import_open3d() is pytest
    assert attempts == ["open3d", "open3d"]


def test_a_library_that_the_system_lacks_is_named_with_its_package(monkeypatch):
    def fail(name):
        raise ImportError("libEGL.so.1: cannot open shared object file: No such file or directory")

    patch_import(monkeypatch, fail)
    message = (
        r"^Open3D, which computes fpfh, must find libEGL\.so\.1, got none on this system; "
        r"on Debian and Ubuntu: apt-get install libegl1 libgl1 libidn2-0 libx11-6$"
    )
    with pytest.raises(InputError, match=message):
        import_open3d()


def test_other_reasons_why_open3d_cannot_load_are_not_hidden(monkeypatch):
    def fail(name):
        raise ImportError("no such module")

    patch_import(monkeypatch, fail)
    with pytest.raises(ImportError, match=r"^no such module$"):
        import_open3d()

"""Small files: one in each format of `cgf.io`, written byte by byte, and a scene to train on."""

import itertools
import re
import struct

import numpy as np
import pytest

from cgf.checks import InputError
from cgf.io import read_cloud, write_cloud
from cgf.types import PointCloud

COUNT = 24


def small_cloud():
    """Points on a coarse grid, so that text and single precision hold them exactly."""
    rng = np.random.default_rng(11)
    normals = np.eye(3)[rng.integers(0, 3, COUNT)] * rng.choice([-1, 1], (COUNT, 1))
    return PointCloud(
        points=rng.permutation(np.array(list(itertools.product(range(3), range(3), range(3)))))[:COUNT] * 0.25 - 1.5,
        normals=normals.astype(np.float64),
        colors=rng.integers(1, 256, (COUNT, 3)).astype(np.uint8),
        viewpoint=np.array([1.0, 2.0, 3.0]),
    )


def ply_header(form, properties, rest=""):
    lines = "".join(f"property {kind} {name}\n" for name, kind in properties)
    return f"ply\nformat {form} 1.0\ncomment made by a test\nelement vertex {COUNT}\n{lines}{rest}end_header\n".encode()


def columns(cloud):
    return np.hstack([cloud.points, cloud.normals, cloud.colors])


def text_rows(table):
    return "".join(" ".join(f"{value:.6g}" for value in row) + "\n" for row in table).encode()


XYZ = [("x", "float"), ("y", "float"), ("z", "float")]
ALL = [
    *XYZ,
    ("nx", "double"),
    ("ny", "double"),
    ("nz", "double"),
    ("red", "uchar"),
    ("green", "uchar"),
    ("blue", "uchar"),
]


def binary_rows(cloud, order):
    kinds = {"float": "f4", "double": "f8", "uchar": "u1"}
    table = np.zeros(COUNT, dtype=[(name, order + kinds[kind]) for name, kind in ALL])
    for (name, _), column in zip(ALL, columns(cloud).T, strict=True):
        table[name] = column
    return table.tobytes()


def save(folder, name, data):
    path = folder / name
    path.write_bytes(data)
    return path


def refuse(path, message, **settings):
    with pytest.raises(InputError, match="^" + re.escape(str(path)) + message) as caught:
        read_cloud(path, **settings)
    assert "\n" not in str(caught.value)


GRID = "element range_grid 4\nproperty list uchar int vertex_indices\n"


# A square pyramid over 0, 0 to 1, 1 on a finer base: its sides have known normals.
BASE = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 1]], dtype=float)
PYRAMIDS = np.concatenate([BASE, BASE + np.array([4, 0, 0]), BASE + np.array([0, 4, 0])])
SIDES = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
FACES = [tuple(corner + 5 * part for corner in side) for part in range(3) for side in SIDES]
QUADS = [tuple(corner + 5 * part for corner in (3, 2, 1, 0)) for part in range(3)]
FACE = "element face {}\nproperty list uchar int vertex_indices\n"


PCD = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ normal_x normal_y normal_z rgb\nSIZE 4 4 4 1 4 4 4 4\n"
    f"TYPE F F F U F F F U\nCOUNT 1 1 1 4 1 1 1 1\nWIDTH {COUNT}\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS {COUNT}\n"
)


def pcd_table(cloud):
    table = np.zeros(COUNT, dtype=[("points", "<f4", 3), ("pad", "u1", 4), ("normals", "<f4", 3), ("rgb", "<u4")])
    table["points"], table["normals"] = cloud.points, cloud.normals
    table["rgb"] = cloud.colors.astype(np.uint32) @ np.array([65536, 256, 1], dtype=np.uint32)
    return table


def literal_lzf(data):
    """LZF that copies nothing: runs of at most 32 bytes as they are."""
    return b"".join(
        bytes([len(data[start : start + 32]) - 1]) + data[start : start + 32] for start in range(0, len(data), 32)
    )


def compressed_body(cloud):
    table = pcd_table(cloud)
    parts = [*(table["points"][:, axis] for axis in range(3)), table["pad"],
             *(table["normals"][:, axis] for axis in range(3)), table["rgb"]]  # fmt: skip
    content = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    packed = literal_lzf(content)
    return struct.pack("<II", len(packed), len(content)) + packed


def samples(cloud):
    """One file of each format and mode, by name."""
    full = columns(cloud)
    table = pcd_table(cloud)
    triangles = b"".join(
        bytes(12) + triangle.astype("<f4").tobytes() + b"\0\0" for triangle in PYRAMIDS[np.array(FACES)]
    )
    mesh = ply_header("binary_little_endian", ALL, FACE.format(2)) + binary_rows(cloud, "<")
    return {
        "text.ply": ply_header("ascii", ALL, GRID) + text_rows(full) + b"0\n1 0\n0\n1 1\n",
        "binary.ply": mesh + struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3),
        "binary.pcd": f"{PCD}DATA binary\n".encode() + table.tobytes(),
        "compressed.pcd": f"{PCD}DATA binary_compressed\n".encode() + compressed_body(cloud),
        "rows.csv": b"x,y,z,nx,ny,nz,r,g,b\n" + text_rows(full).replace(b" ", b","),
        "mesh.obj": b"".join(b"v " + row + b"\n" for row in text_rows(PYRAMIDS).splitlines()) + b"f 1 2 3\nf 2 3 4\n",
        "mesh.stl": bytes(80) + struct.pack("<I", len(FACES)) + triangles,
    }


def write_scene(folder, seed):
    """Three bumpy floors of 2 m, each of other points, and the log that says that they lie on each other."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    for number in range(3):
        x, y = rng.uniform(0, 2, (2, 2_000))
        points = np.column_stack([x, y, 0.1 * np.sin(5 * x + seed) * np.cos(4 * y)])
        normals = np.column_stack([-0.5 * np.cos(5 * x + seed), 0.4 * np.sin(4 * y), np.ones(len(x))])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        write_cloud(folder / f"cloud_bin_{number}.ply", PointCloud(points, normals))
    rows = "\n".join(" ".join(map(str, row)) for row in np.eye(4))
    (folder / "gt.log").write_text("".join(f"{i} {j} 3\n{rows}\n" for i, j in ((0, 1), (0, 2), (1, 2))))

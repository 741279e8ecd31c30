"""Furnished rooms, of a furniture library of three boxes."""

import zipfile

import numpy as np
import pytest

from cgf import cli
from cgf.checks import InputError
from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.geometry.transforms import apply
from cgf.io import read_cloud, read_log
from cgf.training.fragments import fragments_of_scenes
from cgf.training.rooms import scanning
from cgf.training.rooms.furnishing import furnish
from cgf.training.rooms.furniture import read_libraries
from cgf.training.rooms.making import make_rooms
from cgf.training.rooms.scanning import scan, write_scene
from cgf.types import PointCloud

BOX = """
o box
v 0 0 0
v 2 0 0
v 0 3 0
v 2 3 0
v 0 0 1
v 2 0 1
v 0 3 1
v 2 3 1
f 1 3 4 2
f 5 6 8 7
f 1 2 6 5
f 3 7 8 4
f 1 5 7 3
f 2 4 8 6
"""
CATALOG = """
name#1=Wardrobe
category#1=Bedroom
model#1=/box.obj
width#1=120
depth#1=60
height#1=180
name#2=Lamp
category#2=Lights
model#2=/box.obj
modelRotation#2=0 0 1 0 1 0 -1 0 0
width#2=20
depth#2=20
height#2=30
elevation#2=150
name#3=Cup
category#3=Kitchen
model#3=/box.obj
width#3=8
depth#3=8
height#3=10
name#4=Car
category#4=Vehicles
model#4=/box.obj
width#4=200
depth#4=400
height#4=150
name#5=Sofa
category#5=Living room
model#5=/sofa.dae
width#5=200
depth#5=90
height#5=80
"""


def silent(share, text):
    pass


@pytest.fixture
def library(tmp_path):
    path = tmp_path / "boxes.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOG)
        archive.writestr("box.obj", BOX)
        archive.writestr("sofa.dae", "")
    return path


def test_models_have_their_real_size_and_stand_on_the_floor(library):
    models = read_libraries([library], progress=silent)
    assert [model.name for model in models] == ["Wardrobe", "Lamp", "Cup"]
    for model in models:
        low, high = model.mesh.vertices.min(axis=0), model.mesh.vertices.max(axis=0)
        np.testing.assert_allclose(high - low, model.size)
        np.testing.assert_allclose([*(low + high)[:2], low[2]], 0, atol=1e-12)
        assert len(model.mesh.triangles) == 12
    np.testing.assert_allclose(models[0].size, [1.2, 0.6, 1.8])
    assert models[1].elevation == pytest.approx(1.5)


def test_what_is_no_library_is_refused(tmp_path, library):
    other = tmp_path / "other.sh3f"
    other.write_text("no archive")
    with pytest.raises(InputError, match=r"other\.sh3f must be a furniture library of Sweet Home 3D \(\.sh3f\), got"):
        read_libraries([library, other], progress=silent)
    with pytest.raises(InputError, match=r"missing\.sh3f must be a furniture library"):
        read_libraries([tmp_path / "missing.sh3f"], progress=silent)
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr(
            "PluginFurnitureCatalog.properties", CATALOG.split("name#2", maxsplit=1)[0].replace("box.obj", "box.3ds")
        )
    with pytest.raises(InputError, match=r"other\.sh3f must hold OBJ models of what stands in rooms, got none"):
        read_libraries([other], progress=silent)


def test_rooms_hold_what_fits_into_them(library):
    models = read_libraries([library], progress=silent)
    for seed in range(5):
        room = furnish(models, np.random.default_rng(seed))
        low, high = room.mesh.vertices.min(axis=0), room.mesh.vertices.max(axis=0)
        # Walls are thick, and what hangs on one may reach through the next.
        assert (low > -1.5).all()
        assert (high < room.size + 1.5).all()
        assert low[2] == pytest.approx(-0.1)
        assert np.isfinite(room.mesh.vertices).all()
        assert room.mesh.triangles.max() < len(room.mesh.vertices)
        assert ((room.spots > 0) & (room.spots < room.size)).all()


def test_fragments_lie_on_the_surfaces_that_their_camera_sees(library):
    from cgf.training.rooms.furnishing import raycasting

    rng = np.random.default_rng(3)
    room = furnish(read_libraries([library], progress=silent), rng)
    clouds, poses = scan(room, count=2, rng=rng)
    scene = raycasting(room.mesh)
    for cloud, pose in zip(clouds, poses, strict=True):
        apart = scene.compute_distance(apply(pose, cloud.points).astype(np.float32)).numpy()
        # Noise grows with the square of the distance; tracking errs by millimetres.
        assert np.median(apart) < 0.015
        assert np.quantile(apart, 0.99) < 0.08
        assert (cloud.points[:, 2] > 0).mean() > 0.9


@pytest.mark.slow
def test_the_command_makes_scenes_to_train_on_and_goes_on_where_it_was(library, tmp_path, capsys):
    rooms = tmp_path / "rooms"
    arguments = ["rooms", str(library), "-o", str(rooms), "--fragments", "4", "--seed", "5"]
    assert cli.main([*arguments, "--count", "1"]) == 0
    first = read_cloud(rooms / "room_000" / "cloud_bin_1.ply")
    written = (rooms / "room_000" / "gt.log").stat().st_mtime_ns
    assert cli.main([*arguments, "--count", "2"]) == 0
    assert (rooms / "room_000" / "gt.log").stat().st_mtime_ns == written
    assert "2 rooms with" in capsys.readouterr().err
    again = tmp_path / "again"
    make_rooms([library], again, count=1, fragments=4, seed=5, progress=silent)
    np.testing.assert_array_equal(read_cloud(again / "room_000" / "cloud_bin_1.ply").points, first.points)

    scenes = [rooms / "room_000", rooms / "room_001"]
    entry = read_log(scenes[0] / "gt.log")[0]
    target, source = (read_cloud(scenes[0] / f"cloud_bin_{number}.ply") for number in (entry.target, entry.source))
    from cgf.geometry.neighbors import nearest

    near = nearest(target.points, apply(entry.target_from_source, source.points))[1] < 0.05
    assert near.mean() > 0.3
    defaults = MODEL_DEFAULTS["indoor"]
    fragments = fragments_of_scenes(scenes, logs=("gt.log",), defaults=defaults, voxel_sizes=(0.05,), progress=silent)
    assert {overlap.scene for overlap in fragments.overlaps} == {0, 1}


def test_the_command_refuses_too_few(library, tmp_path, capsys):
    assert cli.main(["rooms", str(library), "-o", str(tmp_path / "rooms"), "--count", "0"]) == 2
    assert "count must be 1 or more, got 0" in capsys.readouterr().err
    assert cli.main(["rooms", str(library), "-o", str(tmp_path / "rooms"), "--fragments", "1"]) == 2
    assert "fragments must be 2 or more, got 1" in capsys.readouterr().err


def test_nothing_is_written_of_a_room_whose_fragments_do_not_overlap(tmp_path):
    rng = np.random.default_rng(0)
    clouds = [PointCloud(rng.uniform(size=(500, 3)) + offset) for offset in (0, 50)]
    assert write_scene(tmp_path / "room", clouds, [np.eye(4), np.eye(4)]) == 0
    assert not (tmp_path / "room").exists()


def test_a_room_in_which_nothing_can_be_seen_gives_no_fragments(monkeypatch):
    monkeypatch.setattr(scanning, "_FEWEST", 10**9)
    room = furnish([], np.random.default_rng(4))
    assert scan(room, count=1, rng=np.random.default_rng(4)) == ([], [])

"""Fragments of a room as a person with a depth camera takes them: noisy range images of a second or two, fused."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, zoom

from cgf.geometry.sampling import voxel_downsample
from cgf.geometry.transforms import move
from cgf.io import LogEntry, import_open3d, write_cloud, write_log
from cgf.training.overlap import overlapping_pairs
from cgf.training.rooms.furnishing import Room, raycasting
from cgf.types import PointCloud, Transform

_COLUMNS, _ROWS, _FOCAL = 320, 240, 290.0
"""Of the range images: half as fine as the camera's own."""
_IMAGES = 9
"""Fused into one fragment."""
_NEAREST = 0.4
_SPACING = 0.012
"""Between the points of a fragment, in metres, as in 3DMatch."""
_DISPARITY_STEP = 0.00285 / 2
"""Per square metre of distance: half the camera's own step, since several images are fused."""
_STEEPEST_COSINE = 0.12
_FEWEST, _TRIES = 5_000, 10
"""Points of a fragment that is kept, and paths that are tried for each."""
_OVERLAP_VOXEL = 0.04
"""Clouds are compared at this spacing, in metres, which is more than the noise."""
_CLEARANCE = 0.3
"""Of the camera from anything, in metres."""


def scan(room: Room, *, count: int, rng: np.random.Generator) -> tuple[list[PointCloud], list[Transform]]:
    """Take `count` fragments of a room, or fewer where hardly anything can be seen.

    Returns:
        Clouds with the first camera of each at the origin, looking along z; and room_from_cloud of each.
    """
    scene = raycasting(room.mesh)
    some = rng.permutation(len(room.spots))[: rng.integers(2, 5)]
    spots = room.spots[some] if len(some) else room.size[None] * [0.5, 0.5, 0.3]
    clouds: list[PointCloud] = []
    poses: list[Transform] = []
    for _ in range(_TRIES * count):
        if len(clouds) == count:
            break
        path = _path(scene, room, spots[rng.integers(len(spots))], rng)
        cloud = _fragment(scene, path, rng)
        if len(cloud) > _FEWEST:
            clouds.append(cloud)
            poses.append(path[0])
    return clouds, poses


def write_scene(folder: Path, clouds: list[PointCloud], poses: list[Transform]) -> int:
    """Write cloud_bin_N.ply and then gt.log, the relative poses of all pairs that overlap; returns their number.

    Nothing is written where none overlaps.
    """
    placed = [move(pose, voxel_downsample(cloud, _OVERLAP_VOXEL)) for cloud, pose in zip(clouds, poses, strict=True)]
    entries = [
        LogEntry(target=i, source=j, total=len(clouds), target_from_source=np.linalg.inv(poses[i]) @ poses[j])
        for i, j in overlapping_pairs(placed)
    ]
    if entries:
        folder.mkdir(parents=True, exist_ok=True)
        for number, cloud in enumerate(clouds):
            write_cloud(folder / f"cloud_bin_{number}.ply", cloud)
        write_log(folder / "gt.log", entries)
    return len(entries)


def _path(scene: Any, room: Room, spot: Float64[np.ndarray, "3"], rng: np.random.Generator) -> list[Transform]:
    """Poses of a camera that somebody holds in their hand and moves a little, looking at a spot and around it."""
    eye = _free_place(scene, room, spot, rng)
    aim = spot + rng.normal(size=3) * [0.5, 0.5, 0.3]
    step = rng.normal(size=3) * [0.3, 0.3, 0.1] / _IMAGES
    sweep = rng.normal(size=3) * [0.4, 0.4, 0.15] * np.linalg.norm(aim - eye) / _IMAGES
    roll = rng.normal() * 0.1
    return [_looking(eye + number * step, aim + number * sweep, roll) for number in range(_IMAGES)]


def _free_place(
    scene: Any, room: Room, spot: Float64[np.ndarray, "3"], rng: np.random.Generator
) -> Float64[np.ndarray, "3"]:
    """Where a camera may be that looks at a spot: the freest of some places if none is free and far enough."""
    places = rng.uniform([0.3, 0.3, 0.7], [*room.size[:2] - 0.3, min(1.9, room.size[2] - 0.3)], (20, 3))
    apart = scene.compute_distance(places.astype(np.float32)).numpy()
    away = np.linalg.norm(places - spot, axis=1)
    free = np.flatnonzero((apart > _CLEARANCE) & (away > 1.0) & (away < 3.2))
    return places[free[0] if len(free) else int(apart.argmax())]


def _looking(eye: Float64[np.ndarray, "3"], aim: Float64[np.ndarray, "3"], roll: float) -> Transform:
    """room_from_camera of a camera whose z points to `aim`, and whose y points down but for `roll`."""
    z = (aim - eye) / np.linalg.norm(aim - eye)
    down = np.array([np.sin(roll), 0.0, -np.cos(roll)])
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return pose


def _fragment(scene: Any, path: list[Transform], rng: np.random.Generator) -> PointCloud:
    """The range images along a path, fused."""
    open3d = import_open3d()
    float32, float64 = open3d.core.float32, open3d.core.float64
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (float32, float32), ((1,), (1,)), voxel_size=_SPACING, block_resolution=16, block_count=4096
    )
    center = ((_COLUMNS - 1) / 2, (_ROWS - 1) / 2)
    camera = open3d.core.Tensor([[_FOCAL, 0, center[0]], [0, _FOCAL, center[1]], [0, 0, 1]], float64)
    farthest, warp = rng.uniform(3.0, 4.5), _smooth(rng) * rng.uniform(0, 0.008)
    start, drift, fused = np.linalg.inv(path[0]), np.eye(4), 0
    for pose in path:
        image = _image(scene, pose, warp, farthest, rng)
        if not image.any():
            continue
        depth = open3d.t.geometry.Image(open3d.core.Tensor(image[:, :, None]))
        # The program that fuses believes what it tracked, which is not quite where the camera was.
        tracked = open3d.core.Tensor(np.linalg.inv(start @ pose @ drift))
        drift = drift @ _small_motion(rng)
        # Distances are in metres, and cut off where voxels are further from the surface than three of them.
        lengths = (1.0, farthest, 3.0)
        seen = grid.compute_unique_block_coordinates(depth, camera, tracked, *lengths)
        grid.integrate(seen, depth, camera, tracked, *lengths)
        fused += 1
    if not fused:
        return PointCloud(np.empty((0, 3)))
    points = grid.extract_point_cloud(weight_threshold=1.5).point.positions.numpy().astype(np.float64)
    return voxel_downsample(PointCloud(points), _SPACING)


def _image(
    scene: Any, pose: Transform, warp: Float64[np.ndarray, "R C"], farthest: float, rng: np.random.Generator
) -> Float32[np.ndarray, "R C"]:
    """Distances along z as a camera with structured light measures them; 0 where it sees none."""
    u, v = np.meshgrid(np.arange(_COLUMNS), np.arange(_ROWS))
    jitter = rng.uniform(-0.5, 0.5, (2, _ROWS, _COLUMNS))
    x, y = (u + jitter[0] - (_COLUMNS - 1) / 2) / _FOCAL, (v + jitter[1] - (_ROWS - 1) / 2) / _FOCAL
    directions = np.stack([x, y, np.ones_like(x)], axis=2) @ pose[:3, :3].T
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], directions.shape), directions], axis=2)
    hits = scene.cast_rays(rays.astype(np.float32))
    # Directions are 1 long along z, so what is told is the distance along it.
    depth, normals = hits["t_hit"].numpy().astype(np.float64), hits["primitive_normals"].numpy()
    cosine = np.abs(np.einsum("ijk,ijk->ij", normals, directions)) / np.linalg.norm(directions, axis=2)
    seen = np.isfinite(depth) & (depth > _NEAREST) & (depth < farthest) & (cosine > _STEEPEST_COSINE)
    depth = np.where(seen, depth, farthest)
    # Beside an edge the pattern of light is broken: the camera sees nothing there, or something between.
    jumps = maximum_filter(depth, 3) - minimum_filter(depth, 3) > 0.06 * depth
    seen &= ~(jumps & (rng.random(depth.shape) < 0.7))
    seen &= _patches(rng)
    # Khoshelham and Elberink 2012: errors and steps grow with the square of the distance.
    noise = rng.normal(size=depth.shape) + 2.5 * gaussian_filter(rng.normal(size=depth.shape), 1.5)
    depth = depth * (1 + warp) + 0.0009 * depth**2 * noise
    step = _DISPARITY_STEP * depth**2
    depth = np.round(depth / step) * step
    return np.where(seen, depth, 0).astype(np.float32)


def _patches(rng: np.random.Generator) -> Bool[np.ndarray, "R C"]:
    """What is left of an image where shiny and black things are not seen."""
    if rng.random() < 0.5:
        return np.ones((_ROWS, _COLUMNS), dtype=np.bool_)
    return _smooth(rng) < rng.uniform(1.8, 3.0)


def _smooth(rng: np.random.Generator) -> Float64[np.ndarray, "R C"]:
    """A field over an image that changes slowly, of deviation 1 about."""
    coarse = zoom(rng.normal(size=(7, 9)), (_ROWS / 7, _COLUMNS / 9), order=1)
    return np.asarray(coarse[:_ROWS, :_COLUMNS] * 1.3)


def _small_motion(rng: np.random.Generator) -> Transform:
    """How far tracking goes astray from one image to the next: a millimetre or two, and a fraction of a degree."""
    pose = np.eye(4)
    a, b, c = rng.normal(size=3) * 0.0008
    pose[:3, :3] = np.linalg.qr(np.array([[1, -c, b], [c, 1, -a], [-b, a, 1]]))[0]
    pose[:3, :3] *= np.sign(np.diag(pose[:3, :3]))
    pose[:3, 3] = rng.normal(size=3) * 0.0015
    return pose

"""What is trained on: overlapping clouds with their relative poses, from meshes or from scenes."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from cgf.checks import InputError
from cgf.descriptors.settings import ModelDefaults
from cgf.geometry.normals import estimate_normals
from cgf.geometry.sampling import voxel_downsample
from cgf.io import read_cloud, read_log
from cgf.io.poses import LogEntry
from cgf.training.overlap import overlapping_pairs
from cgf.training.render import render_views
from cgf.types import PointCloud, Progress, Transform

_MESH_SUFFIXES = {".ply", ".obj", ".stl", ".off"}


@dataclass(frozen=True, eq=False)
class Overlap:
    """Two clouds that show the same surface."""

    source: int
    target: int
    target_from_source: Float64[np.ndarray, "4 4"]
    scene: int
    """Two overlaps of one scene may show the same place."""
    voxel_size: float
    """The larger of the two clouds' voxel sizes."""
    place_from_target: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Into a frame that the overlaps of a place have in common."""
    place: int = 0
    """Of the scene: how two places lie to each other is not known."""


@dataclass(frozen=True, eq=False)
class Fragments:
    """Prepared clouds (downsampled, with normals) and which of them overlap."""

    clouds: list[PointCloud]
    overlaps: list[Overlap]
    groups: list[list[PointCloud]]
    """Clouds by scene and voxel size, for negatives from a whole model."""
    other_normals: list[list[Float64[np.ndarray, "_ 3"]]] = field(default_factory=list)
    """Of each cloud, its normals as other programs may have estimated them; none where the list is empty."""


def fragments_of_meshes(
    folder: Path,
    *,
    defaults: ModelDefaults,
    view_sets: int,
    noise: tuple[float, float],
    seed: int,
    progress: Progress,
) -> Fragments:
    """Render `view_sets` times 14 views of every mesh in `folder`; lengths are shares of a mesh's diameter.

    Raises:
        InputError: There is no mesh, or no two views overlap.
    """
    paths = (
        sorted(path for path in folder.iterdir() if path.suffix.lower() in _MESH_SUFFIXES) if folder.is_dir() else []
    )
    if not paths:
        raise InputError(f"--meshes must be a folder of meshes (PLY, OBJ, STL, OFF), got {folder}; give another folder")
    clouds: list[PointCloud] = []
    overlaps: list[Overlap] = []
    groups: list[list[PointCloud]] = []
    jobs = [(scene, path, number) for scene, path in enumerate(paths) for number in range(view_sets)]
    for done, (scene, path, number) in enumerate(jobs):
        progress(done / len(jobs), f"rendering {path.stem}")
        rng = np.random.default_rng([seed, scene, number])
        views = render_views(path, noise=noise, normal_radius=defaults.normal_radius, rng=rng)
        prepared = [voxel_downsample(view, defaults.voxel_size) for view in views]
        groups.append(prepared)
        for i, j in overlapping_pairs(prepared):
            overlaps.append(Overlap(len(clouds) + i, len(clouds) + j, np.eye(4), scene, defaults.voxel_size))
        clouds.extend(prepared)
    return _checked(Fragments(clouds, overlaps, groups), folder)


def fragments_of_scenes(
    folders: list[Path],
    *,
    logs: tuple[str, ...],
    defaults: ModelDefaults,
    voxel_sizes: tuple[float, ...],
    progress: Progress,
) -> Fragments:
    """Read the fragments that each folder's `logs` pair, at several voxel sizes; lengths are in metres.

    Clouds without normals get them from the full density, turned to the frame's origin.

    Raises:
        InputError: A folder lacks a log, or no pair overlaps.
    """
    clouds: list[PointCloud] = []
    overlaps: list[Overlap] = []
    groups: list[list[PointCloud]] = []
    for scene, folder in enumerate(folders):
        entries = [entry for log in logs for entry in read_log(folder / log)]
        numbers = sorted({entry.source for entry in entries} | {entry.target for entry in entries})
        first: dict[tuple[int, float], int] = {}
        by_size: dict[float, list[PointCloud]] = {size: [] for size in voxel_sizes}
        for done, number in enumerate(numbers):
            progress((scene + done / len(numbers)) / len(folders), f"reading {folder.name}")
            cloud = read_cloud(folder / f"cloud_bin_{number}.ply")
            if cloud.normals is None:
                cloud = estimate_normals(cloud, radius=defaults.normal_radius)
            for size in voxel_sizes:
                first[number, size] = len(clouds)
                clouds.append(voxel_downsample(cloud, size))
                by_size[size].append(clouds[-1])
        groups.extend(by_size.values())
        places = _places(entries)
        for entry in entries:
            place, pose = places[entry.target]
            for size, other in _size_pairs(voxel_sizes):
                source, target = first[entry.source, size], first[entry.target, other]
                overlaps.append(Overlap(source, target, entry.target_from_source, scene, max(size, other), pose, place))
    return _checked(Fragments(clouds, overlaps, groups), *folders)


def _places(entries: list[LogEntry]) -> dict[int, tuple[int, Transform]]:
    """For each cloud, the number of its place and its pose there: clouds that a chain of poses joins share one."""
    neighbors: dict[int, list[tuple[int, Transform]]] = {}
    for entry in entries:
        neighbors.setdefault(entry.source, []).append((entry.target, np.linalg.inv(entry.target_from_source)))
        neighbors.setdefault(entry.target, []).append((entry.source, entry.target_from_source))
    places: dict[int, tuple[int, Transform]] = {}
    for first in sorted(neighbors):
        if first in places:
            continue
        places[first] = (first, np.eye(4))
        reached = [first]
        for number in reached:
            for other, from_other in neighbors[number]:
                if other not in places:
                    places[other] = (first, places[number][1] @ from_other)
                    reached.append(other)
    return places


def with_other_normals(fragments: Fragments, radii: tuple[float, ...], *, progress: Progress) -> Fragments:
    """Estimate normals again from the downsampled clouds, within each of `radii`, in voxels.

    They keep the side of those that there are.
    """
    # The larger of two clouds' sizes; each cloud overlaps some other of its own size.
    size_of: dict[int, float] = {}
    for overlap in fragments.overlaps:
        for number in (overlap.source, overlap.target):
            size_of[number] = min(overlap.voxel_size, size_of.get(number, overlap.voxel_size))
    others = []
    for number, cloud in enumerate(fragments.clouds):
        progress(number / len(fragments.clouds), "estimating normals anew")
        others.append([_estimated_again(cloud, radius * size_of[number]) for radius in radii if number in size_of])
    return replace(fragments, other_normals=others)


def _estimated_again(cloud: PointCloud, radius: float) -> Float64[np.ndarray, "N 3"]:
    assert cloud.normals is not None
    estimated = estimate_normals(replace(cloud, normals=None), radius=radius, viewpoint=np.zeros(3)).normals
    assert estimated is not None
    is_turned = np.einsum("ij,ij->i", estimated, cloud.normals) < 0
    return np.where(is_turned[:, None], -estimated, estimated)


def _size_pairs(sizes: tuple[float, ...]) -> Iterator[tuple[float, float]]:
    """Each voxel size with itself and with its neighbours in the list."""
    for i, size in enumerate(sizes):
        for other in sizes[max(i - 1, 0) : i + 2]:
            yield size, other


def _checked(fragments: Fragments, *folders: Path) -> Fragments:
    if not fragments.overlaps:
        names = ", ".join(str(folder) for folder in folders)
        raise InputError(
            f"{names} must hold clouds that overlap by 30 % or more, got none; add scans or check the poses"
        )
    return fragments

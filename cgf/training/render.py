"""Range images of a mesh, as a scanner that walks around it would take them (the paper's section 6.1)."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from cgf.checks import InputError
from cgf.geometry.normals import estimate_normals
from cgf.io import import_open3d
from cgf.types import PointCloud

_PIXELS = 320
"""Rows and columns of a range image: points about 0.4 % of the diameter apart."""
_DISTANCE = 2.0
"""From the centre of the mesh to the camera, in diameters."""
_STEEPEST_COSINE = 0.12
"""Scanners lose surfaces seen at less than about 7 degrees."""


def view_directions() -> Float64[np.ndarray, "14 3"]:
    """Fourteen directions spread evenly over the sphere: the faces and corners of a cube."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    return np.concatenate([faces, corners])


def render_views(
    path: Path, *, noise: tuple[float, float], normal_radius: float, rng: np.random.Generator
) -> list[PointCloud]:
    """Render 14 range images of a mesh, noisy, in the frame of the mesh scaled to diameter 1.

    Args:
        path: Any mesh that Open3D reads.
        noise: Least and largest standard deviation of a coordinate, in diameters; one is drawn per view.
        normal_radius: Of the neighbourhood for normals, in diameters.
        rng: Turns the set of views as a whole, and makes the noise.

    Raises:
        InputError: The file holds no triangles.
    """
    open3d = import_open3d()
    mesh = open3d.io.read_triangle_mesh(str(path))
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    if len(triangles) == 0:
        raise InputError(f"{path} must be a mesh with triangles, got none; give point clouds with poses by --scenes")
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices /= np.linalg.norm(np.ptp(vertices, axis=0))
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    views = []
    for number, direction in enumerate(view_directions() @ turn.T):
        points = _cast(scene, direction * _DISTANCE, rng)
        if len(points) < 200:
            continue
        points = points + rng.normal(size=points.shape) * rng.uniform(*noise)
        cloud = PointCloud(points, name=f"{path.stem}/{number}", viewpoint=direction * _DISTANCE)
        views.append(estimate_normals(cloud, radius=normal_radius))
    return views


def _cast(scene: Any, eye: Float64[np.ndarray, "3"], rng: np.random.Generator) -> Float64[np.ndarray, "N 3"]:
    """Points where the rays of one image meet the mesh."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, rng.normal(size=3))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    # At the distance of the centre, the image is as wide as the diameter and a little more.
    steps = (np.arange(_PIXELS) + 0.5) / _PIXELS * 1.1 - 0.55
    u, v = np.meshgrid(steps, steps)
    directions = forward * _DISTANCE + u.reshape(-1, 1) * right + v.reshape(-1, 1) * down
    rays = np.concatenate([np.broadcast_to(eye, directions.shape), directions], axis=1).astype(np.float32)
    hits = scene.cast_rays(rays)
    depth, normals = hits["t_hit"].numpy(), hits["primitive_normals"].numpy()
    cosine = np.abs(np.einsum("ij,ij->i", normals, directions)) / np.linalg.norm(directions, axis=1)
    seen = np.isfinite(depth) & (cosine > _STEEPEST_COSINE)
    return eye + depth[seen, None] * directions[seen]

"""Rooms as a few rules and many random draws make them: walls with recesses, furniture, and things that lie about."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64

from cgf.checks import ArrayLike
from cgf.io import import_open3d
from cgf.training.rooms.furniture import Mesh, Model

_SMALL = 0.45
"""Longest side of what is a thing rather than a piece of furniture, in metres."""
_TRIES = 12
"""Places that are tried for a piece of furniture before it is left out."""
_SCALE = 0.25
"""Models are scaled along each axis by up to 1 plus this, or shrunk by as much."""
_BOX_SIDES = ((0, 2, 1, 3), (4, 5, 6, 7), (0, 1, 4, 5), (2, 6, 3, 7), (0, 4, 2, 6), (1, 3, 5, 7))
_BOX_FACES = np.array([corners for a, b, c, d in _BOX_SIDES for corners in ((a, b, c), (b, d, c))])


@dataclass(frozen=True, eq=False)
class Room:
    """Everything in a room, in metres: the floor is z = 0, one of its corners the origin."""

    mesh: Mesh
    size: Float64[np.ndarray, "3"]
    spots: Float64[np.ndarray, "S 3"]
    """Where there is something to look at."""


def furnish(models: Sequence[Model], rng: np.random.Generator) -> Room:
    """Build a room of 2.5 to 7 m with a random choice of the models, each mirrored or scaled at random."""
    size = np.array([rng.uniform(2.5, 7.0), rng.uniform(2.5, 5.5), rng.uniform(2.3, 3.0)])
    parts = _shell(size, rng)
    standing = [model for model in models if model.elevation < 0.2 and model.size.max() > _SMALL]
    hanging = [model for model in models if model.elevation >= 0.2]
    things = [model for model in models if model.size.max() <= 2 * _SMALL]
    taken: list[np.ndarray] = []
    spots = []
    for at_wall, count in ((True, size[:2].sum() * rng.uniform(1.2, 2.4)), (False, size[0] * size[1] / 3)):
        for _ in range(rng.poisson(count)):
            is_model = bool(standing) and rng.random() < 0.8
            mesh = _varied(standing[rng.integers(len(standing))], rng) if is_model else _cabinet(rng)
            placed = _placed(mesh, size, taken, rng, at_wall=at_wall)
            if placed is not None:
                parts.append(placed)
                spots.append(_middle(placed))
    for _ in range(rng.poisson(size[:2].sum() * 0.6)):
        mesh = _varied(hanging[rng.integers(len(hanging))], rng) if hanging and rng.random() < 0.5 else _panel(rng)
        parts.append(_at_wall(mesh, size, rng, height=rng.uniform(0.5, size[2] - 0.6)))
    for _ in range(rng.integers(0, 3)):
        parts.append(_at_wall(_curtain(rng), size, rng, height=rng.uniform(0.0, 0.5)))
    for _ in range(2):  # The second time also onto the first.
        scene = raycasting(joined(parts))
        for _ in range(rng.poisson(rng.uniform(0.3, 2.0) * size[0] * size[1])):
            mesh = _varied(things[rng.integers(len(things))], rng) if things and rng.random() < 0.6 else _thing(rng)
            parts.append(_dropped(mesh, scene, size, rng))
        for _ in range(rng.integers(0, 2)):
            parts.append(_draped(scene, size, rng))
    return Room(joined(parts), size, np.array(spots).reshape(-1, 3))


def joined(parts: Sequence[Mesh]) -> Mesh:
    """All triangles as one mesh."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts[:-1], strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def raycasting(mesh: Mesh) -> Any:
    """Open3D's scene of a mesh, in which rays are cast."""
    scene = import_open3d().t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
    return scene


def _shell(size: Float64[np.ndarray, "3"], rng: np.random.Generator) -> list[Mesh]:
    """Floor, ceiling, walls with recesses, and pillars, ledges and beams along them."""
    x, y, z = size
    parts = [_box([x, y, 0.1], [x / 2, y / 2, -0.1]), _box([x, y, 0.1], [x / 2, y / 2, z])]
    for side in range(4):
        length = size[side % 2]
        parts += [_onto_wall(part, size, side, length / 2) for part in _wall(length, z, rng)]
    for _ in range(rng.poisson(3)):
        side, kind = int(rng.integers(4)), rng.integers(3)
        width, depth = rng.uniform(0.15, 1.2), rng.uniform(0.08, 0.6)
        height, bottom = ((z, 0.0), (rng.uniform(0.4, 1.2), 0.0), (rng.uniform(0.2, 0.6), z))[kind]
        bottom = bottom - height if kind == 2 else bottom
        along = rng.uniform(0, size[side % 2])
        parts.append(
            _onto_wall(_box([width * (1 + 2 * (kind > 0)), depth, height], [0, depth / 2, bottom]), size, side, along)
        )
    return parts


def _wall(length: float, height: float, rng: np.random.Generator) -> list[Mesh]:
    """A wall along x with its surface at y = 0, in the middle of x; some have a door or window set back in a frame."""
    if rng.random() < 0.3:
        return [_box([length, 0.1, height], [0, -0.05, 0])]
    is_door = rng.random() < 0.4
    width = min(rng.uniform(0.7, 1.1) if is_door else rng.uniform(0.6, 2.4), 0.8 * length)
    low = 0.0 if is_door else rng.uniform(0.5, 1.2)
    high = min(rng.uniform(1.9, 2.1) if is_door else low + rng.uniform(0.6, 1.5), height - 0.1)
    middle, depth = rng.uniform(-1, 1) * (length - width) / 2, rng.uniform(0.03, 0.3)
    left, right = middle - width / 2, middle + width / 2
    pieces = [
        (-length / 2, left, 0, height),
        (right, length / 2, 0, height),
        (left, right, 0, low),
        (left, right, high, height),
    ]
    parts = [_box([b - a, 0.4, d - c], [(a + b) / 2, -0.2, c]) for a, b, c, d in pieces if b > a and d > c]
    parts.append(_box([width, 0.1, high - low], [middle, -depth - 0.05, low]))
    trim = rng.uniform(0.02, 0.1)
    bars = [(left, low, high), (right, low, high)] + [(middle, low, high)] * (not is_door and rng.random() < 0.6)
    parts += [_box([trim, depth + 0.03, d - c], [a, -depth / 2, c]) for a, c, d in bars]
    if not is_door:
        parts.append(_box([width + 0.1, depth + rng.uniform(0, 0.2), 0.04], [middle, -depth / 2, low - 0.04]))
    return parts


def _box(size: ArrayLike, bottom: ArrayLike) -> Mesh:
    """An upright box of `size`, with the middle of its bottom at `bottom`."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    return Mesh(corners * np.asarray(size) + np.asarray(bottom, dtype=np.float64), _BOX_FACES)


def _varied(model: Model, rng: np.random.Generator) -> Mesh:
    """A model in another size, perhaps mirrored."""
    factors = np.exp(rng.uniform(-1, 1, 3) * np.log1p(_SCALE))
    factors[0] *= rng.choice([-1, 1])
    return Mesh(model.mesh.vertices * factors, model.mesh.triangles)


def _cabinet(rng: np.random.Generator) -> Mesh:
    """A cabinet, shelf or desk of boards, with books and boxes on its boards."""
    width, depth, height = rng.uniform(0.4, 1.8), rng.uniform(0.25, 0.75), rng.uniform(0.4, 2.1)
    levels = np.linspace(0, height, int(height / rng.uniform(0.25, 0.6)) + 2)
    thickness = rng.uniform(0.015, 0.05)
    parts = [_box([width, depth, thickness], [0, 0, level]) for level in levels]
    parts += [_box([thickness, depth, height], [side * width / 2, 0, 0]) for side in (-1, 1)]
    if rng.random() < 0.6:
        parts.append(_box([width, thickness, height], [0, -depth / 2, 0]))
    for low, high in pairwise(levels):
        if rng.random() < 0.3:  # A door or drawer.
            parts.append(_box([width, thickness, high - low], [0, depth / 2, low]))
            continue
        x = -width / 2 + 0.03
        while x < width / 2 - 0.05 and rng.random() < 0.93:
            wide = min(rng.uniform(0.02, 0.3) ** 1.3, width / 2 - x)
            tall, deep = rng.uniform(0.3, 0.9) * (high - low), rng.uniform(0.3, 0.9) * depth
            parts.append(_box([wide, deep, tall], [x + wide / 2, (deep - depth) / 2, low + thickness]))
            x += wide + (rng.uniform(0, 0.2) if rng.random() < 0.2 else 0.005)
    return joined(parts)


def _panel(rng: np.random.Generator) -> Mesh:
    """A picture, cupboard, board or box on a wall."""
    depth = rng.choice([rng.uniform(0.02, 0.08), rng.uniform(0.1, 0.4)])
    return _box([rng.uniform(0.2, 1.5), depth, rng.uniform(0.2, 1.0)], [0, 0, 0])


def _curtain(rng: np.random.Generator) -> Mesh:
    """A sheet that hangs in waves."""
    width, height, waves = rng.uniform(0.4, 2.0), rng.uniform(0.8, 2.2), rng.uniform(3, 12)
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(0, 1, 20))
    y = rng.uniform(0.02, 0.07) * np.sin(2 * np.pi * (waves * x + rng.normal() * 0.2 * np.sin(3 * z) + rng.random()))
    return _sheet(np.stack([x * width, y + 0.05, z * height], axis=2))


def _thing(rng: np.random.Generator) -> Mesh:
    """A box, cylinder, ball or crumpled sheet that lies about."""
    size = rng.uniform(0.04, 0.4, 3) * rng.uniform(0.4, 1)
    kind = rng.integers(4)
    if kind == 0:
        return _box(size, [0, 0, 0])
    turn, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 20), np.linspace(0, 1, 12))
    if kind == 1:
        radius = np.where((rise > 0) & (rise < 1), 1.0, 0.0)
    else:
        radius = np.sqrt(np.maximum(1 - (2 * rise - 1) ** 2, 0))
    if kind == 3:
        radius = radius * np.exp(0.2 * np.sin(3 * turn + rng.normal(size=turn.shape).cumsum(axis=0) * 0.3))
        size[2] *= 0.4
    corners = np.stack([radius * np.cos(turn) / 2, radius * np.sin(turn) / 2, rise], axis=2)
    return _sheet(corners * size)


def _sheet(corners: Float64[np.ndarray, "R C 3"]) -> Mesh:
    """The grid of points as a surface."""
    rows, columns = corners.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    return Mesh(corners.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]))


def _turned(mesh: Mesh, angle: float, shift: ArrayLike) -> Mesh:
    """Turned about z, then moved."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return Mesh(mesh.vertices @ turn.T + np.asarray(shift, dtype=np.float64), mesh.triangles)


def _onto_wall(mesh: Mesh, size: Float64[np.ndarray, "3"], side: int, along: float) -> Mesh:
    """What stands at y = 0 and looks along y, put at a wall: `along` metres from where that begins."""
    x, y, _ = size
    starts = ((along, 0), (x, along), (x - along, y), (0, y - along))
    return _turned(mesh, side * np.pi / 2, [*starts[side], 0])


def _at_wall(mesh: Mesh, size: Float64[np.ndarray, "3"], rng: np.random.Generator, *, height: float) -> Mesh:
    side = int(rng.integers(4))
    depth = mesh.vertices[:, 1].min()
    lifted = _turned(mesh, 0.0, [0, -depth, height - mesh.vertices[:, 2].min()])
    return _onto_wall(lifted, size, side, rng.uniform(0.1, 0.9) * size[side % 2])


def _placed(
    mesh: Mesh, size: Float64[np.ndarray, "3"], taken: list[np.ndarray], rng: np.random.Generator, *, at_wall: bool
) -> Mesh | None:
    """A piece of furniture where little of its ground is taken yet; None if no place is found."""
    for _ in range(_TRIES):
        if at_wall:
            back = mesh.vertices[:, 1].min()
            moved = _turned(mesh, rng.normal() * 0.03, [0, rng.uniform(0, 0.12) - back, 0])
            side = int(rng.integers(4))
            moved = _onto_wall(moved, size, side, rng.uniform(0, size[side % 2]))
        else:
            angle = rng.integers(4) * np.pi / 2 + rng.normal() * 0.15 if rng.random() < 0.6 else rng.uniform(0, 7)
            moved = _turned(mesh, angle, [*rng.uniform(0.1, 0.9, 2) * size[:2], 0])
        low, high = moved.vertices.min(axis=0), moved.vertices.max(axis=0)
        if (low[:2] < -0.02).any() or (high > size + 0.02).any():
            continue
        ground = np.array([low[:2], high[:2]])
        if all(_shared(ground, other) < 0.15 for other in taken):
            taken.append(ground)
            return moved
    return None


def _shared(ground: np.ndarray, other: np.ndarray) -> float:
    """Area that two upright rectangles share, as a share of the smaller one."""
    sides = np.maximum(np.minimum(ground[1], other[1]) - np.maximum(ground[0], other[0]), 0)
    return float(sides.prod() / max(min((ground[1] - ground[0]).prod(), (other[1] - other[0]).prod()), 1e-6))


def _dropped(mesh: Mesh, scene: Any, size: Float64[np.ndarray, "3"], rng: np.random.Generator) -> Mesh:
    """A thing set down where it falls, rather on furniture than on the floor."""
    places = rng.uniform(0.02, 0.98, (5, 2)) * size[:2]
    heights = _heights(scene, places, size[2])
    order = np.argsort(rng.random(5) * 0.9 - (heights > 0.25))
    x, y = places[order[0]]
    if rng.random() < 0.15:  # Fallen over.
        mesh = Mesh(mesh.vertices[:, [2, 0, 1]], mesh.triangles)
    bottom = mesh.vertices[:, 2].min()
    return _turned(mesh, rng.uniform(0, 2 * np.pi), [x, y, heights[order[0]] - bottom])


def _draped(scene: Any, size: Float64[np.ndarray, "3"], rng: np.random.Generator) -> Mesh:
    """A cloth that lies on what is below it."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    sides, angle = rng.uniform(0.4, 1.6, 2), rng.uniform(0, 2 * np.pi)
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 32) * sides[0], np.linspace(-0.5, 0.5, 32) * sides[1])
    middle = rng.uniform(0.2, 0.8, 2) * size[:2]
    x = np.clip(middle[0] + np.cos(angle) * u - np.sin(angle) * v, 0.01, size[0] - 0.01)
    y = np.clip(middle[1] + np.sin(angle) * u + np.cos(angle) * v, 0.01, size[1] - 0.01)
    heights = _heights(scene, np.stack([x.ravel(), y.ravel()], axis=1), size[2]).reshape(x.shape)
    folds = gaussian_filter(rng.normal(size=x.shape), 2) * rng.uniform(0.02, 0.15)
    z = gaussian_filter(maximum_filter(np.minimum(heights, 1.2), 3), 1.0) + np.abs(folds) + 0.01
    return _sheet(np.stack([x, y, z], axis=2))


def _heights(scene: Any, places: Float64[np.ndarray, "P 2"], ceiling: float) -> Float64[np.ndarray, "P"]:
    """Of what lies below each place, seen from just under the ceiling."""
    top = ceiling - 0.01
    rays = np.zeros((len(places), 6), np.float32)
    rays[:, :2], rays[:, 2], rays[:, 5] = places, top, -1
    depth = scene.cast_rays(rays)["t_hit"].numpy().astype(np.float64)
    return np.where(np.isfinite(depth), top - depth, 0.0)


def _middle(mesh: Mesh) -> Float64[np.ndarray, "3"]:
    return (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2

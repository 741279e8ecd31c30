"""Clicks and boxes in the scene, checked before anything sees them."""

import asyncio
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
import viser.transforms
from viser._messages import ScenePointerMessage

from app.picking import Camera, Floats

FARTHEST = 1e6
"""Coordinates in the picture, which is a few units large, are below this."""
_VIEWS = (math.radians(1), math.radians(175))
_SIZES = (1, 100_000)

OnClick = Callable[..., None]
"""Takes the origin and direction of a ray, and `pixel`."""
OnBox = Callable[[Camera, tuple[float, float], tuple[float, float]], None]


def listen_to_pointer(server: viser.ViserServer, *, on_click: OnClick, on_box: OnBox) -> None:
    """Have browsers send clicks, and boxes drawn with Shift held, and pass on those that make sense.

    A drag that turns the camera is no click: the browser tells them apart by 3 pixels of motion.
    """

    # These only switch the gestures on in the browser: viser's own handlers, which trust what they get, are dropped.
    @server.scene.on_click()
    def _(_: viser.SceneClickEvent) -> None: ...

    @server.scene.on_rect_select(modifier="shift")
    def _(_: viser.SceneRectSelectEvent) -> None: ...

    async def handle(client_id: int, message: ScenePointerMessage) -> None:
        client = server.get_clients().get(client_id)
        camera = None if client is None else _camera(client)
        if camera is None:
            return
        if message.event_type == "click":
            ray = _numbers((message.ray_origin, message.ray_direction), (2, 3), limit=FARTHEST)
            if ray is not None and np.linalg.norm(ray[1]) > 0:
                await asyncio.to_thread(on_click, ray[0], ray[1], pixel=camera.pixel)
        elif message.event_type == "rect-select":
            corners = _numbers(message.screen_pos, (2, 2), limit=FARTHEST)
            if corners is not None:
                (left, top), (right, bottom) = np.sort(np.clip(corners, 0, 1), axis=0).tolist()
                await asyncio.to_thread(on_box, camera, (left, top), (right, bottom))

    server._websock_server.register_handler(ScenePointerMessage, handle)


def _numbers(values: Any, shape: tuple[int, ...], *, limit: float) -> Floats | None:
    """`values` as an array, or None if they are not numbers of that shape within the limit."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and (np.abs(array) <= limit).all() else None


def _camera(client: viser.ClientHandle) -> Camera | None:
    """The browser's camera, or None if what it says of it makes no sense."""
    camera = client.camera
    position = _numbers(camera.position, (3,), limit=FARTHEST)
    turn = _numbers(camera.wxyz, (4,), limit=FARTHEST)
    rest = _numbers((camera.fov, camera.image_width, camera.image_height), (3,), limit=FARTHEST)
    if position is None or turn is None or rest is None or not np.linalg.norm(turn) > 0:
        return None
    rotation = np.asarray(viser.transforms.SO3(turn / np.linalg.norm(turn)).as_matrix(), dtype=np.float64)
    width, height = (int(np.clip(size, *_SIZES)) for size in rest[1:])
    return Camera(position, rotation, float(np.clip(rest[0], *_VIEWS)), width, height)

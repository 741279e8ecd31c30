"""The 3D scene of a running session, which comes up while the page loads."""

import asyncio
import threading
from typing import TYPE_CHECKING

from starlette.websockets import WebSocket

from app.picking import Camera, Floats, changes_at, changes_in
from app.session import Session
from app.viewer.server import ViserHost, client_page

if TYPE_CHECKING:
    import viser


class LiveScene:
    """Starts viser in a thread of its own and draws every picture of the session into it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._page = client_page()
        self._ready = threading.Event()
        threading.Thread(target=self._start, name="viser-start", daemon=True).start()

    def page(self) -> str:
        """The page of the scene, for the frame in ours."""
        return self._page

    async def serve(self, socket: WebSocket) -> None:
        """Talk to one browser until it goes away; the socket is not accepted yet."""
        await asyncio.to_thread(self._ready.wait)
        await self._host.serve(socket)

    def reset_cameras(self) -> None:
        """Show the whole scene in every tab."""
        if self._ready.is_set():
            self._view.reset_cameras()

    @property
    def server(self) -> "viser.ViserServer":
        """The viser server, once it runs."""
        self._ready.wait()
        return self._host.server

    def drawn_clouds(self) -> "dict[str, viser.PointCloudHandle]":
        """Handles of the clouds drawn so far, by name."""
        self._ready.wait()
        return self._view.clouds()

    def stop(self) -> None:
        """End the connections and viser's threads, if they ever started."""
        if self._ready.is_set():
            self._host.stop()

    def _start(self) -> None:
        # Imports viser, which takes half a second that the page need not wait for.
        from app.viewer.pointer import listen_to_pointer
        from app.viewer.scene import SceneView

        self._host = ViserHost()
        self._view = SceneView(self._host.server, self._session.picture)
        listen_to_pointer(self._host.server, on_click=self._pick_at, on_box=self._select_in)
        self._ready.set()
        self._session.listen(self._view.update)
        self._view.update()

    def _pick_at(self, origin: Floats, direction: Floats, *, pixel: float) -> None:
        changes = changes_at(self._session.picture(), origin, direction, pixel=pixel)
        if changes:
            self._session.change(changes)

    def _select_in(self, camera: Camera, low: tuple[float, float], high: tuple[float, float]) -> None:
        self._session.change(changes_in(self._session.picture(), camera, low, high))

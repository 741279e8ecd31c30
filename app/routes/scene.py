"""The 3D scene: its page, its connection, its cameras."""

from typing import Protocol

from fastapi import APIRouter, WebSocket
from fastapi.responses import HTMLResponse

from app.routes.problems import NO_STORE


class Scene(Protocol):
    """The 3D part, as far as the routes know it."""

    def page(self) -> str:
        """The page of the scene, for the frame in ours."""

    async def serve(self, socket: WebSocket) -> None:
        """Talk to one browser until it goes away; the socket is not accepted yet."""

    def reset_cameras(self) -> None:
        """Show the whole scene in every tab."""


def router(scene: Scene) -> APIRouter:
    """Paths of the scene."""
    router = APIRouter(tags=["scene"])

    @router.get("/viewer/", include_in_schema=False)
    def viewer() -> HTMLResponse:
        return HTMLResponse(scene.page(), headers=NO_STORE)

    @router.websocket("/viewer")
    async def viewer_socket(socket: WebSocket) -> None:
        await scene.serve(socket)

    @router.post("/api/camera/reset", status_code=204)
    def reset_camera() -> None:
        """Show the whole scene in every tab."""
        scene.reset_cameras()

    return router

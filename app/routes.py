"""The page, the typed API under it, and the door to the 3D scene; everything behind the guard."""

import asyncio
import json
from collections.abc import AsyncIterator
from dataclasses import asdict
from pathlib import Path
from typing import Literal, Protocol

from fastapi import FastAPI, HTTPException, Request, Response, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles

from app.schemas import Problem, SettingsPatch
from app.session import Session
from app.snapshot import Snapshot

KEEP_ALIVE_S = 15.0
_NO_STORE = {"Cache-Control": "no-store"}
_DESCRIPTION = "State and controls of one run of cgf-viewer. Paths are relative to the URL with the token."


class Scene(Protocol):
    """The 3D part, as far as the routes know it."""

    def page(self) -> str:
        """The page of the scene, for the frame in ours."""

    async def serve(self, socket: WebSocket) -> None:
        """Talk to one browser until it goes away; the socket is not accepted yet."""

    def reset_cameras(self) -> None:
        """Show the whole scene in every tab."""


def static_folder() -> Path:
    """Where the page lies: beside the package in a checkout, inside it once installed."""
    here = Path(__file__).resolve().parent
    installed = here / "static"
    return installed if installed.is_dir() else here.parent / "static"


def create_app(session: Session, scene: Scene) -> FastAPI:
    """The application for one session and its scene."""
    # Swagger's own page would load scripts from another site; /api/docs is ours and loads nothing.
    app = FastAPI(
        title="cgf-viewer", description=_DESCRIPTION, openapi_url="/api/openapi.json", docs_url=None, redoc_url=None
    )
    static = static_folder()
    app.mount("/static", StaticFiles(directory=static), name="static")
    _add_pages(app, static, scene)
    _add_api(app, session, scene)
    _add_problems(app)
    return app


def _add_pages(app: FastAPI, static: Path, scene: Scene) -> None:
    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(static / "index.html", headers=_NO_STORE)

    @app.get("/api/docs", include_in_schema=False)
    def docs() -> FileResponse:
        return FileResponse(static / "api.html", headers=_NO_STORE)

    @app.get("/viewer/", include_in_schema=False)
    def viewer() -> HTMLResponse:
        return HTMLResponse(scene.page(), headers=_NO_STORE)

    @app.websocket("/viewer")
    async def viewer_socket(socket: WebSocket) -> None:
        await scene.serve(socket)


def _add_api(app: FastAPI, session: Session, scene: Scene) -> None:
    problem: dict[int | str, dict[str, object]] = {422: {"model": Problem, "description": "Cannot be done; says why"}}

    @app.get("/api/state", tags=["state"])
    def state() -> Snapshot:
        """Everything the page shows."""
        return session.snapshot()

    @app.patch("/api/settings", tags=["state"], responses=problem)
    def change_settings(patch: SettingsPatch) -> Snapshot:
        """Change some settings. On 422 nothing has changed."""
        return session.change(patch.changes())

    @app.post("/api/cancel", tags=["state"], status_code=204)
    def cancel() -> None:
        """Stop the running computation; what is shown stays."""
        session.cancel()

    @app.post("/api/camera/reset", tags=["scene"], status_code=204)
    def reset_camera() -> None:
        """Show the whole scene in every tab."""
        scene.reset_cameras()

    @app.get("/api/matches.{suffix}", tags=["results"], responses=problem, response_class=Response)
    def matches(suffix: Literal["csv", "npz"]) -> Response:
        """The matches that pass the filters, the same to the last digit as `cgf match` writes them."""
        content = session.export(f".{suffix}")
        media_type = "text/csv; charset=utf-8" if suffix == "csv" else "application/octet-stream"
        disposition = f'attachment; filename="matches.{suffix}"'
        return Response(content, media_type=media_type, headers={"Content-Disposition": disposition, **_NO_STORE})

    @app.get("/api/events", tags=["state"], response_class=StreamingResponse)
    async def events() -> StreamingResponse:
        """Server-sent events: `state` with a whole state, or `status` where nothing but its status changed."""
        return StreamingResponse(_events(session), media_type="text/event-stream", headers=_NO_STORE)


async def _events(session: Session) -> AsyncIterator[str]:
    loop = asyncio.get_running_loop()
    changed = asyncio.Event()

    def on_change() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(changed.set)

    forget = session.listen(on_change)
    sent_revision = -1
    try:
        while True:
            changed.clear()
            snapshot = session.snapshot()
            if snapshot.revision != sent_revision:
                sent_revision = snapshot.revision
                yield _event("state", asdict(snapshot))
            else:
                yield _event("status", asdict(snapshot.status))
            # A comment now and then keeps proxies and SSH tunnels from closing an idle connection.
            while not await _set_within(changed, KEEP_ALIVE_S):
                yield ": still here\n\n"
    finally:
        forget()


async def _set_within(event: asyncio.Event, timeout_s: float) -> bool:
    try:
        await asyncio.wait_for(event.wait(), timeout_s)
    except asyncio.TimeoutError:
        return False
    return True


def _event(name: str, data: object) -> str:
    return f"event: {name}\ndata: {json.dumps(data, allow_nan=False)}\n\n"


def _add_problems(app: FastAPI) -> None:
    @app.exception_handler(ValueError)
    async def unusable(_: Request, error: Exception) -> JSONResponse:
        return JSONResponse(Problem(message=str(error)).model_dump(), status_code=422)

    @app.exception_handler(RequestValidationError)
    async def malformed(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return JSONResponse(Problem(message=_readable(error)).model_dump(), status_code=422)

    @app.exception_handler(HTTPException)
    async def refused(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        return JSONResponse(Problem(message=str(error.detail)).model_dump(), status_code=error.status_code)


def _readable(error: RequestValidationError) -> str:
    """The first of the errors that pydantic found, in one line."""
    first = error.errors()[0]
    names = [part for part in first["loc"] if isinstance(part, str) and part not in ("body", "path", "query")]
    where = names[0].replace("_", " ").capitalize() if names else "The request"
    message = str(first["msg"]).replace("Input should", "should").replace("Extra inputs are", "is")
    return f"{where} {message}." if message[:1].islower() else f"{where}: {message}."

"""The files of the page that have an address of their own."""

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse

from app.routes.problems import NO_STORE


def router(static: Path) -> APIRouter:
    """Paths of the pages in the folder `static`."""
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    def page() -> FileResponse:
        return FileResponse(static / "index.html", headers=NO_STORE)

    @router.get("/api/docs")
    def docs() -> FileResponse:
        return FileResponse(static / "api.html", headers=NO_STORE)

    return router

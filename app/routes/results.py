"""Results as files."""

from typing import Literal

from fastapi import APIRouter, Response

from app.routes.problems import NO_STORE, PROBLEM
from app.session import Session


def router(session: Session) -> APIRouter:
    """Paths of what can be saved."""
    router = APIRouter(tags=["results"], responses=PROBLEM)

    @router.get("/api/matches.{suffix}", response_class=Response)
    def matches(suffix: Literal["csv", "npz"]) -> Response:
        """The matches that pass the filters, the same to the last digit as `cgf match` writes them."""
        content = session.export(f".{suffix}")
        media_type = "text/csv; charset=utf-8" if suffix == "csv" else "application/octet-stream"
        disposition = f'attachment; filename="matches.{suffix}"'
        return Response(content, media_type=media_type, headers={"Content-Disposition": disposition, **NO_STORE})

    return router

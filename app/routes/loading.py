"""Opening other clouds while the viewer runs."""

from pathlib import Path

from fastapi import APIRouter, Request

from app.loading import Loader, PairPaths
from app.routes.problems import PROBLEM
from app.schemas import OpenRequest, Uploaded
from app.snapshot import Snapshot


def router(loader: Loader) -> APIRouter:
    """Paths of what opens pairs."""
    router = APIRouter(tags=["pairs"])

    @router.get("/api/recent")
    def recent() -> list[PairPaths]:
        """The pairs that were opened last."""
        return loader.recent()

    @router.post("/api/open", responses=PROBLEM)
    def open_pair(wanted: OpenRequest) -> Snapshot:
        """Read two clouds on the viewer's machine and show them. On 422 nothing has changed."""
        source, target, gt = (
            None if not path else Path(path).expanduser() for path in (wanted.source, wanted.target, wanted.gt)
        )
        assert source is not None
        assert target is not None
        return loader.open(PairPaths(source, target, gt), drop_invalid=wanted.drop_invalid)

    @router.put("/api/uploads/{name}", responses=PROBLEM)
    async def upload(name: str, request: Request) -> Uploaded:
        """Keep a file until the viewer ends, for `open`; its content is the request's body."""
        return Uploaded(path=str(await loader.receive(name, request.stream())))

    return router

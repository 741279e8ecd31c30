"""The picked point, and going through the matches one by one."""

from fastapi import APIRouter

from app.point import PointDetails
from app.routes.problems import PROBLEM
from app.schemas import Step
from app.session import Session
from app.snapshot import Snapshot
from cgf.checks import InputError


def router(session: Session) -> APIRouter:
    """Paths of one point."""
    router = APIRouter(tags=["point"], responses=PROBLEM)

    @router.get("/api/point")
    def point() -> PointDetails | None:
        """The point picked by `PATCH /api/settings`, its candidates in the other cloud, and their histograms.

        Nothing where none is picked, or its matches are being computed: a page that has not heard of it yet may ask.
        """
        try:
            return session.point()
        except InputError:
            return None

    @router.post("/api/step")
    def step(step: Step) -> Snapshot:
        """Pick and isolate the next or the one before among the matches, in the order of `step_order`."""
        return session.step(step.by)

    return router

"""What is wrong with the pair."""

from typing import Any

from fastapi import APIRouter

from app.routes.problems import PROBLEM
from app.session import Session


def router(session: Session) -> APIRouter:
    """Paths of the diagnosis."""
    router = APIRouter(tags=["diagnosis"], responses=PROBLEM)

    @router.get("/api/diagnosis")
    def diagnosis() -> dict[str, Any]:
        """Verdict and findings with their evidence, as `cgf diagnose --json` prints them."""
        return session.diagnosing.plain()

    return router

"""Results as files."""

import json
from typing import Literal

from fastapi import APIRouter, Response

from app.match_file import matches_file
from app.pose_file import place_beside, pose_text, save_beside
from app.report import report_page, results_of
from app.routes.problems import NO_STORE, PROBLEM
from app.schemas import PosePlace, SaveRequest
from app.session import Session


def router(session: Session) -> APIRouter:
    """Paths of what can be saved."""
    router = APIRouter(tags=["results"], responses=PROBLEM)

    @router.get("/api/matches.{suffix}", response_class=Response)
    def matches(suffix: Literal["csv", "npz"]) -> Response:
        """The matches that pass the filters, the same to the last digit as `cgf match` writes them."""
        return _file(matches_file(session, f".{suffix}"), f"matches.{suffix}")

    @router.get("/api/results.json", response_class=Response)
    def results() -> Response:
        """Settings, figures and poses."""
        return _file(json.dumps(results_of(session), indent=1, allow_nan=False).encode(), "results.json")

    @router.get("/api/report.html", response_class=Response)
    def report() -> Response:
        """One HTML file with the scene, its legend and all figures, which opens without this server."""
        return _file(report_page(session).encode(), "report.html")

    @router.get("/api/estimate.txt", response_class=Response)
    def estimate() -> Response:
        """The estimated pose, source to target, as four rows of four numbers."""
        return _file(pose_text(session), "pose.txt")

    @router.get("/api/estimate/place")
    def estimate_place() -> PosePlace:
        """Where the estimate would be saved beside the source's file."""
        path = place_beside(session)
        return PosePlace(path=str(path), exists=path.exists())

    @router.post("/api/estimate/save")
    def save_estimate(wanted: SaveRequest) -> PosePlace:
        """Save the estimate beside the source's file."""
        return PosePlace(path=str(save_beside(session, overwrite=wanted.overwrite)), exists=True)

    return router


def _file(content: bytes, name: str) -> Response:
    """An answer that the browser saves; it is never shown as a page of ours."""
    kinds = {"csv": "text/csv; charset=utf-8", "json": "application/json", "txt": "text/plain; charset=utf-8"}
    return Response(
        content,
        media_type=kinds.get(name.rpartition(".")[2], "application/octet-stream"),
        headers={"Content-Disposition": f'attachment; filename="{name}"', **NO_STORE},
    )

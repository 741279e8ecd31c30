"""What panels ask for beside the state: poses, plots, and work in the background."""

from fastapi import APIRouter

from app.plots import Plots, SweepName
from app.poses import PoseRow
from app.routes.problems import PROBLEM
from app.schemas import EstimateChoice, RunRequest
from app.session import Session
from app.tasks import TaskKind


def router(session: Session) -> APIRouter:
    """Paths of the panels for poses, plots and comparison."""
    router = APIRouter(tags=["workbench"], responses=PROBLEM)
    workbench = session.workbench

    @router.get("/api/poses")
    def poses() -> tuple[PoseRow, ...]:
        """How good every known pose is, those found by runs included."""
        return workbench.poses()

    @router.post("/api/poses/runs", status_code=202)
    def run(request: RunRequest) -> None:
        """Look for the pose in the background; a run that is under way is stopped."""
        workbench.run(request.settings(), request.start)

    @router.post("/api/poses/estimate", status_code=204)
    def choose_estimate(choice: EstimateChoice) -> None:
        """Let a run stand for the estimate."""
        workbench.choose_estimate(choice.name)

    @router.get("/api/plots")
    def plots() -> Plots:
        """How errors and feature distances are spread, and the precision over dimension and radius as far as known."""
        return workbench.plots()

    @router.post("/api/sweeps/{name}", status_code=202)
    def sweep(name: SweepName) -> None:
        """Compute the precision over dimension or radius in the background."""
        workbench.sweep(name)

    @router.delete("/api/tasks/{kind}", status_code=204)
    def cancel(kind: TaskKind) -> None:
        """Stop work in the background; what it has found stays."""
        workbench.tasks.cancel(kind)

    return router

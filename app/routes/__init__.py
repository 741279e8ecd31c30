"""The page, the typed API under it, and the door to the 3D scene; everything behind the guard.

One module a topic, each with a function `router` that gives its paths.
"""

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles

from app.loading import Loader
from app.routes import diagnosis, loading, pages, point, results, scene, state, workbench
from app.routes.problems import add_problems
from app.session import Session
from app.static_files import static_folder

_DESCRIPTION = "State and controls of one run of cgf-viewer. Paths are relative to the URL with the token."


def create_app(session: Session, shown: scene.Scene, loader: Loader) -> FastAPI:
    """The application for one session, its scene, and what opens more pairs in it."""
    # Swagger's own page would load scripts from another site; /api/docs is ours and loads nothing.
    app = FastAPI(
        title="cgf-viewer", description=_DESCRIPTION, openapi_url="/api/openapi.json", docs_url=None, redoc_url=None
    )
    static = static_folder()
    app.mount("/static", StaticFiles(directory=static), name="static")
    app.include_router(pages.router(static))
    app.include_router(scene.router(shown))
    app.include_router(state.router(session))
    app.include_router(results.router(session))
    app.include_router(diagnosis.router(session))
    app.include_router(workbench.router(session))
    app.include_router(point.router(session))
    app.include_router(loading.router(loader))
    add_problems(app)
    return app

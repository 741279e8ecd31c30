"""What all routes share: errors as one line for the person, and answers that are not to be kept."""

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse

from app.schemas import Problem, in_words

NO_STORE = {"Cache-Control": "no-store"}
PROBLEM: dict[int | str, dict[str, object]] = {422: {"model": Problem, "description": "Cannot be done; says why"}}


def add_problems(app: FastAPI) -> None:
    """Answer what cannot be done with a `Problem`."""

    @app.exception_handler(ValueError)
    async def unusable(_: Request, error: Exception) -> JSONResponse:
        return JSONResponse(Problem(message=str(error)).model_dump(), status_code=422)

    @app.exception_handler(RequestValidationError)
    async def malformed(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return JSONResponse(Problem(message=in_words(error.errors())).model_dump(), status_code=422)

    @app.exception_handler(HTTPException)
    async def refused(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        return JSONResponse(Problem(message=str(error.detail)).model_dump(), status_code=error.status_code)

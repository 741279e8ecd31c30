"""The state of the page: read, changed, and told of while it changes."""

import asyncio
import json
from collections.abc import AsyncGenerator
from dataclasses import asdict

from fastapi import APIRouter
from fastapi.responses import StreamingResponse

from app.routes.problems import NO_STORE, PROBLEM
from app.schemas import SettingsPatch, SharedState
from app.session import Session
from app.snapshot import Snapshot
from app.state_text import read_state, restored

KEEP_ALIVE_S = 15.0
STATUS_INTERVAL_S = 1.0
"""From one event to the next that tells of progress only: each has the browser paint the page, scene included, which
without a graphics card takes processors from the computation itself."""


def router(session: Session) -> APIRouter:
    """Paths of the state."""
    router = APIRouter(tags=["state"])

    @router.get("/api/state")
    def state() -> Snapshot:
        """Everything the page shows."""
        return session.snapshot()

    @router.patch("/api/settings", responses=PROBLEM)
    def change_settings(patch: SettingsPatch) -> Snapshot:
        """Change some settings. On 422 nothing has changed."""
        return session.change(patch.changes())

    @router.put("/api/state", responses=PROBLEM)
    def restore(state: SharedState) -> Snapshot:
        """Take over the settings of a link or of `--state`; those it does not name go back to their defaults."""
        return session.change(restored(read_state(state.text)))

    @router.post("/api/cancel", status_code=204)
    def cancel() -> None:
        """Stop the running computation; what is shown stays."""
        session.cancel()

    @router.get("/api/events", response_class=StreamingResponse)
    async def events() -> StreamingResponse:
        """Server-sent events: `state` with a whole state, or `status` where nothing but its status changed."""
        return StreamingResponse(events_of(session), media_type="text/event-stream", headers=NO_STORE)

    return router


async def events_of(session: Session) -> AsyncGenerator[str, None]:
    """The events of `session` as they are sent: a new state at once, what only tells of progress now and then."""
    loop = asyncio.get_running_loop()
    changed = asyncio.Event()

    def on_change() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(changed.set)

    forget = session.listen(on_change)
    sent_revision, sent_at = -1, 0.0
    try:
        while True:
            changed.clear()
            snapshot = session.snapshot()
            if snapshot.revision != sent_revision:
                sent_revision = snapshot.revision
                yield _event("state", asdict(snapshot))
            elif (wait_s := sent_at + STATUS_INTERVAL_S - loop.time()) > 0:
                await _set_within(changed, wait_s)
                continue
            else:
                yield _event("status", asdict(snapshot.status))
            sent_at = loop.time()
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
    # The path of own weights is the only value that is no plain one.
    return f"event: {name}\ndata: {json.dumps(data, allow_nan=False, default=str)}\n\n"

"""Calls an application as a server would, with whatever headers a test likes."""

import asyncio
import json
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote

from starlette.types import ASGIApp, Message, Scope

OWN_HOST = "127.0.0.1:8750"
OWN_ORIGIN = f"http://{OWN_HOST}"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    def json(self) -> Any:
        return json.loads(self.body)


def request(
    app: ASGIApp, method: str, path: str, *, headers: dict[str, str] | None = None, body: bytes = b""
) -> Answer:
    """One request to its end."""
    sent = _converse(app, _scope("http", path, headers, method=method), [{"type": "http.request", "body": body}])
    start = sent[0]
    content = b"".join(message.get("body", b"") for message in sent[1:])
    return Answer(start["status"], {name.decode(): value.decode() for name, value in start["headers"]}, content)


def websocket(
    app: ASGIApp, path: str, *, headers: dict[str, str] | None = None, texts: tuple[str, ...] = ()
) -> list[Message]:
    """Everything the application sends on a WebSocket that gets `texts` and then closes."""
    messages: list[Message] = [{"type": "websocket.connect"}]
    messages += [{"type": "websocket.receive", "text": text} for text in texts]
    return _converse(
        app, _scope("websocket", path, headers), [*messages, {"type": "websocket.disconnect", "code": 1000}]
    )


def _scope(kind: str, path: str, headers: dict[str, str] | None, *, method: str = "GET") -> Scope:
    path, _, query = path.partition("?")
    all_headers = {"host": OWN_HOST, **{name.lower(): value for name, value in (headers or {}).items()}}
    scope: Scope = {
        "type": kind,
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "scheme": "http" if kind == "http" else "ws",
        "path": unquote(path),
        "raw_path": path.encode(),
        "query_string": query.encode(),
        "root_path": "",
        "headers": [(name.encode(), value.encode()) for name, value in all_headers.items()],
        "client": ("127.0.0.1", 50000),
        "server": ("127.0.0.1", 8750),
    }
    return {**scope, "method": method} if kind == "http" else {**scope, "subprotocols": []}


def _converse(app: ASGIApp, scope: Scope, messages: list[Message]) -> list[Message]:
    async def run() -> list[Message]:
        sent: list[Message] = []
        waiting = list(messages)
        ended = asyncio.Event()

        async def receive() -> Message:
            if waiting:
                return waiting.pop(0)
            await ended.wait()
            return {"type": "http.disconnect"}

        async def send(message: Message) -> None:
            sent.append(message)

        await app(scope, receive, send)
        ended.set()
        return sent

    return asyncio.run(run())

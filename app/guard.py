"""Who may talk to the viewer: checks on every request and WebSocket before the application sees it.

A page of another site that the user's browser has open can reach 127.0.0.1 too. It does not know the token in the
path, and it cannot give our own host and origin, so all three are asked for.
"""

import hmac
import ipaddress
import secrets
from collections.abc import Iterable
from http import HTTPStatus
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
_WILDCARDS = ("0.0.0.0", "::")
_SAFE_METHODS = ("GET", "HEAD", "OPTIONS")

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
VIEWER_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; connect-src 'self' data: blob:; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""The 3D client is one file with its scripts inside, which start workers from blobs and WebAssembly."""


def new_token() -> str:
    """A token nobody can guess, safe in a URL."""
    return secrets.token_urlsafe(24)


def host_name(netloc: str) -> str:
    """The name in `name`, `name:port`, `[v6]` or `[v6]:port`, in lower case; empty where it is malformed."""
    try:
        return urlsplit(f"//{netloc}").hostname or ""
    except ValueError:
        return ""


class Guard:
    """Wraps an application so that it is reached only with the token, by our own names and from our own pages."""

    def __init__(self, app: ASGIApp, *, token: str, hosts: Iterable[str]) -> None:
        self._app = app
        self._token = token.encode()
        names = {name.lower() for name in hosts}
        self._any_address = not names.isdisjoint(_WILDCARDS)
        self._names = names.union(LOOPBACK_NAMES)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await _refuse(scope, receive, send, refusal)
            return
        prefix = f"/{self._token.decode()}"
        inner = dict(scope)
        inner["root_path"] = scope.get("root_path", "") + prefix
        await self._app(inner, receive, _with_headers(send, viewer="/viewer" in scope["path"]))

    def _refusal(self, scope: Scope) -> tuple[HTTPStatus, str] | None:
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        host = hosts[0] if len(hosts) == 1 else ""
        if not self._is_own_host(host):
            return HTTPStatus.MISDIRECTED_REQUEST, "This viewer does not answer to that host name."
        token = scope["path"].split("/", 2)[1] if scope["path"].startswith("/") else ""
        if not hmac.compare_digest(token.encode(), self._token):
            return HTTPStatus.FORBIDDEN, "The token is missing or wrong: open the whole URL that cgf-viewer printed."
        needs_origin = scope["type"] == "websocket"
        changes_state = scope["type"] == "http" and scope["method"] not in _SAFE_METHODS
        if (needs_origin and not origins) or not all(_is_same_origin(origin, host) for origin in origins):
            return HTTPStatus.FORBIDDEN, "Only this viewer's own page may do that."
        if changes_state and headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return HTTPStatus.FORBIDDEN, "Only this viewer's own page may do that."
        return None

    def _is_own_host(self, netloc: str) -> bool:
        # Any port: through an SSH tunnel the browser's port is another than ours. A name is what DNS rebinding abuses;
        # an address cannot be rebound, so one that listens on all addresses answers to each of them.
        name = host_name(netloc)
        if name in self._names:
            return True
        return self._any_address and _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_same_origin(origin: str, host: str) -> bool:
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


async def _refuse(scope: Scope, receive: Receive, send: Send, refusal: tuple[HTTPStatus, str]) -> None:
    if scope["type"] == "websocket":
        # Closing before accepting is answered with 403: no byte of the socket is exchanged.
        await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
        return
    response = PlainTextResponse(refusal[1] + "\n", status_code=refusal[0], headers=_security_headers(viewer=False))
    await response(scope, receive, send)


def _security_headers(*, viewer: bool) -> dict[str, str]:
    return {
        "Content-Security-Policy": VIEWER_POLICY if viewer else PAGE_POLICY,
        "X-Content-Type-Options": "nosniff",
        # The token is in the path, so no other site may see our address.
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "X-Frame-Options": "SAMEORIGIN",
    }


def _with_headers(send: Send, *, viewer: bool) -> Send:
    extra = [(name.lower().encode(), value.encode()) for name, value in _security_headers(viewer=viewer).items()]

    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", ()), *extra]}
        await send(message)

    return wrapped

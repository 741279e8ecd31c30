"""Viser in this process without a port of its own: its connections come through our guarded endpoint."""

import asyncio
import contextlib
import importlib.util
import threading
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

Handler = Callable[[Any], Awaitable[None]]

_NEEDED = ("ViewerCameraMessage",)
"""What a browser may tell viser; answers to renders asked for by us are added by viser for the time of the request.
Clicks are not among them: `app.viewer.pointer` checks them in viser's place."""

_LATE = "Queued a .* on a closed connection"

# What viser's own panel, notices and palette would show is on our page, with labels and without covering the scene.
_CLIENT_HEAD = """<style>
  /* Named twice, to weigh more than viser's own choice. */
  :root:root { color-scheme: light dark; }
  :root:root[data-theme="light"] { color-scheme: light; }
  :root:root[data-theme="dark"] { color-scheme: dark; }
  html, body { background: light-dark(#d3dae3, #2a323e); }
  canvas[data-engine] { background: radial-gradient(ellipse at 50% 42%,
    light-dark(#eef1f4, #465062) 0%, light-dark(#dde3ea, #343d4b) 55%, light-dark(#cdd5df, #29313d) 100%); }
  .mantine-Paper-root, .mantine-Notifications-root, .mantine-Modal-root { display: none !important; }
</style>
<script src="../static/viewer.js"></script>"""


def client_page() -> str:
    """Viser's page for the browser, one file, with its own panels hidden."""
    spec = importlib.util.find_spec("viser")
    assert spec is not None
    assert spec.origin is not None
    page = (Path(spec.origin).parent / "client" / "build" / "index.html").read_text(encoding="utf-8")
    head_end = page.index("</head>")
    return page[:head_end] + _CLIENT_HEAD + page[head_end:]


class ViserHost:
    """A viser server whose WebSocket connections are handed to it by `serve`, never accepted by itself."""

    def __init__(self) -> None:
        import viser
        import websockets.asyncio.server

        captured: list[Handler] = []

        @contextlib.asynccontextmanager
        async def no_socket(handler: Handler, *_: object, **__: object) -> AsyncIterator[object]:
            captured.append(handler)
            yield SimpleNamespace(server=SimpleNamespace(sockets=[]))

        # Viser 1.1.1 offers no way to run without listening, so what it would listen with is replaced meanwhile.
        listen = websockets.asyncio.server.serve
        with _quiet():
            websockets.asyncio.server.serve = no_socket  # type: ignore[assignment,misc]
            try:
                self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
            finally:
                websockets.asyncio.server.serve = listen  # type: ignore[misc]
        self._handler = captured[0]
        # A tab may close at any moment, also between finding it and telling it something.
        warnings.filterwarnings("ignore", message=_LATE, category=UserWarning)
        # Let no browser reach what we do not use: the public tunnel, uploads, changes of viser's own controls.
        _drop_handlers(self.server._websock_server)
        self.server._websock_server.on_client_connect(lambda connection: _drop_handlers(connection, keep=_NEEDED))
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        # Points and lines are not lit, and loading the map costs the first picture time.
        self.server.scene.configure_environment_map(None)
        self.server.scene.configure_default_lights(enabled=False)

    async def serve(self, socket: WebSocket) -> None:
        """Run viser's side of one browser's connection until either side ends it.

        Args:
            socket: Not accepted yet; its host, token and origin are checked already.
        """
        wanted = [name for name in socket.scope.get("subprotocols", ()) if name.startswith("viser-v")]
        if not wanted:
            await socket.close(code=1002)
            return
        await socket.accept(subprotocol=wanted[0])
        loop = self.server.get_event_loop()
        adapter = _Connection(socket, subprotocol=wanted[0], own_loop=loop, app_loop=asyncio.get_running_loop())
        running = asyncio.run_coroutine_threadsafe(_run(self._handler, adapter), loop)
        ended = asyncio.ensure_future(asyncio.wrap_future(running))
        reading = asyncio.ensure_future(adapter.read_all())
        try:
            await asyncio.wait((ended, reading), return_when=asyncio.FIRST_COMPLETED)
        finally:
            reading.cancel()
            adapter.feed(None)
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                # Raises RuntimeError where the other side has closed already.
                await socket.close()

    def stop(self) -> None:
        """End the connections and viser's thread."""
        with _quiet():
            self.server.stop()


def _drop_handlers(endpoint: Any, *, keep: tuple[str, ...] = ()) -> None:
    for message in tuple(endpoint._incoming_handlers):
        if message.__name__ not in keep:
            endpoint.unregister_handler(message)


async def _run(handler: Handler, connection: "_Connection") -> None:
    try:
        await handler(connection)
    except Exception:  # noqa: BLE001 - the edge of viser: a malformed message ends its connection and nothing else
        await connection.close(1003, "malformed message")


class _Connection:
    """The part of websockets' `ServerConnection` that viser uses, over a socket of another event loop."""

    def __init__(
        self,
        socket: WebSocket,
        *,
        subprotocol: str,
        own_loop: asyncio.AbstractEventLoop,
        app_loop: asyncio.AbstractEventLoop,
    ) -> None:
        self.subprotocol = subprotocol
        self._socket = socket
        self._own_loop = own_loop
        self._app_loop = app_loop
        self._received: asyncio.Queue[bytes | None] = asyncio.Queue()

    def feed(self, message: bytes | None) -> None:
        """Hand a message to viser; None means that no more come. Called in the application's loop."""
        with contextlib.suppress(RuntimeError):
            # Raised where viser's loop has stopped before its last connection.
            self._own_loop.call_soon_threadsafe(self._received.put_nowait, message)

    async def read_all(self) -> None:
        """Feed what the browser sends until it goes away. Runs in the application's loop."""
        with contextlib.suppress(WebSocketDisconnect, KeyError):
            # KeyError: a text message, which viser's client never sends.
            while True:
                self.feed(await self._socket.receive_bytes())
        self.feed(None)

    async def recv(self) -> bytes:
        message = await self._received.get()
        if message is None:
            raise _closed()
        return message

    async def send(self, message: bytes) -> None:
        await self._in_app_loop(self._socket.send_bytes(message))

    async def close(self, code: int = 1000, reason: str = "") -> None:
        with contextlib.suppress(Exception):
            await self._in_app_loop(self._socket.close(code=code, reason=reason))

    async def _in_app_loop(self, call: Any) -> None:
        try:
            await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(call, self._app_loop))
        except (WebSocketDisconnect, RuntimeError) as error:
            raise _closed() from error


def _closed() -> Exception:
    from websockets.exceptions import ConnectionClosedOK

    return ConnectionClosedOK(None, None)


_console_lock = threading.Lock()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep viser's banner and goodbye, which it prints through rich's shared console, off the terminal."""
    import rich

    with _console_lock:
        console = rich.get_console()
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before

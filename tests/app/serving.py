"""A real server on a free port, for tests that need sockets or a browser."""

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import uvicorn

from app.guard import Guard, new_token
from app.loading import Loader, Recent
from app.main import make_server
from app.ports import listen_socket
from app.routes import create_app
from app.session import Session
from app.viewer.live import LiveScene
from tests.app.scenes import LONG_S


@dataclass(frozen=True)
class Served:
    """Where a running viewer is."""

    session: Session
    scene: LiveScene
    host: str
    token: str

    @property
    def origin(self) -> str:
        return f"http://{self.host}"

    @property
    def url(self) -> str:
        return f"{self.origin}/{self.token}/"

    @property
    def socket_url(self) -> str:
        return f"ws://{self.host}/{self.token}/viewer"


@contextlib.contextmanager
def serve(session: Session) -> Iterator[Served]:
    """Serve `session` as the command does, until the block ends."""
    listening, _ = listen_socket("127.0.0.1", 0)
    token = new_token()
    scene = LiveScene(session)
    loader = Loader(session, Recent(None))
    app = Guard(create_app(session, scene, loader), token=token, hosts=["127.0.0.1"])
    server: uvicorn.Server = make_server(app, debug=False)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    session.start()
    try:
        yield Served(session, scene, f"127.0.0.1:{listening.getsockname()[1]}", token)
    finally:
        server.force_exit = server.should_exit = True
        thread.join(LONG_S)
        session.close()
        scene.stop()
        loader.close()
        listening.close()

"""The whole server on a real port: viser behind the guard, events, and nothing beside them."""

import contextlib
import json
import queue
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from socket import create_connection
from typing import Any
from urllib.parse import urlsplit

import pytest
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from app.session import Session
from app.settings import ViewSettings
from app.snapshot import Snapshot
from tests.app.scenes import LONG_S, hills, source_of
from tests.app.serving import Served, serve

PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    session = Session([source_of(hills())], ViewSettings(support_radius=0.8))
    with serve(session) as served:
        assert session.wait_until_idle(LONG_S)
        yield served


def open_scene(
    served: Served, *, host: str | None = None, **changes: Any
) -> contextlib.AbstractContextManager[ClientConnection]:
    """Connect as the page does; `host` is what the request calls the server."""
    arguments = {"origin": served.origin, "subprotocols": [PROTOCOL], "max_size": None, "proxy": None, **changes}
    address = urlsplit(served.socket_url)
    if host is not None:
        arguments["sock"] = create_connection((address.hostname, address.port))
    return connect(address._replace(netloc=host or address.netloc).geturl(), **arguments)


def join(served: Served, socket: ClientConnection) -> viser.ClientHandle:
    """Send what makes viser count the connection as a client, and wait until it does."""
    known = set(served.scene.server.get_clients())
    joined: queue.Queue[viser.ClientHandle] = queue.Queue()
    served.scene.server.on_client_connect(joined.put)
    socket.send(camera_message())
    while True:
        client = joined.get(timeout=LONG_S)
        if client.client_id not in known:
            return client


def drain(socket: ClientConnection) -> None:
    """Receive until the connection ends, which raises."""
    while True:
        socket.recv(LONG_S)


def camera_message() -> bytes:
    message = _messages.ViewerCameraMessage(
        wxyz=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 5.0), fov=0.7, near=0.01, far=1000.0, image_height=600,
        image_width=900, look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 1.0, 0.0),
    )  # fmt: skip
    return serialized(message)


def serialized(message: _messages.Message) -> bytes:
    import msgspec

    return msgspec.msgpack.encode(message.as_serializable_dict([]))


def test_the_scene_arrives_through_our_own_port(served: Served) -> None:
    with open_scene(served) as socket:
        assert socket.subprotocol == PROTOCOL
        received = b""
        while b"/target" not in received or b"/matches" not in received:
            # Names of nodes are compressed in the first part; the arrays that follow them are not.
            message = socket.recv(LONG_S)
            assert isinstance(message, bytes)
            received += _decompressed(message)


def _decompressed(message: bytes) -> bytes:
    import zstandard

    size = int.from_bytes(message[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(message[16 : 16 + size])


def received_until(served: Served, socket: ClientConnection, marker: str) -> list[bytes]:
    """All messages up to one that is sent last."""
    served.scene.server.scene.add_frame(marker, visible=False)
    served.scene.server.flush()
    messages = []
    while True:
        message = socket.recv(LONG_S)
        assert isinstance(message, bytes)
        messages.append(message)
        if marker.encode() in _decompressed(message):
            return messages


def test_positions_are_sent_once_and_a_change_sends_colours_alone(served: Served) -> None:
    session = served.session
    session.change({"line_count": 0})
    assert session.wait_until_idle(LONG_S)
    with open_scene(served) as socket:
        first = [_decompressed(message) for message in received_until(served, socket, "/first")]
        # Both clouds, and the one that keeps their shader.
        assert sum(message.count(b"PointCloudMessage") for message in first) == 3
        picture = session.picture()
        assert picture is not None
        points = len(picture.source.points) + len(picture.target.points)
        changes = ({"coloring": "features"}, {"coloring": "original"}, {"coloring": "error", "dim": 8},
                   {"mutual": True}, {"support_radius": 0.9}, {"voxel_size": 0.15})  # fmt: skip
        for number, change in enumerate(changes):
            session.change(change)
            assert session.wait_until_idle(LONG_S)
            messages = received_until(served, socket, f"/marker{number}")
            texts = b"".join(map(_decompressed, messages))
            assert b"PointCloudMessage" not in texts, change
            updates = texts.count(b"SceneNodeUpdateMessage")
            assert updates > 0, change
            # Three bytes a point and a little around them; positions have twelve.
            assert sum(map(len, messages)) < 3 * points * updates / 2 + 1_000 * len(messages), change
    defaults = ViewSettings(support_radius=0.8)
    session.change({name: getattr(defaults, name) for name in defaults.__dataclass_fields__})
    assert session.wait_until_idle(LONG_S)


@pytest.mark.parametrize(
    "changes",
    [{"origin": "http://evil.example"}, {"origin": None}, {"host": "evil.example"}],
    ids=["foreign origin", "no origin", "foreign host"],
)
def test_another_sites_page_cannot_open_the_scene(served: Served, changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidStatus) as refusal, open_scene(served, **changes):
        pass
    assert refusal.value.response.status_code == 403


def test_the_scene_cannot_be_opened_without_the_token(served: Served) -> None:
    with pytest.raises(InvalidStatus), connect(f"ws://{served.host}/viewer", origin=served.origin, proxy=None):
        pass


def test_a_client_of_another_protocol_is_turned_away(served: Served) -> None:
    with pytest.raises((InvalidStatus, ConnectionClosed)), open_scene(served, subprotocols=["chat"]) as socket:
        socket.recv(LONG_S)


@pytest.mark.parametrize("garbage", [b"\xc1\xc1\xc1", b"", "text", b"\x81\xa4type\xa7NoSuch!"], ids=repr)
def test_a_malformed_message_ends_its_own_connection_only(served: Served, garbage: bytes | str) -> None:
    with open_scene(served) as healthy:
        with open_scene(served) as broken:
            broken.send(garbage)
            with pytest.raises(ConnectionClosed):
                drain(broken)
        assert isinstance(healthy.recv(LONG_S), bytes)
        assert join(served, healthy)


def test_the_share_tunnel_and_uploads_have_no_handler(served: Served) -> None:
    # Clicks are checked by us; see below.
    handlers = served.scene.server._websock_server._incoming_handlers
    assert [(message.__name__, [handler.__module__ for handler in found]) for message, found in handlers.items()] == [
        ("ScenePointerMessage", ["app.viewer.pointer"])
    ]
    with open_scene(served) as socket:
        client = join(served, socket)
        socket.send(serialized(_messages.ShareUrlRequest()))
        socket.send(serialized(_messages.FileTransferStartUpload(
            source_component_uuid="x", transfer_uuid="y", filename="../../evil.ply", mime_type="", part_count=1,
            size_bytes=1,
        )))  # fmt: skip
        handlers = client._websock_connection._incoming_handlers
        assert {message.__name__ for message in handlers} == {"ViewerCameraMessage"}
        moved = threading.Event()
        client.camera.on_update(lambda _: moved.set())
        socket.send(camera_message())
        assert moved.wait(LONG_S)
    assert served.scene.server._share_tunnel is None


def click(origin: Any, direction: Any, **changes: Any) -> bytes:
    """A click as a browser sends it, or with what no browser would send."""
    import msgspec

    message = _messages.ScenePointerMessage(
        event_type="click", ray_origin=None, ray_direction=None, screen_pos=((0.5, 0.5),), modifier=None
    )
    fields = message.as_serializable_dict([])
    return msgspec.msgpack.encode({**fields, "ray_origin": origin, "ray_direction": direction, **changes})


def wait_for(served: Served, wanted: Callable[[Snapshot], bool]) -> Snapshot:
    """The state once it is as wanted."""
    changed = threading.Event()
    forget = served.session.listen(changed.set)
    try:
        while not wanted(snapshot := served.session.snapshot()):
            assert changed.wait(LONG_S)
            changed.clear()
    finally:
        forget()
    return snapshot


def test_a_click_in_the_scene_picks_the_point_under_it(served: Served) -> None:
    picture = served.session.picture()
    assert picture is not None
    place = picture.target.points[100] + picture.target.position
    eye = place + 8 * picture.view.direction
    with open_scene(served) as socket:
        join(served, socket)
        socket.send(click(tuple(eye.tolist()), tuple((place - eye).tolist())))
        snapshot = wait_for(served, lambda state: state.settings.picked is not None)
        assert snapshot.settings.picked is not None
        assert snapshot.settings.picked.side == "target"
        assert "picked" in {name.strip("/").split("/")[0] for name in served.scene.server.scene._handle_from_node_name}
        # A click beside all points picks nothing any more.
        socket.send(click(tuple(eye.tolist()), tuple((eye - place).tolist())))
        wait_for(served, lambda state: state.settings.picked is None)


@pytest.mark.parametrize(
    "message",
    [
        click(None, None),
        click((0.0, 0.0, 5.0), (0.0, 0.0, 0.0)),
        click((float("nan"), 0.0, 5.0), (0.0, 0.0, -1.0)),
        click((1e30, 0.0, 5.0), (0.0, 0.0, -1.0)),
        click("up", {"x": 1}),
        click((0.0, 0.0, 5.0), (0.0, 0.0, -1.0), event_type="double-click"),
        click(None, None, event_type="rect-select", screen_pos=()),
        click(None, None, event_type="rect-select", screen_pos=((0.1, 0.2),)),
        click(None, None, event_type="rect-select", screen_pos=((float("inf"), 0.0), (0.0, 0.0))),
    ],
    ids=range(9),
)
def test_a_click_that_makes_no_sense_changes_nothing(served: Served, message: bytes) -> None:
    before = served.session.revision
    with open_scene(served) as socket:
        client = join(served, socket)
        socket.send(message)
        # The connection lives on: what is sent next still arrives.
        moved = threading.Event()
        client.camera.on_update(lambda _: moved.set())
        socket.send(camera_message())
        assert moved.wait(LONG_S)
    assert served.session.revision == before


def test_a_client_that_leaves_is_forgotten(served: Served) -> None:
    left: queue.Queue[int] = queue.Queue()
    served.scene.server.on_client_disconnect(lambda client: left.put(client.client_id))
    with open_scene(served) as socket:
        client = join(served, socket)
    while left.get(timeout=LONG_S) != client.client_id:
        pass
    assert client.client_id not in served.scene.server.get_clients()


def test_viser_listens_on_no_port_of_its_own(served: Served) -> None:
    own = Path("/proc/self/net/tcp")
    if not own.exists():
        pytest.skip("needs Linux to list this process's sockets")
    inodes = {link.readlink().name for link in Path("/proc/self/fd").iterdir() if link.is_symlink()}
    listening = [
        fields[1]
        for fields in (line.split() for line in own.read_text().splitlines()[1:])
        if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes
    ]
    port = int(served.host.rpartition(":")[2])
    assert listening == [f"0100007F:{port:04X}"]


def fetch(url: str, **headers: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=LONG_S) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


@pytest.mark.parametrize("path", ["", "api/state", "viewer/", "static/app.js", "api/openapi.json"])
def test_pages_are_served_with_the_token_and_only_with_it(served: Served, path: str) -> None:
    assert fetch(served.url + path)[0] == 200
    assert fetch(f"{served.origin}/{path}")[0] == 403
    assert fetch(served.url + path, Host="evil.example")[0] == 421


@pytest.mark.parametrize(
    "path", ["static/../../app/main.py", "static/%2e%2e/%2e%2e/etc/passwd", "..%2f..%2fetc%2fpasswd"]
)
def test_no_path_leads_outside(served: Served, path: str) -> None:
    assert fetch(served.url + path)[0] in (403, 404)


def test_events_tell_every_tab_of_a_change(served: Served) -> None:
    with urllib.request.urlopen(served.url + "api/events", timeout=LONG_S) as stream:
        assert next_state(stream)["settings"]["line_count"] == 300
        served.session.change({"line_count": 11})
        assert next_state(stream)["settings"]["line_count"] == 11
    served.session.change({"line_count": 300})


def next_state(stream: Any) -> dict[str, Any]:
    for line in stream:
        if line.startswith(b"event: state"):
            data = next(stream)
            state: dict[str, Any] = json.loads(data.removeprefix(b"data: "))
            return state
    raise AssertionError("the stream has ended")


def test_a_picture_reaches_viser_with_exact_colours(served: Served) -> None:
    picture = served.session.picture()
    assert picture is not None
    drawn = served.scene.drawn_clouds()
    assert (drawn["source"].colors == picture.source.colors).all()
    assert (drawn["source"].points == picture.source.points).all()
    served.session.change({"coloring": "features"})
    recoloured = served.session.picture()
    assert recoloured is not None
    assert (served.scene.drawn_clouds()["source"].colors == recoloured.source.colors).all()
    assert served.scene.drawn_clouds()["source"] is drawn["source"]
    served.session.change({"coloring": "error"})

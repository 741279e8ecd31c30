"""What another site's page, or a program without the token, gets to see: nothing."""

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.types import Message
from starlette.websockets import WebSocket

from app.guard import Guard, host_name, new_token
from tests.app.asgi import OWN_ORIGIN, Answer, request, websocket

TOKEN = "a-token-for-tests"


def hello(request: Request) -> PlainTextResponse:
    return PlainTextResponse(f"hello from {request.url.path}")


async def echo(socket: WebSocket) -> None:
    await socket.accept()
    await socket.send_text(await socket.receive_text())
    await socket.close()


ROUTES = [
    Route("/", hello),
    Route("/api/state", hello, methods=["GET", "POST", "PATCH", "DELETE"]),
    Route("/viewer/", hello),
    WebSocketRoute("/viewer", echo),
]


def guarded(*hosts: str) -> Guard:
    return Guard(Starlette(routes=ROUTES), token=TOKEN, hosts=hosts or ("127.0.0.1",))


def get(path: str, *, method: str = "GET", hosts: tuple[str, ...] = (), **headers: str) -> Answer:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return request(guarded(*hosts), method, path, headers=named)


def connect(path: str, headers: dict[str, str]) -> list[Message]:
    return websocket(guarded(), path, headers=headers, texts=("hello",))


def test_the_token_opens_the_application() -> None:
    response = get(f"/{TOKEN}/api/state")
    assert response.text == f"hello from /{TOKEN}/api/state"


@pytest.mark.parametrize(
    "path", ["/", "/api/state", "/wrong/api/state", f"/{TOKEN}x/", f"/{TOKEN[:-1]}/", "//", "/%2e%2e/", f"/x/{TOKEN}/"]
)
def test_without_the_token_nothing_is_served(path: str) -> None:
    response = get(path)
    assert response.status == 403
    assert "open the whole URL" in response.text


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example:8750", "localhost.evil.example", "", "[", "10.0.0.5"]
)
def test_other_host_names_are_refused(host: str) -> None:
    assert get(f"/{TOKEN}/", host=host).status == 421


@pytest.mark.parametrize("host", ["127.0.0.1:8750", "localhost:9000", "LOCALHOST", "[::1]:8750"])
def test_names_of_this_machine_are_accepted_on_any_port(host: str) -> None:
    assert get(f"/{TOKEN}/", host=host).status == 200


def test_one_that_listens_on_all_addresses_answers_to_addresses_but_not_to_names() -> None:
    everywhere = ("0.0.0.0",)
    assert get(f"/{TOKEN}/", hosts=everywhere, host="10.0.0.5:8750").status == 200
    assert get(f"/{TOKEN}/", hosts=everywhere, host="rebound.example:8750").status == 421


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:9999", "null", "file://", "http://["])
@pytest.mark.parametrize("method", ["GET", "POST", "PATCH", "DELETE"])
def test_requests_of_other_origins_are_refused(method: str, origin: str) -> None:
    assert get(f"/{TOKEN}/api/state", method=method, origin=origin).status == 403


def test_requests_of_our_own_page_are_accepted() -> None:
    assert get(f"/{TOKEN}/api/state", method="PATCH", origin=OWN_ORIGIN).status == 200


def test_a_change_sent_across_sites_without_origin_is_refused() -> None:
    assert get(f"/{TOKEN}/api/state", method="POST", sec_fetch_site="cross-site").status == 403


def test_a_websocket_of_our_own_page_is_accepted() -> None:
    sent = connect(f"/{TOKEN}/viewer", {"Origin": OWN_ORIGIN})
    assert [message["type"] for message in sent] == ["websocket.accept", "websocket.send", "websocket.close"]
    assert sent[1]["text"] == "hello"


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        (f"/{TOKEN}/viewer", {"Origin": "http://evil.example"}),
        (f"/{TOKEN}/viewer", {}),
        (f"/{TOKEN}/viewer", {"Origin": OWN_ORIGIN, "Host": "evil.example"}),
        ("/viewer", {"Origin": OWN_ORIGIN}),
        ("/wrong/viewer", {"Origin": OWN_ORIGIN}),
    ],
    ids=["foreign origin", "no origin", "foreign host", "no token", "wrong token"],
)
def test_a_websocket_is_refused_before_it_is_accepted(path: str, headers: dict[str, str]) -> None:
    (sent,) = connect(path, headers)
    assert sent["type"] == "websocket.close"
    assert sent["code"] == 1008


def test_every_answer_keeps_other_sites_out() -> None:
    for path in (f"/{TOKEN}/", "/wrong/"):
        headers = get(path).headers
        assert "frame-ancestors 'self'" in headers["content-security-policy"]
        assert "'unsafe-inline'" not in headers["content-security-policy"]
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-content-type-options"] == "nosniff"


def test_only_the_scene_may_run_its_inline_script() -> None:
    policy = get(f"/{TOKEN}/viewer/").headers["content-security-policy"]
    assert "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:" in policy
    assert "'unsafe-eval'" not in policy.replace("'wasm-unsafe-eval'", "")
    assert "frame-ancestors 'self'" in policy


def test_tokens_are_long_and_differ() -> None:
    tokens = {new_token() for _ in range(100)}
    assert len(tokens) == 100
    assert min(map(len, tokens)) >= 32


@pytest.mark.parametrize(
    ("netloc", "name"),
    [
        ("a.example:80", "a.example"),
        ("[::1]:8750", "::1"),
        ("A.Example", "a.example"),
        ("[", ""),
        ("user@host", "host"),
    ],
)
def test_host_names_are_read_without_port(netloc: str, name: str) -> None:
    assert host_name(netloc) == name

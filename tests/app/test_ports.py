import socket
from collections.abc import Iterator

import pytest

from app import ports
from cgf.checks import InputError


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


def test_a_port_in_use_is_named_with_the_remedy(taken: int) -> None:
    with pytest.raises(InputError, match=rf"^port {taken} is in use; choose another with --port"):
        ports.listen_socket("127.0.0.1", taken)


def test_without_a_wish_the_next_free_port_is_taken_and_said(taken: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "DEFAULT_PORT", taken)
    listening, note = ports.listen_socket("127.0.0.1", None)
    with listening:
        port = listening.getsockname()[1]
    assert taken < port < taken + 50
    assert note == f"Port {taken} is in use; took {port} instead."


def test_only_this_machine_is_reached_by_default() -> None:
    listening, note = ports.listen_socket("127.0.0.1", 0)
    with listening:
        assert listening.getsockname()[0] == "127.0.0.1"
    assert note == ""


@pytest.mark.parametrize("port", [-1, 65_536])
def test_a_port_out_of_range_is_refused(port: int) -> None:
    with pytest.raises(InputError, match=rf"^--port must be from 0 to 65535, got {port}$"):
        ports.listen_socket("127.0.0.1", port)


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(InputError, match=r"^--host must be an address of this machine, got 192\.0\.2\.1"):
        ports.listen_socket("192.0.2.1", 0)


def test_a_host_that_cannot_be_resolved_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"^--host must name this machine, got no such host, which cannot be resolved$"
    ):
        ports.listen_socket("no such host", 0)

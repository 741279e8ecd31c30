"""The one port the viewer listens on, taken before anything else is started."""

import errno
import socket

from cgf.checks import InputError

DEFAULT_PORT = 8750
_TRIED = 50
_LARGEST = 65_535


def listen_socket(host: str, port: int | None) -> tuple[socket.socket, str]:
    """Listen on `port`, or on the first free one from the default on where None was asked for.

    Args:
        host: Address or name of this machine to listen on.
        port: 0 takes any free port.

    Returns:
        The listening socket, and a line for the person where it is not the usual port.

    Raises:
        InputError: The port is taken or out of range, or the host is not this machine.
    """
    if port is not None:
        if not 0 <= port <= _LARGEST:
            raise InputError(f"--port must be from 0 to {_LARGEST}, got {port}")
        return _bind(host, port), ""
    for candidate in range(DEFAULT_PORT, DEFAULT_PORT + _TRIED):
        try:
            listening = _bind(host, candidate)
        except PortInUseError:
            continue
        note = f"Port {DEFAULT_PORT} is in use; took {candidate} instead." if candidate != DEFAULT_PORT else ""
        return listening, note
    raise InputError(f"ports {DEFAULT_PORT} to {DEFAULT_PORT + _TRIED - 1} are all in use; choose another with --port")


class PortInUseError(InputError):
    """Another program listens there."""


def _bind(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise InputError(f"--host must name this machine, got {host}, which cannot be resolved") from error
    listening = socket.socket(family, kind, protocol)
    try:
        # A port whose last connections have not timed out yet may be taken again; one that is listened on may not.
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        listening.close()
        if error.errno == errno.EADDRINUSE:
            raise PortInUseError(
                f"port {port} is in use; choose another with --port, or stop the program that has it"
            ) from error
        if error.errno == errno.EACCES:
            raise InputError(f"--port must be one this user may open, got {port}; take one above 1023") from error
        raise InputError(f"--host must be an address of this machine, got {host} ({error.strerror})") from error
    return listening

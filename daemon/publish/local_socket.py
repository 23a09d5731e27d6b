"""Unix sockets that the daemon serves: binding with the right permissions, and removal of a dead program's file."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from hal.errors import DeviceRefused


class Client(Protocol):
    """One connection."""

    def drop(self) -> None:
        """Close it at once."""


@contextmanager
def listening(what: str, path: Path, mode: int, backlog: int) -> Iterator[socket.socket]:
    """A listening socket at a path, whose folder is created; the file of a dead program is removed first.

    The file is removed at the end.

    Args:
        what: name of the service, for errors.
        path: of the socket.
        mode: permissions of the socket file, in force before the first client can connect.
        backlog: clients that may wait to be accepted.

    Raises:
        DeviceRefused: another program serves it, or it cannot be made.
    """
    try:
        sock = _bound(what, path, mode, backlog)
    except OSError as error:
        problem = error.strerror or str(error)
        remedy = "free the path, or give write access to its folder"
        raise DeviceRefused(f"{what} {path}", problem, remedy) from None
    with sock:
        try:
            yield sock
        finally:
            path.unlink(missing_ok=True)


async def serve(
    sock: socket.socket, backlog: int, made: Callable[[], asyncio.BaseProtocol], clients: Iterable[Client]
) -> None:
    """Serve a listening socket until cancelled, then close all connections."""
    server = await asyncio.get_running_loop().create_unix_server(made, sock=sock, backlog=backlog)
    try:
        await asyncio.Event().wait()
    finally:
        server.close()
        for client in list(clients):
            client.drop()


def _bound(what: str, path: Path, mode: int, backlog: int) -> socket.socket:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_socket():
        if _alive(path):
            raise DeviceRefused(f"{what} {path}", "another program serves it", "stop that program")
        path.unlink()
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    try:
        sock.bind(str(path))
        path.chmod(mode)
        sock.listen(backlog)
    except OSError:
        sock.close()
        raise
    return sock


def _alive(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as sock:
        return sock.connect_ex(str(path)) in (0, errno.EAGAIN)  # EAGAIN: a program listens, and its queue is full

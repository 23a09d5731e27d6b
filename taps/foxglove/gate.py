"""Gate before Foxglove's server: checks Host and Origin of each connection, then passes its bytes on.

The library's server checks neither, so that any web page in a browser of this computer could read the stream. It
therefore listens on a loopback address and port that are random and unknown to web pages, and clients connect here.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Sequence
from typing import Final

from daemon.system.defects import Place, log_once
from hal.net.peers import full_for
from taps.access_guard import Guard

CLIENTS: Final = 16
PATIENCE_S: Final = 5.0
"""Time for the head of a request, s."""
LONGEST_HEAD: Final = 8192
APPS: Final = ("https://app.foxglove.dev", "file://")
"""Origins of Foxglove's web app, and of apps that are installed on a computer."""
_PIECE: Final = 64 << 10

log = logging.getLogger(__name__)


def random_loopback() -> str:
    """A loopback address that nobody can guess."""
    return "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))


class Refused(Exception):
    """A connection that is not passed on, with the status and text of the response."""

    def __init__(self, status: str, text: str) -> None:
        super().__init__(text)
        self.status = status


def check(head: bytes, guard: Guard, origins: Sequence[str]) -> None:
    """Check the head of a request, by its Host, and by its Origin: that of the guard, or one of ``origins``.

    Raises:
        Refused: no request of HTTP, one under a name that is not this computer's, or one from another web page.
    """
    first, *lines = head.decode("latin-1").split("\r\n")
    if not first.startswith("GET ") or " HTTP/1." not in first:
        raise Refused("400 Bad Request", "not an HTTP/1 request")
    fields = [line.partition(":") for line in lines if line]
    hosts = [value.strip() for name, _, value in fields if name.lower() == "host"]
    named = [value.strip() for name, _, value in fields if name.lower() == "origin"]
    if any(not name or name != name.strip() for name, _, _ in fields) or len(hosts) != 1 or len(named) > 1:
        raise Refused("400 Bad Request", "the request needs one Host and at most one Origin")
    if not guard.host_ok(hosts[0]):
        raise Refused("421 Misdirected Request", "the request names another host; use this computer's address")
    if named and named[0].lower() not in origins and not guard.origin_ok(named[0], hosts[0]):
        raise Refused("403 Forbidden", f"pages of {named[0][:100]} have no access; --origin permits it")


class Gate:
    """Passes checked connections on to a server.

    Args:
        guard, origins: see :func:`check`. to: host and port of the server.
    """

    def __init__(self, guard: Guard, origins: Sequence[str], to: tuple[str, int]) -> None:
        self._guard, self._origins, self._to = guard, [origin.lower() for origin in (*APPS, *origins)], to
        self._peers: list[str] = []
        self._defects: set[Place] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def close(self) -> None:
        """Close all connections."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection until either end closes it."""
        peer = str((writer.get_extra_info("peername") or ("",))[0])
        full = len(self._peers) >= CLIENTS or full_for(peer, self._peers, CLIENTS)
        self._peers.append(peer)
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            if not full:
                await self._pass(reader, writer)
        except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            pass
        except Exception as error:  # noqa: BLE001  any failure ends this connection alone
            log_once(log, self._defects, error, "serving a connection has failed; it is closed")
        finally:
            self._peers.remove(peer)
            self._tasks.discard(task)
            writer.close()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(PATIENCE_S):
            head = await reader.readuntil(b"\r\n\r\n")
        try:
            check(head, self._guard, self._origins)
        except Refused as error:
            content = f"{error}\n".encode(errors="replace")
            lines = (f"HTTP/1.1 {error.status}", "Content-Type: text/plain", f"Content-Length: {len(content)}")
            writer.write("\r\n".join((*lines, "Connection: close", "", "")).encode() + content)
            await writer.drain()
            return
        server, to_server = await asyncio.open_connection(*self._to)
        try:
            to_server.write(head)
            ways = [asyncio.create_task(_copy(reader, to_server)), asyncio.create_task(_copy(server, writer))]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            to_server.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Pass bytes on until the end; a slow receiver slows the sender."""
    with contextlib.suppress(OSError):
        while data := await reader.read(_PIECE):
            writer.write(data)
            await writer.drain()

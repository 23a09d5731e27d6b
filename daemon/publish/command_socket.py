"""Local command socket: one request and one reply a connection, for `lumiloop set-pose` and the like.

Only the daemon's user and group may connect. Whoever may is limited nevertheless: in size and time of a request, in
connections, and in the loop's time.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final

from daemon.publish.command_messages import LONGEST_REQUEST, BadRequest, reply_line, request_of
from daemon.publish.commands import OnEnd
from daemon.publish.local_socket import listening, serve
from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from daemon.snapshot import GUESSED, Snapshot
from hal.net.fair_share import Share

log = logging.getLogger(__name__)

SOURCE: Final = "local socket"
MODE: Final = 0o660
"""Permissions of the socket file: the daemon's user and group."""
CLIENTS: Final = 8
"""Largest number of connections; beyond it the oldest one is closed. Its command stays in force."""
REQUEST_S: Final = 5.0
"""Time limit of a request, s."""
ANSWER_S: Final = 600.0
"""Longest wait for the end of a command, s; then the reply is ``running``."""

Handle = Callable[[Request, OnEnd, str], None]


class CommandSocket:
    """Serves the socket at a path.

    Attributes:
        clients: connected ones, oldest first. latest: snapshot, whose state and pose a reply contains.
        share: of the loop's time.

    Args:
        path: of the socket; its folder is created. handle: carries out a request.
    """

    def __init__(self, path: Path, handle: Handle) -> None:
        self.path, self.handle = path, handle
        self.clients: dict[Client, None] = {}
        self.latest: Snapshot | None = None
        self.share = Share()

    def publish(self, snapshot: Snapshot) -> None:
        """Sink of the cycle: keep the latest snapshot, and answer the clients whose search has ended."""
        self.latest = snapshot
        if snapshot.state not in GUESSED:
            for client in [client for client in self.clients if client.searching]:
                client.answer(Outcome.DONE, "")

    async def run(self) -> None:
        """Serve until cancelled; raises `DeviceRefused` where another program serves it, or it cannot be made."""
        with listening("command socket", self.path, MODE, CLIENTS) as sock:
            await serve(sock, CLIENTS, lambda: Client(self), self.clients)

    def admit(self, client: Client) -> None:
        """Accept a connection; the oldest one makes room for it."""
        if len(self.clients) >= CLIENTS:
            oldest = next(iter(self.clients))
            oldest.answer(Outcome.RUNNING, "a newer client has replaced this connection")
            self.clients.pop(oldest, None)
        self.clients[client] = None


class Client(asyncio.Protocol):
    """One connection; ``searching``: its command is carried out once the place of the robot is known."""

    def __init__(self, server: CommandSocket) -> None:
        self.searching = False
        self._server = server
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._received = bytearray()
        self._asked = False
        self._command = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: a client has connected."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._server.admit(self)
        self._wait(REQUEST_S, Outcome.REFUSED, f"no request arrived within {REQUEST_S:g} s")

    def connection_lost(self, exc: Exception | None) -> None:
        """asyncio: the client has gone, or this side has closed. A command that runs stays in force."""
        self._transport = None
        self._server.clients.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()

    def eof_received(self) -> bool:
        """asyncio: the client sends no more; it may wait for the reply, if there is a request."""
        return self._asked

    def data_received(self, data: bytes) -> None:
        """asyncio: bytes have arrived."""
        if self._transport is None:
            return
        if self._asked:  # more than a request costs no more of the loop's time
            self._transport.pause_reading()
            return
        self._received += data
        line, newline, _ = self._received.partition(b"\n")
        if len(line) > LONGEST_REQUEST:
            self.answer(Outcome.REFUSED, f"the request is longer than {LONGEST_REQUEST} bytes")
        elif newline:
            self._asked = True
            self._ask()

    def _ask(self) -> None:
        """Carry the request out, as soon as the loop's time permits."""
        share = self._server.share
        if self._transport is None:
            return
        if not share.begin():
            share.later(self._ask)
            return
        try:
            self._carry_out(bytes(self._received.partition(b"\n")[0]))
        finally:
            share.end()

    def _carry_out(self, line: bytes) -> None:
        try:
            request = request_of(line)
        except BadRequest as error:
            self.answer(Outcome.UNKNOWN, str(error))
            return
        self._command = request.code.name.lower()
        self._wait(ANSWER_S, Outcome.RUNNING, f"not finished after {ANSWER_S:g} s")
        self._server.handle(
            request, self._search_ended if request.code is CommandCode.RELOCALISE else self.answer, SOURCE
        )

    def _search_ended(self, outcome: Outcome, reason: str) -> None:
        """The search has begun; its end is the first snapshot whose state has a confirmed place."""
        latest = self._server.latest
        if outcome is Outcome.DONE and (latest is None or latest.state in GUESSED):
            self.searching = True
        else:
            self.answer(outcome, reason)

    def _wait(self, seconds: float, outcome: Outcome, reason: str) -> None:
        """Answer thus if nothing else does within that time."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(seconds, self.answer, outcome, reason)

    def answer(self, outcome: Outcome, reason: str) -> None:
        """Send the reply and close; nothing where the client has gone or has its reply."""
        transport, self._transport, self.searching = self._transport, None, False
        if transport is not None:
            if self._timer is not None:  # a client that does not read its reply is closed all the same
                self._timer.cancel()
            self._timer = asyncio.get_running_loop().call_later(REQUEST_S, transport.abort)
            transport.write(reply_line(self._command, outcome, reason, self._server.latest))
            transport.close()

    def drop(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

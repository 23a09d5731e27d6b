"""Modbus over TCP: connections, their share of each event loop iteration, and when they are closed."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from typing import Final

from daemon.publish.modbus.counts import CROWDED, GREEDY, MAX_CONNECTIONS, STRANGE, Allowed, Counts, everyone
from daemon.publish.modbus.requests import Responder, frame_size
from daemon.system.defects import Place, log_once
from hal.net.fair_share import Share
from hal.net.peers import full_for, host_of, largest

log = logging.getLogger(__name__)

TCP_WAITING_PER_TURN: Final = 16
IDLE_S: Final = 60.0  # without a complete request
PARTIAL_S: Final = 5.0  # a request that is not completed
STUCK_S: Final = 10.0  # replies that are not read
EVICT_S: Final = 5.0  # at the largest number of connections, the longest idle one beyond this is closed
_SWEEP_S: Final = 1.0
_WRITE_HIGH: Final = 16 * 1024
_READ_HIGH: Final = 16 * 1024


class Connection(asyncio.Protocol):
    """One TCP client."""

    def __init__(self, server: TcpEndpoint) -> None:
        self._server = server
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._buffer = bytearray()
        self._blocked_since: float | None = None
        self._heard = self._loop.time()
        self._ended = False
        self.last_request = self._loop.time()
        self.waiting = False
        self.peer = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: a client has connected."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=_WRITE_HIGH)
        peer = transport.get_extra_info("peername")
        self.peer = "" if peer is None else str(peer[0])
        if peer is not None and not self._server.allowed(peer[0]):
            transport.abort()
            return
        self._server.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """asyncio: the client has gone, or we have closed."""
        self._transport = None
        self._buffer.clear()
        self._server.forget(self)

    def data_received(self, data: bytes) -> None:
        """asyncio: bytes have arrived."""
        self._buffer += data
        self._heard = self._loop.time()
        share, transport = self._server.share, self._transport
        if share.begin():
            try:
                if not self.waiting and self.serve(1):
                    self._server.wait(self)
                elif len(self._buffer) > _READ_HIGH and transport is not None:
                    transport.pause_reading()
            finally:
                share.end()
        elif transport is not None:
            transport.pause_reading()
            if not self.waiting:
                self._server.wait(self)

    def eof_received(self) -> bool:
        """asyncio: the client sends no more; it receives the outstanding replies, then the connection closes."""
        self._ended = True
        if not self.waiting:
            self._server.wait(self)
        return True

    def pause_writing(self) -> None:
        """asyncio: replies accumulate unread."""
        self._blocked_since = self._loop.time()

    def resume_writing(self) -> None:
        """asyncio: replies are read again."""
        self._blocked_since = None
        if not self.waiting:
            self._server.wait(self)

    def serve(self, most: int) -> bool:
        """Serve up to `most` requests; return whether more can be served at once."""
        transport, size = self._transport, 0
        if transport is None or self._blocked_since is not None:
            return False
        answers: list[bytes] = []
        while len(answers) < most and 0 < (size := frame_size(self._buffer)) <= len(self._buffer):
            answers.append(self._server.responder.answer(bytes(self._buffer[:size])))
            del self._buffer[:size]
        if answers:
            self._server.counts.requests += len(answers)
            self.last_request = self._loop.time()
            transport.write(b"".join(answers))
        size = frame_size(self._buffer)
        more = 0 < size <= len(self._buffer)
        if size < 0 or (self._ended and not more):
            if size < 0:
                self._server.counts.malformed += 1
                self._server.counts.tell(self.peer, STRANGE)
            transport.close()
        elif len(self._buffer) <= _READ_HIGH and not transport.is_reading():
            transport.resume_reading()
        return more

    def overdue(self, now: float) -> bool:
        """Whether this client has exceeded one of the time limits."""
        if self._blocked_since is not None:
            return now - self._blocked_since > STUCK_S
        return now - self.last_request > IDLE_S or (bool(self._buffer) and now - self._heard > PARTIAL_S)

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()


class TcpEndpoint:
    """Serves listening sockets and distributes each loop iteration fairly among their connections."""

    def __init__(
        self, responder: Responder, counts: Counts, allowed: Allowed = everyone, share: Share | None = None
    ) -> None:
        self.allowed = allowed
        self.share = share or Share()
        self.responder = responder
        self.counts = counts
        self._loop = asyncio.get_running_loop()
        self._connections: dict[Connection, None] = {}
        self._waiting: deque[Connection] = deque()
        self._servers: list[asyncio.Server] = []
        self._defects: set[Place] = set()
        self._again: asyncio.TimerHandle | None = None
        self._sweeper = self._loop.call_later(_SWEEP_S, self._sweep)

    async def listen(self, sock: socket.socket) -> None:
        """Accept connections on a bound socket."""
        server = await self._loop.create_server(lambda: Connection(self), sock=sock, backlog=MAX_CONNECTIONS)
        self._servers.append(server)

    async def close(self) -> None:
        """Stop accepting and drop every connection."""
        self._sweeper.cancel()
        if self._again is not None:
            self._again.cancel()
        for server in self._servers:
            server.close()
        for connection in list(self._connections):
            connection.abort()
        for server in self._servers:
            await server.wait_closed()

    def admit(self, connection: Connection) -> None:
        """Accept a connection; where there is no place for it, close another one or refuse it."""
        peers = [one.peer for one in self._connections]
        greedy = full_for(connection.peer, peers, MAX_CONNECTIONS)
        if greedy or len(peers) >= MAX_CONNECTIONS:
            if (oldest := self._replaceable(connection, greedy)) is None:
                self.counts.refused += 1
                self.counts.tell(connection.peer, GREEDY if greedy else CROWDED)
                connection.abort()
                return
            self.counts.dropped += 1
            oldest.abort()
            self.forget(oldest)
        self._connections[connection] = None
        self.counts.connections = len(self._connections)

    def _replaceable(self, new: Connection, greedy: bool) -> Connection | None:
        """The connection that makes place for a new one.

        It is the longest idle one, if idle for :data:`EVICT_S`; that of the new one's host where this has its share.
        Otherwise it is one of the host with the most connections, if that host has more than the new one's.
        """
        own = [one for one in self._connections if host_of(one.peer) == host_of(new.peer)]
        oldest = min(own if greedy else self._connections, key=_idle_since)
        if self._loop.time() - oldest.last_request > EVICT_S:
            return oldest
        if greedy:
            return None
        most = largest(one.peer for one in self._connections)
        theirs = [one for one in self._connections if host_of(one.peer) == most]
        return min(theirs, key=_idle_since) if len(theirs) > len(own) + 1 else None

    def forget(self, connection: Connection) -> None:
        """Remove a closed connection."""
        self._connections.pop(connection, None)
        self.counts.connections = len(self._connections)

    def wait(self, connection: Connection) -> None:
        """Queue a connection that has more requests than one iteration permits."""
        connection.waiting = True
        self._waiting.append(connection)
        if len(self._waiting) == 1:
            self._loop.call_soon(self._serve_waiting)

    def _serve_waiting(self) -> None:
        """Serve waiting connections in round-robin order, each with its part of the iteration's share."""
        if not self.share.begin():
            self._again = self.share.later(self._serve_waiting)
            return
        self._again = None
        connections = min(len(self._waiting), TCP_WAITING_PER_TURN)
        for _ in range(connections):
            connection = self._waiting.popleft()
            connection.waiting = self._served(connection, TCP_WAITING_PER_TURN // connections)
            if connection.waiting:
                self._waiting.append(connection)
        if self._waiting:
            self._loop.call_soon(self._serve_waiting)
        self.share.end()

    def _served(self, connection: Connection, most: int) -> bool:
        """As :meth:`Connection.serve`; a connection that fails is closed, and the others are still served."""
        try:
            return connection.serve(most)
        except Exception as error:  # noqa: BLE001  any failure closes this connection alone
            log_once(log, self._defects, error, "serving a Modbus client has failed; the daemon disconnects it")
            connection.abort()
            return False

    def _sweep(self) -> None:
        now = self._loop.time()
        for connection in [c for c in self._connections if c.overdue(now)]:
            self.counts.dropped += 1
            connection.abort()
        self._sweeper = self._loop.call_later(_SWEEP_S, self._sweep)


def _idle_since(connection: Connection) -> float:
    return connection.last_request

"""Modbus server on UDP and TCP: transports of our own around :class:`daemon.publish.modbus.requests.Responder`.

* UDP: one datagram is one request. Nothing is kept between datagrams, so one client cannot disturb another.
* TCP: every request in a segment is answered, in order. A connection that sends what is not Modbus is closed.
* A turn of the event loop serves at most 64 requests (8 on each of two UDP sockets, one of each of at most 32
  connections, 16 of those that wait with more), so that no client, and no crowd of them, can delay the cycle.
* All of them together have half of the loop's time (:mod:`hal.net.fair_share`), however many ask how fast.
* Nothing waits for a client: an answer that the kernel does not take at once is dropped (UDP), and a connection whose
  answers are not read is left unserved, then closed (TCP).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from daemon.publish.modbus import registers
from daemon.publish.modbus.holding import Holding, Outcome, Request, WrittenOdometry
from daemon.publish.modbus.requests import BLOCKS, MAX_FRAME, Responder, frame_size
from daemon.snapshot import Snapshot, State
from daemon.system.logging import Sparing
from hal.clock import Clock
from hal.net import inet
from hal.net.fair_share import Reader, Share
from hal.net.inputs import Continuity
from hal.net.reply_address import ASKED_SPACE, Source, asked_at, send_from, tell_asked
from hal.net.rx_timestamp import STAMP_SPACE, kernel_age, stamp_arrivals
from hal.odometry import RawOdometry

UDP_PER_TURN: Final = 8
TCP_WAITING_PER_TURN: Final = 16
MAX_CONNECTIONS: Final = 32
IDLE_S: Final = 60.0  # without a whole request
PARTIAL_S: Final = 5.0  # a request that is not completed
STUCK_S: Final = 10.0  # answers that are not read
EVICT_S: Final = 5.0  # a full house drops the longest idle of those idle for longer
STRANGE: Final = "sends what is no Modbus request; it is dropped, and a connection closed"
CROWDED: Final = f"is not served: {MAX_CONNECTIONS} connections are open and in use, close one"
_SWEEP_S: Final = 1.0
_WRITE_HIGH: Final = 16 * 1024
_READ_HIGH: Final = 16 * 1024
_RECEIVE_BUFFER: Final = 256 * 1024

log = logging.getLogger(__name__)

Allowed = Callable[[str], bool]


def everyone(_: str) -> bool:
    """No host is turned away."""
    return True


@dataclass(slots=True)
class Counts:
    """What the server has seen; of whom it does not serve the log has a line a minute."""

    requests: int = 0
    malformed: int = 0
    unsent: int = 0
    connections: int = 0
    refused: int = 0
    dropped: int = 0
    lines: dict[str, Sparing] = field(default_factory=dict)

    def tell(self, peer: str, what: str) -> None:
        """Say of a client what becomes of it."""
        self.lines.setdefault(what, Sparing(log, 1, 60.0)).say(time.monotonic(), logging.INFO, f"Modbus: {peer} {what}")


class UdpEndpoint:
    """Serves one bound datagram socket."""

    def __init__(
        self,
        sock: socket.socket,
        responder: Responder,
        counts: Counts,
        allowed: Allowed = everyone,
        share: Share | None = None,
        on_age: Callable[[float], None] | None = None,
    ) -> None:
        """``on_age``: told before each request how long ago the kernel received it, and 0 after the last."""
        self._sock = sock
        self._on_age = on_age
        self._space = 0  # for what the kernel tells about a datagram
        if on_age is not None:
            stamp_arrivals(sock)
            self._space += STAMP_SPACE
        if tell_asked(sock):
            self._space += ASKED_SPACE
        self._allowed = allowed
        self._responder = responder
        self._counts = counts
        self._reader = Reader(sock.fileno(), self._serve, share or Share())

    def close(self) -> None:
        """Stop serving and close the socket."""
        self._reader.close()
        self._sock.close()

    def _serve(self) -> None:
        try:
            self._serve_some()
        finally:
            if self._on_age is not None:
                self._on_age(0.0)

    def _serve_some(self) -> None:
        for _ in range(UDP_PER_TURN):
            source: Source = ()
            try:
                if self._space:
                    frame, told, _, peer = self._sock.recvmsg(MAX_FRAME + 1, self._space)
                    source = asked_at(told)
                    if self._on_age is not None:
                        self._on_age(kernel_age(told))
                else:
                    frame, peer = self._sock.recvfrom(MAX_FRAME + 1)
            except OSError:  # nothing more, or the network's complaint about an earlier answer
                return
            if not self._allowed(peer[0]):
                continue
            if not frame or frame_size(frame) != len(frame):
                self._counts.malformed += 1
                self._counts.tell(peer[0], STRANGE)
                continue
            self._counts.requests += 1
            answer = self._responder.answer(frame)
            try:
                send_from(self._sock, answer, source, peer)
            except OSError:
                self._counts.unsent += 1


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
        """asyncio: the client sends no more; it gets the answers it is owed, then the connection closes."""
        self._ended = True
        if not self.waiting:
            self._server.wait(self)
        return True

    def pause_writing(self) -> None:
        """asyncio: answers pile up unread."""
        self._blocked_since = self._loop.time()

    def resume_writing(self) -> None:
        """asyncio: answers are read again."""
        self._blocked_since = None
        if not self.waiting:
            self._server.wait(self)

    def serve(self, most: int) -> bool:
        """Answer up to `most` requests; returns whether more can be answered at once."""
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
        """Whether this client has used up our patience."""
        if self._blocked_since is not None:
            return now - self._blocked_since > STUCK_S
        return now - self.last_request > IDLE_S or (bool(self._buffer) and now - self._heard > PARTIAL_S)

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()


class TcpEndpoint:
    """Serves listening sockets and shares each turn fairly among their connections."""

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
        """Take a new connection; a full house first drops its longest idle one, and else refuses the new one."""
        if len(self._connections) >= MAX_CONNECTIONS:
            oldest = min(self._connections, key=lambda c: c.last_request)
            if self._loop.time() - oldest.last_request <= EVICT_S:
                self.counts.refused += 1
                self.counts.tell(connection.peer, CROWDED)
                connection.abort()
                return
            self.counts.dropped += 1
            oldest.abort()
            self.forget(oldest)
        self._connections[connection] = None
        self.counts.connections = len(self._connections)

    def forget(self, connection: Connection) -> None:
        """A connection is gone."""
        self._connections.pop(connection, None)
        self.counts.connections = len(self._connections)

    def wait(self, connection: Connection) -> None:
        """Queue a connection that has more requests than its turn allows."""
        connection.waiting = True
        self._waiting.append(connection)
        if len(self._waiting) == 1:
            self._loop.call_soon(self._serve_waiting)

    def _serve_waiting(self) -> None:
        """Round robin, each its part of the turn's share."""
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
        """As :meth:`Connection.serve`; one that cannot be served is closed, and the others still have their turn."""
        try:
            return connection.serve(most)
        except Exception:
            log.exception("a Modbus client cannot be served; it is disconnected")
            connection.abort()
            return False

    def _sweep(self) -> None:
        now = self._loop.time()
        for connection in [c for c in self._connections if c.overdue(now)]:
            self.counts.dropped += 1
            connection.abort()
        self._sweeper = self._loop.call_later(_SWEEP_S, self._sweep)


def _ignore(_: object) -> None:
    """Nobody wants to know."""


class ModbusPublisher:
    """Shows the latest snapshot to Modbus clients on UDP and TCP.

    Args:
        clock: time of arrival of written odometry.
        write: whether commands and odometry may be written. allowed: whether a host may be answered.
        on_command: takes each command; tell its end by :meth:`acknowledge`.
        on_odometry: takes each written odometry reading. on_loop_seen: how many loops a client has seen.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        write: bool = False,
        allowed: Allowed = everyone,
        on_command: Callable[[Request], None] = _ignore,
        on_odometry: Callable[[RawOdometry], None] = _ignore,
        on_loop_seen: Callable[[int], None] = _ignore,
    ) -> None:
        self._clock = clock
        self._on_odometry = on_odometry
        self._allowed = allowed
        self._continuity = Continuity()
        self._holding = Holding(on_command, self._take_odometry, on_loop_seen) if write else None
        self._responder = Responder(self._holding)
        self._share = Share()
        self._age_s = 0.0  # of the datagram that is being answered
        self._udp: list[UdpEndpoint] = []
        self._tcp: TcpEndpoint | None = None
        self.counts = Counts()
        self.port = 0
        self.publish(Snapshot(seq=0, t_mono=0.0, t_sent=0.0, t_utc=0.0, state=State.STARTING, reason=0))

    def answer(self, body: bytes) -> bytes:
        """The answer to a function's body, for transports of another kind."""
        return self._responder.answer_body(body)

    async def start(self, bind: str, port: int) -> None:
        """Listen on UDP and TCP.

        Args:
            bind: name or address of this computer; empty: all of them.
            port: 0: any free one, told by :attr:`port`.

        Raises:
            DeviceRefused: port in use, or not permitted. DeviceMissing: no such address here.
        """
        self.port = 0
        addresses = await inet.resolve(bind, port, passive=True)
        self._tcp = TcpEndpoint(self._responder, self.counts, self._allowed, self._share)
        try:
            for address in addresses:
                await self._listen(self._tcp, address)
        except OSError as error:
            await self.close()
            raise inet.refusal(f"Modbus on {bind or '*'}:{port}", "modbus.port", port, error) from error

    async def _listen(self, tcp: TcpEndpoint, address: inet.Address) -> None:
        stream = inet.listening(inet.with_port(address, self.port or address[1][1]), socket.SOCK_STREAM)
        with contextlib.ExitStack() as undo:
            undo.callback(stream.close)
            self.port = int(stream.getsockname()[1])
            datagrams = inet.listening(inet.with_port(address, self.port), socket.SOCK_DGRAM)
            undo.callback(datagrams.close)
            datagrams.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            await tcp.listen(stream)
            on_age = None if self._holding is None else self._received_before
            self._udp.append(UdpEndpoint(datagrams, self._responder, self.counts, self._allowed, self._share, on_age))
            undo.pop_all()

    def publish(self, snapshot: Snapshot) -> None:
        """Show a snapshot from now on; never waits."""
        encoders = (registers.encode_mirror, *(block.encode for block in BLOCKS))
        self._responder.show(registers.encode_block(snapshot), *[partial(encode, snapshot) for encode in encoders])

    def acknowledge(self, number: int, outcome: Outcome) -> None:
        """Tell the client what became of its command."""
        if self._holding is not None:
            self._holding.acknowledge(number, outcome)

    async def close(self) -> None:
        """Close every socket and connection; idempotent."""
        udp, self._udp = self._udp, []
        tcp, self._tcp = self._tcp, None
        for endpoint in udp:
            endpoint.close()
        if tcp is not None:
            await tcp.close()

    def _received_before(self, age_s: float) -> None:
        self._age_s = age_s

    def _take_odometry(self, written: WrittenOdometry) -> None:
        t_rx = self._clock.now() - self._age_s
        if written.restarted:
            self._continuity.restart()
        x, y, yaw = self._continuity.follow(written.x, written.y, written.yaw)
        self._on_odometry(RawOdometry(t_rx=t_rx, t_mono=t_rx - written.age, x=x, y=y, yaw=yaw))

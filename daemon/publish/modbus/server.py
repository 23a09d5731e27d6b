"""Modbus server on UDP and TCP: own transports around :class:`daemon.publish.modbus.requests.Responder`.

* UDP: one datagram is one request. Nothing is stored between datagrams, so one client cannot disturb another.
* TCP: every request in a segment is served, in order. A connection that sends other data than Modbus is closed.
* An iteration of the event loop serves at most 64 requests, so that no number of clients can delay the cycle. These are
8 on each of two UDP sockets, one on each of at most 32 connections, and 16 from waiting connections.
* All of them together have half of the loop's time (:mod:`hal.net.fair_share`), at any number and rate of requests.
* Nothing waits for a client. A reply that the kernel does not accept at once is dropped (UDP). A connection whose
replies are not read is not served any more, then closed (TCP).
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from functools import partial
from typing import Final

from daemon.publish.modbus import registers
from daemon.publish.modbus.counts import Allowed, Counts, everyone
from daemon.publish.modbus.holding import Holding, Outcome, Request, WrittenOdometry
from daemon.publish.modbus.requests import BLOCKS, Responder
from daemon.publish.modbus.tcp_endpoint import TcpEndpoint
from daemon.publish.modbus.udp_endpoint import UdpEndpoint
from daemon.snapshot import Snapshot, State
from hal.clock import Clock
from hal.net import inet
from hal.net.fair_share import Share
from hal.net.inputs import Continuity
from hal.odometry import RawOdometry

_RECEIVE_BUFFER: Final = 256 * 1024


def _ignore(_: object) -> None:
    """Default callback that ignores its argument."""


class ModbusPublisher:
    """Serves the latest snapshot to Modbus clients on UDP and TCP.

    Args:
        clock: time of arrival of written odometry.
        name: of the robot. write: whether commands and odometry may be written.
        allowed: whether a host may be served.
        on_command: receives each command; report its end by :meth:`acknowledge`.
        on_odometry: receives each written odometry reading. on_loop_seen: number of acknowledged loop closures.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        name: str = "lumiloop",
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
        self._responder = Responder(self._holding, name)
        self._share = Share()
        self._age_s = 0.0  # of the datagram in processing
        self._udp: list[UdpEndpoint] = []
        self._tcp: TcpEndpoint | None = None
        self.counts = Counts()
        self.port = 0
        self.publish(Snapshot(seq=0, t_mono=0.0, t_sent=0.0, t_utc=0.0, state=State.STARTING, reason=0))

    def answer(self, body: bytes) -> bytes:
        """Reply to a function's body, for transports of another kind."""
        return self._responder.answer_body(body)

    async def start(self, bind: str, port: int) -> None:
        """Listen on UDP and TCP.

        Args:
            bind: name or address of this computer; empty: all of them.
            port: 0: any free one, available as :attr:`port`.

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
        """Serve this snapshot from now on; never waits."""
        encoders = (registers.encode_mirror, *(block.encode for block in BLOCKS))
        self._responder.show(registers.encode_block(snapshot), *[partial(encode, snapshot) for encode in encoders])

    def acknowledge(self, number: int, outcome: Outcome) -> None:
        """Report the outcome of a command to the client."""
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
        x, y, yaw = self._continuity.transform(written.x, written.y, written.yaw)
        self._on_odometry(RawOdometry(t_rx=t_rx, t_mono=t_rx - written.age, x=x, y=y, yaw=yaw))

"""Odometry and IMU over UDP: one socket that turns datagrams into readings.

Lost, repeated, reordered and damaged datagrams, a restarted sender and a second sender are distinguished and counted.
None of them makes the delivered pose jump. The codec is :mod:`hal.net.input_codec`.
"""

from __future__ import annotations

import asyncio
import logging
import math
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from hal.clock import Clock
from hal.errors import DataInvalid
from hal.imu import RawImu
from hal.net import inet
from hal.net.fair_share import Reader, Share
from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, SHARED_CLOCK, InputDatagram, decode
from hal.net.rx_timestamp import MAX_AGE_S, STAMP_SPACE, enable_rx_timestamps, kernel_age
from hal.net.sender_clock import SenderClock
from hal.odometry import RawOdometry

log = logging.getLogger(__name__)

SESSION_TIMEOUT_S: Final = 1.0  # a new sender is accepted after this silence of the current one
MAX_LEAD_S: Final = 0.001  # a reading cannot be from the future
ABSENT_S: Final = 60.0
"""A problem with datagrams is logged once, and again only after it has been absent for this long."""
_PER_TURN: Final = 16
_BUFFER: Final = 256


class Continuity:
    """Keeps a cumulative pose free of jumps when its sender restarts and counts from a new origin."""

    def __init__(self) -> None:
        self._last = (0.0, 0.0, 0.0)
        self._anchor = (0.0, 0.0, 0.0)  # T_ours_theirs
        self._restarted = False
        self._begun = False

    def restart(self) -> None:
        """The next pose counts from a new origin; the motion in between is unknown and is left out."""
        self._restarted = self._begun

    def transform(self, x: float, y: float, yaw: float) -> tuple[float, float, float]:
        """Transform the sender's pose (m, m, rad) into the frame of its first origin."""
        if self._restarted:
            turn = self._last[2] - yaw
            c, s = math.cos(turn), math.sin(turn)
            self._anchor = (self._last[0] - c * x + s * y, self._last[1] - s * x - c * y, turn)
            self._restarted = False
        self._begun = True
        ax, ay, turn = self._anchor
        c, s = math.cos(turn), math.sin(turn)
        self._last = (ax + c * x - s * y, ay + s * x + c * y, turn + yaw)
        return self._last


@dataclass(slots=True)
class InputCounts:
    """Counters of one kind of datagram."""

    received: int = 0
    lost: int = 0
    late: int = 0  # arrived after a newer one: dropped, a cumulative pose loses nothing
    duplicate: int = 0
    foreign: int = 0  # from a second sender while the first still sends
    restarts: int = 0


@dataclass(slots=True)
class Sequence:
    """Sequence numbers of one sender of one kind of datagram."""

    counts: InputCounts = field(default_factory=InputCounts)
    _session: int | None = None
    _seq: int = 0
    _t_latest: float = -math.inf
    restarted: bool = False

    def accept(self, session: int, seq: int, t_rx: float) -> bool:
        """Return whether a datagram is new and from the current sender; sets `restarted` where its sender restarted."""
        self.restarted = False
        if session != self._session:
            if t_rx - self._t_latest <= SESSION_TIMEOUT_S:
                self.counts.foreign += 1
                return False
            self.restarted = self._session is not None
            self.counts.restarts += self.restarted
        else:
            ahead = (seq - self._seq) % (1 << 32)
            if ahead == 0:
                self.counts.duplicate += 1
                return False
            self.restarted = ahead >= 1 << 31 and t_rx - self._t_latest > SESSION_TIMEOUT_S
            if self.restarted:  # a restarted sender with the same session number
                self.counts.restarts += 1
            elif ahead >= 1 << 31:
                self.counts.late += 1
                return False
            else:
                self.counts.lost += ahead - 1
        self._session, self._seq, self._t_latest = session, seq, t_rx
        self.counts.received += 1
        return True


@dataclass(slots=True)
class _Trouble:
    """A recurring problem with datagrams, logged once it persists."""

    begun: float = -math.inf
    latest: float = -math.inf
    logged: bool = False

    def to_log(self, t: float) -> bool:
        """Count an occurrence at ``t`` (s); return True when it has persisted long enough to be logged."""
        if t - self.latest > ABSENT_S:
            self.begun, self.logged = t, False
        self.latest = t
        if self.logged or t - self.begun <= SESSION_TIMEOUT_S:
            return False
        self.logged = True
        return True


OnOdometry = Callable[[RawOdometry], None]
OnImu = Callable[[RawImu], None]
Allowed = Callable[[str], bool]


class InputPort:
    """One UDP port for both kinds of datagrams; `odometry` and `imu` are its two sources.

    The socket is open while at least one source runs. Arrival times are the kernel's receive timestamps.

    Args:
        bind: name or address of this computer; empty: all of them.
        port: 0: any free one, see :attr:`port` once open.
        option: configuration key of the port, for the remedy.
        allowed: returns whether datagrams of a host are accepted.
    """

    def __init__(
        self, clock: Clock, bind: str, port: int, option: str = "odometry.port", allowed: Allowed | None = None
    ) -> None:
        self._clock = clock
        self._bind = bind
        self._wanted = port
        self._option = option
        self._allowed = allowed
        self._sockets: list[socket.socket] = []
        self._readers: list[Reader] = []
        self._share = Share()
        self._users = 0
        self._opening = asyncio.Lock()
        self._continuity = Continuity()
        self._on_odometry: OnOdometry | None = None
        self._on_imu: OnImu | None = None
        self._kinds = {ODOMETRY_MAGIC: Sequence(), IMU_MAGIC: Sequence()}
        self._clocks = {ODOMETRY_MAGIC: SenderClock(), IMU_MAGIC: SenderClock()}
        self.invalid = 0
        self._damage, self._rivals = _Trouble(), {ODOMETRY_MAGIC: _Trouble(), IMU_MAGIC: _Trouble()}
        self.odometry = UdpOdometry(self)
        self.imu = UdpImu(self)

    @property
    def port(self) -> int:
        """Port number while open."""
        return int(self._sockets[0].getsockname()[1]) if self._sockets else self._wanted

    @property
    def counts(self) -> dict[str, InputCounts]:
        """Counts by kind: odometry, imu."""
        return {"odometry": self._kinds[ODOMETRY_MAGIC].counts, "imu": self._kinds[IMU_MAGIC].counts}

    async def open(self) -> None:
        """Open the sockets; each call needs one `close`.

        Raises:
            DeviceRefused: port in use, or not permitted. DeviceMissing: no such address here.
        """
        async with self._opening:
            if not self._sockets:
                addresses = await inet.resolve(self._bind, self._wanted, passive=True)
                try:
                    for address in addresses:
                        self._listen(address)
                except OSError as error:
                    self._hang_up()
                    device = f"input datagrams on {self._bind or '*'}:{self._wanted}"
                    raise inet.refusal(device, self._option, self._wanted, error) from error
            self._users += 1

    def _listen(self, address: inet.Address) -> None:
        sock = inet.listening(inet.with_port(address, self.port), socket.SOCK_DGRAM)
        self._sockets.append(sock)
        enable_rx_timestamps(sock)
        self._readers.append(Reader(sock.fileno(), partial(self._read, sock), self._share))

    def close(self) -> None:
        """Undo one `open`."""
        self._users -= 1
        if self._users == 0:
            self._hang_up()

    def _hang_up(self) -> None:
        for reader in self._readers:
            reader.close()
        for sock in self._sockets:
            sock.close()
        self._readers.clear()
        self._sockets.clear()

    def _read(self, sock: socket.socket) -> None:
        for _ in range(_PER_TURN):
            try:
                data, ancillary, _, peer = sock.recvmsg(_BUFFER, STAMP_SPACE)
            except OSError:  # nothing more
                return
            if self._allowed is None or self._allowed(peer[0]):
                self.receive(data, self._clock.now() - kernel_age(ancillary), str(peer[0]))

    def receive(self, data: bytes, t_rx: float, peer: str = "a sender") -> None:
        """Decode, check and deliver one datagram; ``t_rx``: its arrival (s). Replay calls it directly."""
        try:
            datagram = decode(data)
        except DataInvalid as error:
            self.invalid += 1
            if self._damage.to_log(t_rx):
                log.info("port %d: a datagram from %s is not a valid reading: %s", self.port, peer, error)
            return
        kind = self._kinds[datagram.magic]
        lost, foreign = kind.counts.lost, kind.counts.foreign
        if not kind.accept(datagram.session, datagram.seq, t_rx):
            if kind.counts.foreign > foreign and self._rivals[datagram.magic].to_log(t_rx):
                text = "port %d: readings from %s are ignored while another sender is active (end one of them)"
                log.warning(text, self.port, peer)
            return
        t_mono = self._reading_time(datagram, t_rx, kind.restarted)
        if datagram.magic == IMU_MAGIC:
            if self._on_imu is not None:
                self._on_imu(RawImu(t_rx=t_rx, t_mono=t_mono, yaw_rate=datagram.values[0]))
            return
        if kind.restarted:
            self._continuity.restart()
        x, y, yaw = self._continuity.transform(*datagram.values)
        if self._on_odometry is not None:
            missed = kind.counts.lost - lost
            self._on_odometry(RawOdometry(t_rx=t_rx, t_mono=t_mono, x=x, y=y, yaw=yaw, missed=missed))

    def _reading_time(self, datagram: InputDatagram, t_rx: float, restarted: bool) -> float:
        """``t_mono`` of a reading: the shared clock where flagged and plausible, else from sender clock and arrival."""
        if not datagram.flags & SHARED_CLOCK:
            clock = self._clocks[datagram.magic]
            if restarted:
                clock.restart()
            return clock.measured_at(datagram.time, t_rx)
        return min(datagram.time, t_rx) if -MAX_LEAD_S <= t_rx - datagram.time <= MAX_AGE_S else t_rx

    def send_odometry_to(self, receiver: OnOdometry | None) -> None:
        """Set the receiver of odometry readings; None: no receiver."""
        self._on_odometry = receiver

    def send_imu_to(self, receiver: OnImu | None) -> None:
        """Set the receiver of gyro readings; None: no receiver."""
        self._on_imu = receiver


class UdpOdometry:
    """See :class:`hal.odometry.OdometrySource`."""

    def __init__(self, port: InputPort) -> None:
        self._port = port

    async def run(self, on_odometry: OnOdometry) -> None:
        """Deliver readings until cancelled. Raises as `InputPort.open`."""
        await self._port.open()
        self._port.send_odometry_to(on_odometry)
        try:
            await asyncio.Event().wait()
        finally:
            self._port.send_odometry_to(None)
            self._port.close()


class UdpImu:
    """See :class:`hal.imu.ImuSource`."""

    def __init__(self, port: InputPort) -> None:
        self._port = port

    async def run(self, on_imu: OnImu) -> None:
        """Deliver readings until cancelled. Raises as `InputPort.open`."""
        await self._port.open()
        self._port.send_imu_to(on_imu)
        try:
            await asyncio.Event().wait()
        finally:
            self._port.send_imu_to(None)
            self._port.close()

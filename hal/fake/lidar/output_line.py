"""The fake sensor's output line to the host: queue, line rate, write sizes, and losses."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

MAX_JOIN = 100
"""Scans that can be gathered into one write."""


class HostEnd(Protocol):
    """The host's end of the line: a memory port, a pty, a TCP connection."""

    def accept(self, data: bytes) -> bool:
        """Accept bytes; False where there is no room and all of them were dropped."""
        ...

    def hang_up(self) -> None:
        """Break the connection, as an unplug or a closing sensor does."""
        ...

    def baud(self) -> int:
        """The host's line rate, bit/s; 0 where it has none or it is unknown."""
        ...


@dataclass(slots=True)
class Pacing:
    """Transmission of bytes.

    Attributes:
        rate: bytes per second of the line; 0: no limit.
        piece: bytes per write; 0: whole replies.
        split_end: the last LF of every reply is a write of its own.
        join: data replies gathered into one write.
        backlog: data replies queued for the line before new ones are lost inside the sensor.
    """

    rate: float = 0.0
    piece: int = 0
    split_end: bool = False
    join: int = 1
    backlog: int = 2


@dataclass(slots=True)
class Parcel:
    """Bytes in transmission: they occupy the line from ``line_start`` to ``line_end`` and arrive in ``total`` pieces.

    The last piece arrives at ``t_end``.
    """

    pieces: deque[bytes]
    total: int
    line_start: float
    line_end: float
    t_start: float
    t_end: float
    is_scan: bool


@dataclass(slots=True)
class OutputCounts:
    """Counters of replies.

    Attributes:
        sent: delivered to the host. without_host: no host had opened the line.
        lost_in_sensor: scans lost because the line was too slow.
        refused_by_host: lost because the host's queue was full.
    """

    sent: int = 0
    without_host: int = 0
    lost_in_sensor: int = 0
    refused_by_host: int = 0


class OutputLine:
    """A first-in-first-out line to at most one host.

    Args:
        loop: the clock of all times.
        pacing: rate and write sizes.
        received: maps sent bytes to those that the host receives (random ones at another line rate).
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, pacing: Pacing, received: Callable[[bytes], bytes]) -> None:
        self._loop = loop
        self._received = received
        self.pacing = pacing
        self.counts = OutputCounts()
        self.host: HostEnd | None = None
        self._queue: deque[Parcel] = deque()
        self._gathered: list[bytes] = []
        self._timer: asyncio.TimerHandle | None = None
        self._line_free = self._arrived = loop.time()
        self._held = False

    def send(self, data: bytes, *, is_scan: bool = False, delay: float = 0.0) -> None:
        """Queue a reply; it occupies the line once that is free and arrives ``delay`` seconds later, in order.

        A scan is lost when the sensor's backlog is full.
        """
        if is_scan and self.pacing.join > 1:
            self._gathered.append(data)
            if len(self._gathered) < self.pacing.join:
                return
            data = b"".join(self._gathered)
            self._gathered.clear()
        now = self._loop.time()
        if is_scan and sum(p.is_scan and p.line_start > now for p in self._queue) >= self.pacing.backlog:
            self.counts.lost_in_sensor += 1
            return
        start = max(now, self._line_free)
        end = start + (len(data) / self.pacing.rate if self.pacing.rate > 0 else 0.0)
        t_start = max(self._arrived, start + delay)
        t_end = max(t_start, end + delay)
        self._line_free, self._arrived = end, t_end
        pieces = self._pieces(data)
        self._queue.append(Parcel(pieces, len(pieces), start, end, t_start, t_end, is_scan))
        self._wake()

    def drop_waiting_scans(self) -> None:
        """Drop queued scans (the stream was stopped); the one in transmission is completed."""
        now = self._loop.time()
        self._keep([p for p in self._queue if not p.is_scan or p.line_start <= now])

    def clear(self) -> None:
        """Drop everything (power lost, unplugged)."""
        self._keep([])

    def hold(self, held: bool) -> None:
        """Hold all replies back, or (False) deliver them at once."""
        self._held = held
        self._restart()

    def rewrap(self, piece: int = 0, split_end: bool = False, join: int = 1) -> None:
        """Change the write sizes of the next replies; without arguments: whole replies."""
        self.pacing.piece, self.pacing.split_end, self.pacing.join = piece, split_end, join
        self._gathered.clear()

    def _keep(self, parcels: list[Parcel]) -> None:
        now = self._loop.time()
        self._gathered.clear()
        self._queue = deque(parcels)
        self._line_free = max((p.line_end for p in parcels), default=now)
        self._arrived = max((p.t_end for p in parcels), default=now)
        self._restart()

    def _pieces(self, data: bytes) -> deque[bytes]:
        tail = [data[-1:]] if self.pacing.split_end and len(data) > 1 else []
        body = data[:-1] if tail else data
        size = self.pacing.piece or len(body)
        return deque([body[i : i + size] for i in range(0, len(body), size)] + tail)

    def _restart(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._wake()

    def _wake(self) -> None:
        if self._timer is None and self._queue and not self._held:
            head = self._queue[0]
            nth = head.total - len(head.pieces) + 1
            self._timer = self._loop.call_at(head.t_start + (head.t_end - head.t_start) * nth / head.total, self._write)

    def _write(self) -> None:
        self._timer = None
        head = self._queue[0]
        piece = head.pieces.popleft()
        if self.host is None:
            head.pieces.clear()
            self.counts.without_host += 1
        elif not self.host.accept(self._received(piece)):
            head.pieces.clear()
            self.counts.refused_by_host += 1
        elif not head.pieces:
            self.counts.sent += 1
        if not head.pieces:
            self._queue.popleft()
        self._wake()

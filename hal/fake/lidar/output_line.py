"""From the sensor's output buffer to the host: order, line rate, pieces, and what happens when nobody listens."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

MAX_JOIN = 100
"""Scans that can be gathered into one write."""


class HostEnd(Protocol):
    """Where the bytes go: a memory port, a pty, a TCP connection."""

    def take(self, data: bytes) -> bool:
        """Accept bytes; False when there was no room and all of them were dropped."""
        ...

    def hang_up(self) -> None:
        """Tear the connection as a pulled plug or a closing sensor does."""
        ...

    def baud(self) -> int:
        """Line rate the host listens at; 0 when that means nothing or is not known."""
        ...


@dataclass(slots=True)
class Pacing:
    """How bytes leave.

    Attributes:
        rate: bytes per second of the line; 0: no limit.
        piece: bytes per write; 0: whole replies.
        split_end: the last LF of every reply comes as a piece of its own.
        join: data replies gathered into one write.
        backlog: data replies that may wait for the line before new ones are lost inside the sensor.
    """

    rate: float = 0.0
    piece: int = 0
    split_end: bool = False
    join: int = 1
    backlog: int = 2


@dataclass(slots=True)
class Parcel:
    """Bytes on their way: they occupy the line from ``line_start`` to ``line_end`` and arrive, in ``total`` pieces.

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
class OutletCounts:
    """What became of the replies.

    Attributes:
        sent: handed to the host. unheard: nobody had opened the line.
        lost_in_sensor: scans for which the line was too slow.
        refused_by_host: the host's queue was full (nobody reads).
    """

    sent: int = 0
    unheard: int = 0
    lost_in_sensor: int = 0
    refused_by_host: int = 0


class Outlet:
    """A first-in-first-out line to at most one host.

    Args:
        loop: the clock of all times.
        pacing: how bytes leave.
        heard: what the host hears of bytes that arrive now (noise when it listens at another rate).
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, pacing: Pacing, heard: Callable[[bytes], bytes]) -> None:
        self._loop = loop
        self._heard = heard
        self.pacing = pacing
        self.counts = OutletCounts()
        self.host: HostEnd | None = None
        self._queue: deque[Parcel] = deque()
        self._gathered: list[bytes] = []
        self._timer: asyncio.TimerHandle | None = None
        self._line_free = self._arrived = loop.time()
        self._held = False

    def send(self, data: bytes, *, is_scan: bool = False, delay: float = 0.0) -> None:
        """Queue a reply; it occupies the line when that is free and arrives ``delay`` seconds later, in order.

        Scans are lost when as many as the sensor can hold wait for the line already.
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
        """Forget scans that have not begun to leave (the stream was stopped); the one on the line is finished."""
        now = self._loop.time()
        self._keep([p for p in self._queue if not p.is_scan or p.line_start <= now])

    def clear(self) -> None:
        """Forget everything (power lost, plug pulled)."""
        self._keep([])

    def hold(self, held: bool) -> None:
        """Keep everything back on the way to the host; letting go delivers it at once."""
        self._held = held
        self._restart()

    def rewrap(self, piece: int = 0, split_end: bool = False, join: int = 1) -> None:
        """Cut and gather the replies to come in another way; without arguments as whole replies."""
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
            self.counts.unheard += 1
        elif not self.host.take(self._heard(piece)):
            head.pieces.clear()
            self.counts.refused_by_host += 1
        elif not head.pieces:
            self.counts.sent += 1
        if not head.pieces:
            self._queue.popleft()
        self._wake()

"""From the sensor's output buffer to the host: order, line rate, pieces, and what happens when nobody listens."""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass
from typing import Protocol


class HostEnd(Protocol):
    """Where the bytes go: a memory port, a pty, a TCP connection."""

    def take(self, data: bytes) -> bool:
        """Accept bytes; False when there was no room and all of them were dropped."""
        ...

    def hang_up(self) -> None:
        """Tear the connection as a pulled plug or a closing sensor does."""
        ...


@dataclass(slots=True)
class Pacing:
    """How bytes leave.

    Attributes:
        rate: bytes per second of the line; 0: no limit. piece: bytes per write; 0: whole replies.
        split_end: the last LF of every reply comes as a piece of its own. join: data replies gathered into one write.
        backlog: data replies that may wait for the line before new ones are lost inside the sensor.
    """

    rate: float = 0.0
    piece: int = 0
    split_end: bool = False
    join: int = 1
    backlog: int = 2


@dataclass(slots=True)
class Parcel:
    """Bytes on their way: written in ``total`` pieces, the last of them at ``t_end``."""

    pieces: deque[bytes]
    total: int
    t_start: float
    t_end: float
    is_scan: bool


@dataclass(slots=True)
class OutletCounts:
    """What became of the replies: handed over, lost in the sensor, refused by the host's full queue, unheard."""

    sent: int = 0
    lost_in_sensor: int = 0
    refused_by_host: int = 0
    unheard: int = 0


class Outlet:
    """A first-in-first-out line to at most one host. All times are the loop's."""

    def __init__(self, loop: asyncio.AbstractEventLoop, pacing: Pacing) -> None:
        self._loop = loop
        self.pacing = pacing
        self.counts = OutletCounts()
        self.host: HostEnd | None = None
        self._queue: deque[Parcel] = deque()
        self._gathered: list[bytes] = []
        self._timer: asyncio.TimerHandle | None = None
        self._free_at = 0.0

    def send(self, data: bytes, *, is_scan: bool = False, not_before: float = 0.0) -> None:
        """Queue a reply; it begins at ``not_before`` or when the line is free. Scans are lost when too many wait."""
        if is_scan and self.pacing.join > 1:
            self._gathered.append(data)
            if len(self._gathered) < self.pacing.join:
                return
            data = b"".join(self._gathered)
            self._gathered.clear()
        if is_scan and sum(parcel.is_scan for parcel in self._queue) > self.pacing.backlog:
            self.counts.lost_in_sensor += 1
            return
        start = max(self._loop.time(), self._free_at, not_before)
        end = start + (len(data) / self.pacing.rate if self.pacing.rate > 0 else 0.0)
        self._free_at = end
        self._queue.append(self._parcel(data, start, end, is_scan))
        self._wake()

    def drop_waiting_scans(self) -> None:
        """Forget scans that have not begun to leave (the stream was stopped); the one on the line is finished."""
        now = self._loop.time()
        self._gathered.clear()
        self._queue = deque(p for p in self._queue if not p.is_scan or p.t_start < now)
        self._free_at = self._queue[-1].t_end if self._queue else now
        self._restart()

    def clear(self) -> None:
        """Forget everything (power lost, plug pulled)."""
        self._queue.clear()
        self._gathered.clear()
        self._free_at = self._loop.time()
        self._restart()

    def _parcel(self, data: bytes, t_start: float, t_end: float, is_scan: bool) -> Parcel:
        tail = [data[-1:]] if self.pacing.split_end else []
        body = data[:-1] if self.pacing.split_end else data
        size = self.pacing.piece or len(body)
        pieces = deque([body[i : i + size] for i in range(0, len(body), size)] + tail)
        return Parcel(pieces, len(pieces), t_start, t_end, is_scan)

    def _restart(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._wake()

    def _wake(self) -> None:
        if self._timer is None and self._queue:
            head = self._queue[0]
            written = head.total - len(head.pieces)
            due = head.t_start + (head.t_end - head.t_start) * (written + 1) / head.total
            self._timer = self._loop.call_at(due, self._write)

    def _write(self) -> None:
        self._timer = None
        head = self._queue[0]
        piece = head.pieces.popleft()
        if self.host is None:
            head.pieces.clear()
            self.counts.unheard += 1
        elif not self.host.take(piece):
            head.pieces.clear()
            self.counts.refused_by_host += 1
        elif not head.pieces:
            self.counts.sent += 1
        if not head.pieces:
            self._queue.popleft()
        self._wake()

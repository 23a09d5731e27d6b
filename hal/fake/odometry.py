"""A simulated motor controller that sends odometry datagrams (docs/udp.md), with fault injection.

It has its own encoder of the datagram. A source supplies cumulative poses; a function sends the datagrams (over a
socket, or to an input port in virtual time).
"""

from __future__ import annotations

import asyncio
import math
import struct
import zlib
from collections.abc import Callable
from random import Random
from typing import Final

from hal.fake.faults.orders import Fault, Parameter, Vocabulary, Word
from hal.fake.faults.schedule import ActiveFaults

Pose = tuple[float, float, float]
Source = Callable[[float], tuple[float, Pose] | None]
"""Returns the first reading after a time: its due time and the pose counted since the start; None: no more."""

ODOMETRY: Vocabulary = {
    # the general words
    "off": Word("the controller has no power; afterwards it counts from zero, as a new session", "lasts"),
    "stuck": Word("the same pose repeatedly with running numbers; afterwards the correct pose", "lasts"),
    "garbage": Word("random bytes of the same length instead", "strikes"),
    "wrong": Word("its distances and turns are `factor` times as large", "lasts",
                  {"factor": Parameter(1.5, -10.0, 10.0)}),
    "slow": Word("its rate is `factor` times lower", "lasts", {"factor": Parameter(4.0, 1.0, 1000.0)}),
    "delayed": Word("datagrams arrive `by_s` later", "lasts", {"by_s": Parameter(0.3, 0.0, 60.0)}),
    "intermittent": Word("datagrams are lost on the way", "strikes", share=0.5),
    # what a network and a controller do besides
    "jump": Word("the pose jumps by `by_m` ahead", "once", {"by_m": Parameter(3.0, -1e3, 1e3)}),
    "restart": Word("the controller restarts: another session, counting from zero", "once"),
    "blocked": Word("the wheel counters stop; the motion in that time is never counted", "lasts"),
}  # fmt: skip
"""By word. ``off stuck garbage wrong slow delayed intermittent`` are common to all devices."""

_SHARED_CLOCK: Final = 1
_DATAGRAM: Final = struct.Struct("<4sHHIIIIdddd")


def datagram(session: int, seq: int, t_mono: float, pose: Pose) -> bytes:
    """An odometry datagram, version 1, stamped in the daemon's own clock."""
    length = _DATAGRAM.size + 4
    data = _DATAGRAM.pack(b"LUOD", 1, length, session, seq % (1 << 32), _SHARED_CLOCK, 0, t_mono, *pose)
    return data + struct.pack("<I", zlib.crc32(data))


class FakeOdometry:
    """Sends readings when they are due; a :class:`hal.fake.faults.schedule.Target` of fault orders.

    Args:
        source: of readings, in the loop's time. send: receives a datagram at its arrival time.
        seed: of the random strikes.
    """

    vocabulary = ODOMETRY

    def __init__(self, source: Source, send: Callable[[bytes], None], seed: int = 0) -> None:
        self._source, self._send = source, send
        self._chance = Random(seed)
        self._loop = asyncio.get_running_loop()
        self.orders = ActiveFaults(seed + 1)
        self.sent = 0
        self._session, self._seq = 1, 0
        self._reported: Pose = (0.0, 0.0, 0.0)
        self._counted: Pose | None = None
        self._origin: Pose | None = None
        self._skipped = 0

    def check(self, fault: Fault) -> None:
        """Accept every fault within its ranges."""

    def in_force(self) -> list[Fault]:
        """Faults that have not been lifted and have not spent their strikes."""
        return self.orders.in_force()

    def begin(self, fault: Fault) -> None:
        """A fault comes into force (one that happens once happens now)."""
        if fault.what == "jump":
            x, y, yaw = self._reported
            self._reported = (x + fault.number("by_m"), y, yaw)
        elif fault.what == "restart":
            self._restart()
        else:
            self.orders.add(fault)

    def end(self, fault: Fault) -> None:
        """A fault is lifted."""
        self.orders.remove(fault)
        if fault.what == "off":
            self._restart()

    async def run(self) -> None:
        """Send until cancelled, or until there are no more readings."""
        t = self._loop.time()
        while (reading := self._source(t)) is not None:
            t, pose = reading
            await asyncio.sleep(t - self._loop.time())
            self._count(pose)
            if not self.orders.on("off") and self._due():
                self._send_reading(t)

    def _restart(self) -> None:
        self._session, self._seq, self._reported = self._session + 1, 0, (0.0, 0.0, 0.0)

    def _count(self, pose: Pose) -> None:
        """Add the motion since the last reading to the reported pose, altered by the faults in force."""
        before, self._counted = self._counted or pose, pose
        if self.orders.on("blocked") or self.orders.on("off"):
            return
        wrong = self.orders.on("wrong")
        ahead, left, turn = _between(before, pose)
        factor = wrong.number("factor") if wrong else 1.0
        self._reported = _then(self._reported, (factor * ahead, factor * left, factor * turn))

    def _due(self) -> bool:
        slow = self.orders.on("slow")
        self._skipped += 1
        if slow is not None and self._skipped < slow.number("factor"):
            return False
        self._skipped = 0
        return True

    def _send_reading(self, t_mono: float) -> None:
        if self.orders.on("stuck") is None or self._origin is None:
            self._origin = self._reported
        data = datagram(self._session, self._seq, t_mono, self._origin)
        self._seq += 1
        if self.orders.strike("intermittent"):
            return
        if self.orders.strike("garbage"):
            data = self._chance.randbytes(len(data))
        late = self.orders.on("delayed")
        self.sent += 1
        if late is None:
            self._send(data)
        else:
            self._loop.call_later(late.number("by_s"), self._send, data)


def _between(a: Pose, b: Pose) -> Pose:
    """Pose ``b`` in the frame of pose ``a``."""
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return c * dx + s * dy, -s * dx + c * dy, b[2] - a[2]


def _then(a: Pose, step: Pose) -> Pose:
    """Pose ``a`` composed with ``step``."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * step[0] - s * step[1], a[1] + s * step[0] + c * step[1], a[2] + step[2]

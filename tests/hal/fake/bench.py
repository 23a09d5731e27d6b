"""A host's end of the wire for tests: says lines, keeps what arrives and when, and reads replies by the letter.

The reader is a third implementation of the protocol, strict and slow; it shares nothing with the encoder or the driver.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from hal.clock import LoopClock, run_virtual
from hal.errors import HalError
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UTM_30LX, LidarModel, Unit
from hal.fake.lidar.rotor import Rotor
from hal.fake.lidar.scan import FakeScan, ScanSource
from hal.fake.transport.memory_host import FakeOpener
from hal.port.port import Port
from tests.hal.driven import played

T = TypeVar("T")


def number(text: str) -> int:
    value = 0
    for char in text:
        assert "0" <= char <= "o", f"{char!r} is no SCIP character"
        value = value * 64 + ord(char) - 48
    return value


def summed(line: str) -> str:
    """A line without its sum character, which must be right."""
    body, char = line[:-1], line[-1]
    assert ord(char) == sum(map(ord, body)) % 64 + 48, f"wrong sum: {line!r}"
    return body


@dataclass
class Reply:
    echo: str
    status: str
    lines: list[str] = field(default_factory=list)
    t: float = 0.0

    @property
    def tick(self) -> int:
        stamp = summed(self.lines[0])
        assert len(stamp) == 4
        return number(stamp)

    @property
    def payload(self) -> str:
        rows = [summed(line) for line in self.lines[1:]]
        assert rows
        assert all(len(row) == 64 for row in rows[:-1])
        assert 0 < len(rows[-1]) <= 64
        return "".join(rows)

    def values(self, width: int = 3) -> list[int]:
        text = self.payload
        assert len(text) % width == 0
        return [number(text[i : i + width]) for i in range(0, len(text), width)]

    def echoes(self, values: int) -> list[list[tuple[int, ...]]]:
        """Of each step its echoes, each a tuple of 1 (ND) or 2 (NE) ``values``."""
        steps: list[list[tuple[int, ...]]] = []
        text = self.payload
        while text:
            further = text.startswith("&")
            text = text.removeprefix("&")
            one = tuple(number(text[3 * i : 3 * i + 3]) for i in range(values))
            text = text[3 * values :]
            if further:
                steps[-1].append(one)
            else:
                steps.append([one])
        return steps

    @property
    def pairs(self) -> dict[str, str]:
        """Of a text reply: values by key, sums checked without the semicolon."""
        out = {}
        for line in self.lines:
            text, semicolon, char = line[:-2], line[-2], line[-1]  # the sum character may be a semicolon, too
            assert semicolon == ";"
            assert summed(text + char) == text
            key, _, value = text.partition(":")
            out[key] = value
        return out


def read(data: bytes, t: float = 0.0) -> Reply:
    """One reply, without damage."""
    assert data.endswith(b"\n\n")
    echo, status, *lines = data[:-2].decode("ascii").split("\n")
    assert "" not in lines
    return Reply(echo, summed(status), lines, t)


class Talk:
    """The host of one device on a memory port."""

    def __init__(self, device: FakeHokuyo, opener: FakeOpener) -> None:
        self.device = device
        self.opener = opener
        self.loop = asyncio.get_running_loop()
        self.schedule = FaultSchedule({"lidar": device})
        self.pieces: list[tuple[float, bytes]] = []
        self.lost: HalError | None = None
        self.port: Port | None = None

    async def open(self, baud: int = 19200) -> None:
        self.lost = None
        self.port = await self.opener("lidar", baud)
        self.port.start(lambda data, t: self.pieces.append((t, data)), self._lose)

    def _lose(self, error: HalError) -> None:
        self.lost = error

    async def wait(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    def say(self, text: str) -> None:
        assert self.port is not None
        self.port.write(text.encode("latin-1"))

    async def ask(self, text: str, wait: float = 0.9) -> list[Reply]:
        """Say a line and read what arrives in the next ``wait`` seconds, strictly."""
        self.pieces.clear()
        self.say(text + "\n")
        await asyncio.sleep(wait)
        return self.replies()

    async def one(self, text: str, wait: float = 0.9) -> Reply:
        (reply,) = await self.ask(text, wait)
        return reply

    async def status(self, text: str) -> str:
        """Status of the first reply to a line; empty when there was none."""
        return next((reply.status for reply in await self.ask(text) if reply.echo == text), "")

    @property
    def raw(self) -> bytes:
        return b"".join(data for _, data in self.pieces)

    def replies(self) -> list[Reply]:
        """All that arrived, cut at empty lines; each stamped with the arrival of its last byte."""
        out, text = [], b""
        for t, data in self.pieces:
            text += data
            while b"\n\n" in text:
                reply, _, text = text.partition(b"\n\n")
                out.append(read(reply + b"\n\n", t))
        assert not text, f"half a reply: {text!r}"
        return out

    def scans(self) -> list[Reply]:
        return [reply for reply in self.replies() if reply.status == "99"]


def ramp(model: LidarModel) -> ScanSource:
    """Step s of the n-th scan is 1000 + s + 2 n mm, so that every scan differs and says which one it is."""
    steps = np.arange(model.steps, dtype=np.int32)
    count = -1

    def source(_t: float) -> FakeScan:
        nonlocal count
        count += 1
        return FakeScan(1000 + steps + 2 * count, 300 + steps)

    return source


def virtual(
    scene: Callable[[Talk], Awaitable[T]],
    model: LidarModel = UTM_30LX,
    *,
    unit: Unit | None = None,
    source: ScanSource | None = None,
    rotor: Callable[[float], Rotor] | None = None,
) -> T:
    """Play a scene with one device in virtual time, the line open (unless the device starts unreachable)."""

    async def main() -> T:
        loop = asyncio.get_running_loop()
        turning = None if rotor is None else rotor(loop.time())
        device = FakeHokuyo(model, source or ramp(model), unit=unit, rotor=turning)
        opener = FakeOpener(LoopClock(loop))
        opener.plug("lidar", device)
        talk = Talk(device, opener)
        if device.reachable:
            await talk.open()
        try:
            return await scene(talk)
        finally:
            talk.schedule.close()
            device.close()

    return run_virtual(main())


def talking(*what: Any, **how: Any) -> Callable[..., Callable[..., None]]:
    """A coroutine test with one device, ``talk``, in virtual time; arguments as of :func:`virtual`."""
    return played(lambda scene: virtual(scene, *what, **how), "talk")

"""One question at a time over a memory port, everything else to the follower."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from hal.clock import LoopClock, run_virtual
from hal.errors import DeviceMissing
from hal.hokuyo import scip
from hal.hokuyo.scip_line import Line
from hal.port.port import MemoryPort, memory_pair


def with_line(body: Callable[[Line, MemoryPort, list[bytes]], Awaitable[None]]) -> None:
    async def main() -> None:
        ours, theirs = memory_pair(LoopClock(asyncio.get_running_loop()), "/dev/x")
        heard: list[bytes] = []
        theirs.start(lambda data, t: heard.append(data), lambda error: None)
        await body(Line(ours), theirs, heard)

    run_virtual(main())


def test_a_question_is_flushed_before_and_answered_by_its_echo_alone() -> None:
    async def body(line: Line, sensor: MemoryPort, heard: list[bytes]) -> None:
        others: list[bytes] = []
        line.on_frame = lambda frame, t: others.append(frame)
        loop = asyncio.get_running_loop()
        loop.call_later(0.1, sensor.write, b"VV\n00P\n\nQT\n99b\n\nQT\n0")
        loop.call_later(0.2, sensor.write, b"0P\n\nQT\n00P\n\n")
        assert await line.exchange(scip.QT, 1.0) == b"QT\n00P"
        assert heard == [b"\nQT\n"]
        assert others == [b"VV\n00P", b"QT\n99b", b"QT\n00P"]  # a second answer to it is nobody's

    with_line(body)


def test_no_answer_in_time() -> None:
    async def body(line: Line, sensor: MemoryPort, heard: list[bytes]) -> None:
        with pytest.raises(TimeoutError):
            await line.exchange(scip.VV, 0.5)
        sensor.write(b"VV\n00P\n\n")  # too late: must not answer the next question
        asyncio.get_running_loop().call_later(0.1, sensor.write, b"PP\n00P\n\n")
        assert await line.exchange(scip.PP, 0.5) == b"PP\n00P"

    with_line(body)


def test_what_is_readable_is_told_from_noise() -> None:
    async def body(line: Line, sensor: MemoryPort, heard: list[bytes]) -> None:
        sensor.write(b"\xf0\x0f\n\n\x80\x81\n\x82\n\n" + b"MD\n99b\n\n")
        await asyncio.sleep(0.1)
        assert line.recognised == 1
        assert line.dropped_bytes == 0
        sensor.write(b"\xaa" * 1000)
        await asyncio.sleep(0.1)
        assert line.dropped_bytes == 1000

    with_line(body)


def test_loss_reaches_a_question_under_way_and_every_later_one() -> None:
    async def body(line: Line, sensor: MemoryPort, heard: list[bytes]) -> None:
        told: list[str] = []
        line.set_on_lost(lambda: told.append("first"))
        asyncio.get_running_loop().call_later(0.1, sensor.close)
        with pytest.raises(DeviceMissing):
            await line.exchange(scip.VV, 1.0)
        with pytest.raises(DeviceMissing):
            await line.exchange(scip.VV, 1.0)
        line.set_on_lost(lambda: told.append("late"))
        line.set_on_lost(None)
        assert told == ["first", "late"]
        assert isinstance(line.lost, DeviceMissing)
        line.close()

    with_line(body)

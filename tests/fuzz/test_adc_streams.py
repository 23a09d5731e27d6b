"""Megabytes of damaged bytes at every place where bytes come in: the remote bus from both ends, and the chip.

A quick round always, 10 MB of each in ``make test-all``.
"""

from __future__ import annotations

import asyncio
import math
import random
import socket
import time
from pathlib import Path

import numpy as np
import pytest

from hal.adc import Blemish
from hal.bus import i2c_frames as frames
from hal.bus.i2c import MAX_LENGTH, MAX_MESSAGES, AsyncBus, Message, OnRead, Transferred, read, write
from hal.bus.i2c_remote import RemoteBus, clock_name
from hal.bus.i2c_server import BusServer
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import HalError
from hal.photodiode.adapter_limits import AdapterLimits
from hal.photodiode.diagnosis import BlockDiagnosis
from hal.photodiode.mcp3221 import CHIP
from hal.photodiode.sampler import Sampler

SIZES = [pytest.param(400_000, id="quick"), pytest.param(10_000_000, id="10MB", marks=pytest.mark.slow)]
PROTOCOL = 4096
"""Bytes a greeting and some answers take; what a socket's buffer holds without a reader."""


def damaged(stream: bytes, chance: random.Random) -> bytes:
    """Flips, insertions, losses, repetitions, foreign text; now and then nothing."""
    found = bytearray(stream)
    for _ in range(chance.choice((0, 1, 1, 2, 5))):
        at = chance.randrange(len(found) + 1)
        kind = chance.randrange(6)
        if kind == 0 and at < len(found):
            found[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            found[at:at] = chance.randbytes(chance.randint(1, 20))
        elif kind == 2:
            del found[at : at + chance.randint(1, 20)]
        elif kind == 3:
            found[at:at] = found[at : at + chance.randint(1, 60)]
        elif kind == 4:
            found[at : at + 4] = chance.choice((0, 1, 255, 2**16, 2**31, 2**32 - 1)).to_bytes(4, "big")
        else:
            found[at : at + 8] = np.array(chance.choice((np.nan, np.inf, -1e300, 0.0)), ">f8").tobytes()
    return bytes(found)


def a_conversation(chance: random.Random) -> bytes:
    """What an honest server would say to the orders of `speak_with`."""
    now = time.monotonic()
    parts = [frames.hello(now, chance.choice((clock_name(), "another")), "adapter")]
    for number in range(1, 6):
        code = chance.choice((0, 0, 0, 5, 110))
        reads = () if code else (chance.randbytes(2),)
        parts.append(frames.done(frames.Done(number, code, now, now, now, now + 1e-4, reads)))
    return b"".join(parts)


def must(value: object) -> None:
    assert value


def speak_with(said: bytes) -> int:
    """A client on a connection on which all of this has been said already; the answers it took."""
    here, there = socket.socketpair()
    here.settimeout(1.0)
    with there:
        there.sendall(said)
        there.shutdown(socket.SHUT_WR)
        try:
            bus = RemoteBus("unix:x", here)
        except HalError as error:
            must(error.remedy)
            return 0
        taken = 0
        for _ in range(5):
            try:
                done = bus.transfer((write(0x48, b"\x01"), read(0x48, 2)))
            except OSError as error:
                must(error.errno)
                continue
            assert math.isfinite(done.t0)
            assert done.t0 <= done.t1
            assert [len(data) <= 2 for data in done.reads] == [True]
            taken += 1
        bus.close()
        return taken


@pytest.mark.parametrize("size", SIZES)
def test_a_client_survives_any_server(size: int) -> None:
    chance = random.Random(1)
    spoken = taken = rounds = 0
    while spoken < size:
        said = damaged(a_conversation(chance), chance)[:PROTOCOL]
        taken += speak_with(said)
        spoken += len(said)
        rounds += 1
    assert rounds / 4 < taken < 5 * rounds  # many conversations were understood, as far as they went


class Instant:
    """A bus that answers at once and counts."""

    name, about = "x", "instant"

    def __init__(self) -> None:
        self.orders = 0

    async def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        self.orders += 1
        assert 1 <= len(messages) <= MAX_MESSAGES
        assert all(1 <= (len(m.data) or m.length) <= MAX_LENGTH and 0 <= m.address <= 0x7F for m in messages)
        now = time.monotonic()
        return Transferred(now, now, tuple(bytes(m.length) for m in messages if m.length))

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        raise NotImplementedError

    async def close(self) -> None:
        return


@pytest.mark.parametrize("size", SIZES)
def test_a_server_survives_any_client(size: int, tmp_path: Path) -> None:
    chance = random.Random(2)
    instant = Instant()

    async def opener(_name: str) -> AsyncBus:
        return instant

    async def one_client(said: bytes) -> None:
        reader, writer = await asyncio.open_unix_connection(str(tmp_path / "s"))
        writer.write(said)
        writer.write_eof()
        answers = await asyncio.wait_for(reader.read(), 20.0)  # until it hangs up
        kinds = [kind for kind, _ in frames.Splitter().feed(answers)]
        assert kinds[0] == frames.HELLO
        assert set(kinds[1:]) <= {frames.DONE}
        writer.close()

    async def main() -> None:
        server = BusServer(opener, "x", SystemClock())
        await server.listen(f"unix:{tmp_path}/s")
        spoken = 0
        while spoken < size:
            said = b""
            for number in range(chance.choice((1, 10, 100))):
                length = chance.choice((2, 60, 700, 0, 8193))
                messages = (write(chance.randrange(128), b"\x01"), Message(chance.randrange(128), length=length))
                said += frames.transfer(number, messages)
            said = damaged(said, chance)
            spoken += len(said) + 700
            await one_client(said)
        bus = await open_bus(f"unix:{tmp_path}/s")  # and it still serves those who speak its language
        assert (await bus.transfer((read(0x4D, 2),))).reads == (bytes(2),)
        await bus.close()
        await server.close()

    asyncio.run(main())
    assert instant.orders > size / 1000


def block_of(chance: random.Random, length: int) -> bytes:
    """Bytes of a read, in all the ways in which they have ever been seen, and in others."""
    light = 2048 + 1500 * math.sin(chance.uniform(0, 6.3))
    words = np.clip(
        np.random.default_rng(chance.randrange(2**32)).normal(light, chance.choice((0.0, 0.4, 300.0)), length // 2),
        0,
        4095,
    )
    whole = words.astype(">u2").tobytes()
    kind = chance.randrange(6)
    if kind == 0:
        return chance.randbytes(chance.randint(0, length))
    if kind == 1:
        return bytes([chance.choice((0x00, 0xFF, 0x0F, 0x08))]) * length
    if kind == 2:
        return whole[: chance.randrange(length)]
    if kind == 3:
        cut = chance.randrange(length)
        return whole[:cut] + b"\xff" * (length - cut)
    return whole if kind == 4 else damaged(whole, chance)[:length]


@pytest.mark.parametrize("size", SIZES)
def test_any_block_is_judged(size: int) -> None:
    chance = random.Random(3)
    length, scl = 2222, 400e3
    span = (10 + 9 * length) / scl + 60e-6
    sampler = Sampler(CHIP, AdapterLimits(length, span, 28 / scl + 60e-6))
    level = {"now": 0.0}
    diagnosis = BlockDiagnosis("x", CHIP, 0x4D, lambda: None if chance.random() < 0.5 else level["now"])
    t, seen, sound = 0.0, 0, 0
    last = -1
    while seen < size:
        data = block_of(chance, length)
        late = chance.choice((0.0, 1e-6, 1e-3, 0.3))
        block, defects = sampler.to_block(Transferred(t, t + span + late, (data,)), chance.randrange(3) + (last + 1))
        level["now"] = chance.uniform(-0.1, 1.1)
        verdict = diagnosis.add(block, defects)
        assert block.seq > last
        assert block.words.size <= length // 2
        assert block.words.size == 0 or 0 <= int(block.words.min()) <= int(block.words.max()) <= 4095
        assert t <= block.t_first <= block.t1
        assert 0.0 <= block.slack_s < 10.0
        assert 1e3 < block.rate_hz < 1e5
        assert verdict.error is None or verdict.error.remedy
        assert verdict.sound or block.blemish & (Blemish.MISALIGNED | Blemish.SHORT)
        last, t, seen, sound = block.seq, t + span + late + 1e-4, seen + length, sound + verdict.sound
    assert sound > size / length / 4

"""Both ends of a remote bus: a client under any server's bytes, a server under any client's."""

import asyncio
import atexit
import math
import socket
import time
from collections.abc import Callable
from functools import cache

from hal.bus import i2c_frames as frames
from hal.bus.i2c import MAX_LENGTH, MAX_MESSAGES, AsyncBus, Message, OnRead, Transferred, read, write
from hal.bus.i2c_remote import RemoteBus, clock_name
from hal.bus.i2c_server import BusServer
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import HalError
from tests.fuzz.targets import a_file

MEGABYTES = 10
PROTOCOL = 4096
"""Bytes a greeting and some answers take; what a socket's buffer holds without a reader."""
ORDERS = 5


def mend(data: bytes) -> bytes:
    """The last frame's head states the length that follows."""
    at = 0
    while len(data) - at >= 5 and (size := int.from_bytes(data[at : at + 4], "big")) <= len(data) - at - 4:
        at += 4 + size
    rest = len(data) - at - 4
    return data if rest < 1 else data[:at] + rest.to_bytes(4, "big") + data[at + 4 :]


def conversation(clock: str, code: int) -> bytes:
    """All that an honest server sends on the orders of `understood`."""
    now = time.monotonic()
    reads = () if code else (b"\x08\x00",)
    done = [frames.Done(number + 1, code, now, now, now, now + 1e-4, reads) for number in range(ORDERS)]
    return frames.hello(now, clock, "adapter") + b"".join(map(frames.done, done))


def seeds() -> list[bytes]:
    orders = [
        frames.transfer(number, (write(0x48, b"\x01"), Message(0x4D, length=length)))
        for number, length in enumerate((2, 60, 700, 8192))
    ]
    said = [conversation(clock, code) for clock in (clock_name(), "another") for code in (0, 5, 110)]
    return [*said, *orders, b"".join(orders * 10)]


def must(value: object) -> None:
    assert value


def understood(said: bytes) -> int:
    """Answers that a client takes on a connection on which all of this has come already."""
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
        for _ in range(ORDERS):
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


class Instant:
    """A bus that answers at once."""

    name, about = "x", "instant"

    async def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        assert 1 <= len(messages) <= MAX_MESSAGES
        assert all(1 <= (len(m.data) or m.length) <= MAX_LENGTH and 0 <= m.address <= 0x7F for m in messages)
        now = time.monotonic()
        return Transferred(now, now, tuple(bytes(m.length) for m in messages if m.length))

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        raise NotImplementedError

    async def close(self) -> None:
        return


async def opener(_name: str) -> AsyncBus:
    return Instant()


async def served(path: str, said: bytes) -> None:
    """A client sends any bytes and receives a greeting and results until the server hangs up; then an honest one."""
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(said)
    writer.write_eof()
    kinds = [kind for kind, _ in frames.Splitter().feed(await asyncio.wait_for(reader.read(), 20.0))]
    assert kinds[0] == frames.HELLO
    assert set(kinds[1:]) <= {frames.DONE}
    writer.close()
    bus = await open_bus(f"unix:{path}")
    assert (await bus.transfer((read(0x4D, 2),))).reads == (bytes(2),)
    await bus.close()


@cache
def serving() -> tuple[asyncio.AbstractEventLoop, str]:
    """A bus server of this process and the loop in which it runs; closed at its exit."""
    loop, path = asyncio.new_event_loop(), str(a_file("s"))
    server = BusServer(opener, "x", SystemClock())
    loop.run_until_complete(server.listen(f"unix:{path}"))

    def end() -> None:
        loop.run_until_complete(server.close())
        loop.close()

    atexit.register(end)
    return loop, path


def feeder() -> Callable[[bytes], None]:
    loop, path = serving()

    def feed(data: bytes) -> None:
        understood(data[:PROTOCOL])
        assert understood(conversation("another", 0)) == ORDERS, "an honest server is not understood"
        loop.run_until_complete(served(path, data))

    return feed

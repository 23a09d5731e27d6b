"""Helpers of real-time tests of the fake lidar: a pty with its host, and waiting with slack for a busy computer."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import serial

from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UTM_30LX
from hal.fake.transport.pty_server import PtyServer
from tests.hal.fake.bench import ramp

PATIENCE = 4.0
"""Factor on every time limit."""


async def until(true: Callable[[], object], seconds: float = 5.0) -> None:
    deadline = time.monotonic() + seconds * PATIENCE
    while not true():
        assert time.monotonic() < deadline, "waited too long"
        await asyncio.sleep(0.01)


@asynccontextmanager
async def on_pty(link: Path) -> AsyncIterator[tuple[FakeHokuyo, PtyServer]]:
    device = FakeHokuyo(UTM_30LX, ramp(UTM_30LX))
    server = PtyServer(device, link)
    try:
        yield device, server
    finally:
        server.close()
        device.close()


def opened(path: str, baud: int = 19200) -> serial.Serial:
    return serial.Serial(path, baud, timeout=0, exclusive=True)


async def quiet(port: serial.Serial) -> None:
    """Wait until nothing has come for a while."""
    deadline = time.monotonic() + 5.0 * PATIENCE
    while True:
        port.read(65536)
        await asyncio.sleep(0.3)
        if port.read(65536) == b"":
            return
        assert time.monotonic() < deadline, "it goes on talking"


async def gather(port: serial.Serial, replies: int) -> list[bytes]:
    text = bytearray()

    def enough() -> bool:
        text.extend(port.read(65536))
        return text.count(b"\n\n") >= replies

    await until(enough)
    return [part + b"\n\n" for part in bytes(text).split(b"\n\n")[:replies]]

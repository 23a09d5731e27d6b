"""Helpers of the tests of the remote bus: a served fake converter, and a server under the test's control."""

import socket
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from hal.bus import i2c_frames as frames
from hal.bus.i2c_remote import clock_name
from hal.bus.i2c_server import BusServer
from hal.clock import SystemClock
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.faults.schedule import FaultSchedule

KINDS = ("unix", "tcp")


def ramp(t_mono: object) -> object:
    return (t_mono * 5.0) % 1.0  # type: ignore[operator]  # an array


@asynccontextmanager
async def served(kind: str, folder: Path, source: object = ramp) -> AsyncIterator[tuple[str, FakeAdc, FaultSchedule]]:
    """A fake converter on a bus server; gives its address."""
    clock = SystemClock()
    fake = FakeAdc(source, clock)  # type: ignore[arg-type]  # a sample source
    buses = FakeBuses(clock)
    buses.plug("x", fake)
    server = BusServer(buses, "x", clock)
    where = await server.listen(f"unix:{folder}/i2c" if kind == "unix" else "tcp://127.0.0.1:0")
    schedule = FaultSchedule({"adc": fake})
    try:
        yield where, fake, schedule
    finally:
        schedule.close()
        await server.close()


class Server:
    """Accepts once and does as it is told, in a thread."""

    def __init__(self, path: Path, behave: Callable[[socket.socket], None]) -> None:
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._behave = behave
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        link, _ = self._listener.accept()
        with link:
            self._behave(link)
        self._listener.close()

    def join(self) -> None:
        self._thread.join(10.0)


def greet(link: socket.socket, clock: str = "") -> None:
    link.sendall(frames.hello(time.monotonic(), clock or clock_name(), "a"))


def answer(link: socket.socket, shift: float = 0.0) -> None:
    """Answer one order."""
    splitter = frames.Splitter()
    while not (orders := splitter.feed(link.recv(4096))):
        pass
    number, messages = frames.parse_transfer(orders[0][1])
    now = time.monotonic() + shift
    link.sendall(frames.done(frames.Done(number, 0, now, now, now, now, (bytes(messages[-1].length),))))

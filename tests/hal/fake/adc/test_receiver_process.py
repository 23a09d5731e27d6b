"""A whole receiver in a process of its own, and the real driver on its bus: real sockets, real threads, real time."""

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from hal.adc import Blemish, RawSamples
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import DeviceFault, DeviceMissing, HalError
from hal.lidar import Link
from hal.photodiode.dc_channel import LevelInput
from hal.photodiode.driver import PhotodiodeAdc, Sampling
from hal.photodiode.probe import probe_buses

pytestmark = [pytest.mark.system, pytest.mark.realtime]
SLACK = 4.0
START_S = 5.0
"""A Python process with numpy, on a computer with other work."""


class Receiver:
    """``python -m hal.fake.adc.receiver``, started anew as often as a test wants."""

    def __init__(self, folder: Path, where: str = "") -> None:
        self.where = where or f"unix:{folder}/i2c"
        self._control = folder / "control"
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        command = [
            sys.executable,
            "-m",
            "hal.fake.adc.receiver",
            self.where,
            "--dc",
            "0.4",
            "--control",
            str(self._control),
        ]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        first = self.process.stdout.readline()
        assert " on " in first, first
        self.where = first.split(" on ")[1].strip()
        assert "fault commands" in self.process.stdout.readline()

    def stop(self, number: int = signal.SIGTERM) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        code = self.process.wait(10.0)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code

    async def order(self, line: str) -> None:
        reader, writer = await asyncio.open_unix_connection(str(self._control))
        writer.write(f"{line}\n".encode())
        answer = ""
        while not answer.endswith(("ok\n", "refused")):
            answer = (await asyncio.wait_for(reader.readline(), 5.0)).decode()
            assert not answer.startswith("refused"), answer
        writer.close()


async def until(so: Callable[[], bool], seconds: float, about: object) -> None:
    end = asyncio.get_running_loop().time() + seconds * SLACK
    while not so():
        assert asyncio.get_running_loop().time() < end, about
        await asyncio.sleep(0.01)


@asynccontextmanager
async def running(where: str) -> AsyncIterator[tuple[PhotodiodeAdc, list[RawSamples]]]:
    blocks: list[RawSamples] = []
    sampling = Sampling(level=LevelInput())
    driver = PhotodiodeAdc(where, 0x4D, "MCP3221", clock=SystemClock(), opener=open_bus, sampling=sampling)
    task = asyncio.create_task(driver.run(blocks.append))
    try:
        yield driver, blocks
        assert not task.done()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@asynccontextmanager
async def a_receiver(folder: Path, where: str = "") -> AsyncIterator[tuple[Receiver, PhotodiodeAdc, list[RawSamples]]]:
    """A receiver in a process of its own, a driver that reads it, and its blocks."""
    receiver = Receiver(folder, where)
    receiver.start()
    try:
        async with running(receiver.where) as (driver, blocks):
            await until(lambda: len(blocks) >= 5, 2.0, driver.status)
            yield receiver, driver, blocks
    finally:
        assert receiver.stop() == 0


@pytest.mark.parametrize("where", ["", "tcp://127.0.0.1:0"], ids=["unix", "tcp"])
async def test_blocks_come_and_are_what_they_should_be(where: str, tmp_path: Path) -> None:
    async with a_receiver(tmp_path, where) as (_, driver, blocks):
        await until(lambda: len(blocks) >= 60, 4.0, driver.status)
        assert driver.status.link is Link.STREAMING
        assert driver.status.extra["chip"] == "MCP3221"
        assert driver.status.extra["dc_level"].endswith("%")
        assert all(abs(block.rate_hz * 18 / 400e3 - 1.0) < 0.05 for block in blocks)
        assert not any(block.blemish & ~(Blemish.STRETCHED | Blemish.GAP) for block in blocks)
        assert all(block.t0 < block.t_first < block.t1 for block in blocks)


@pytest.mark.parametrize(
    ("order", "noun", "says"),
    [
        ("order off for=3", DeviceMissing, "no MCP3221 answers at address 0x4d"),
        ("order hang for=4", DeviceFault, "no data were read for 5 blocks|bus is stuck"),
        ("order gone for=3", DeviceMissing, "adapter was removed|no such bus"),
        ("order dark for=3", DeviceFault, "dark: no light|no light at all"),
    ],
)
async def test_faults_show_and_pass(order: str, noun: type[HalError], says: str, tmp_path: Path) -> None:
    async with a_receiver(tmp_path) as (receiver, driver, blocks):
        await receiver.order(order)
        await until(lambda: isinstance(driver.status.error, noun), 2.0, driver.status)
        error = driver.status.error
        assert error is not None
        assert error.remedy
        with pytest.raises(AssertionError, match=says):
            raise AssertionError(str(error))
        seen = len(blocks)
        await until(lambda: driver.status.error is None and len(blocks) > seen + 5, 7.0, driver.status)
        assert driver.status.link is Link.STREAMING


async def test_a_receiver_that_is_killed_and_comes_back(tmp_path: Path) -> None:
    async with a_receiver(tmp_path) as (receiver, driver, blocks):
        threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - count only
        for _ in range(3):
            assert receiver.stop(signal.SIGKILL) == -signal.SIGKILL
            await until(lambda: driver.status.link is not Link.STREAMING, 0.25, driver.status)
            assert isinstance(driver.status.error, HalError)
            await asyncio.to_thread(receiver.start)
            seen = len(blocks)
            await until(lambda seen=seen: len(blocks) > seen + 3, START_S, driver.status)  # type: ignore[misc]  # bound
        assert [block.seq for block in blocks] == sorted({block.seq for block in blocks})
        assert threading.active_count() <= threads + 1  # one to wait in, of the event loop
        assert len(os.listdir("/proc/self/fd")) <= files + 2  # noqa: PTH208 - count only


async def test_a_receiver_that_is_stopped_for_a_while(tmp_path: Path) -> None:
    """SIGSTOP: nothing is closed, nothing answers."""
    async with a_receiver(tmp_path) as (receiver, driver, blocks):
        assert receiver.process is not None
        receiver.process.send_signal(signal.SIGSTOP)
        try:
            await until(lambda: driver.status.link is not Link.STREAMING, 0.25, driver.status)
            await until(lambda: "has not returned for 3 s" in str(driver.status.error), 3.0, driver.status)
            await until(lambda: "the bus server does not answer" in str(driver.status.error), 3.0, driver.status)
        finally:
            receiver.process.send_signal(signal.SIGCONT)
        seen = len(blocks)
        await until(lambda: len(blocks) > seen + 5 and driver.status.error is None, 6.0, driver.status)


def test_probe_of_a_receiver(tmp_path: Path) -> None:
    receiver = Receiver(tmp_path)
    receiver.start()
    try:
        (finding,) = asyncio.run(probe_buses(open_bus, [receiver.where]))
        assert [(chip.address, chip.usable) for chip in finding.chips] == [(0x48, False), (0x4D, True)]
    finally:
        receiver.stop()

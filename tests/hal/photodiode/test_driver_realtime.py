"""The whole driver in real time: its thread, smbus2, and a model of the kernel under it."""

import asyncio
import errno
import logging
import time

import pytest

from hal.adc import Blemish
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import DeviceFault, DeviceRefused
from hal.fake.adc.converter import FakeAdc
from tests.hal.bus.i2c_kernel import Kernel
from tests.hal.photodiode.bench import Bench, Light, error_of, falsehoods

pytestmark = pytest.mark.realtime
SLACK = 4.0
ROUGH = (0.05, 0.3e-3)
"""Error of rates, relative, and of times: the shortest of three reads is 0.3 ms late on a computer that is busy."""


def on_kernel(monkeypatch: pytest.MonkeyPatch) -> tuple[Bench, Kernel]:
    clock = SystemClock()
    light = Light()
    device = FakeAdc(light, clock)
    linux = Kernel(monkeypatch, device)
    return Bench(clock, open_bus, "/dev/i2c-1", light=light, fake=device), linux


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What was told, but for what a busy computer's own slowness makes of the adapter: that is measured, and true."""
    said = [record.getMessage() for record in caplog.records]
    return [one for one in said if "samples cannot be used to decode lamps" not in one]


async def test_blocks_of_the_light_at_its_times(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, _ = on_kernel(monkeypatch)
    driver = bench.driver()
    async with bench.running(driver):
        blocks = await bench.more(20, 3.0 * SLACK, driver)
        assert driver.status.error is None
    assert falsehoods(bench, blocks, *ROUGH) == []
    assert not any(block.blemish & ~(Blemish.STRETCHED | Blemish.GAP) for block in blocks)


async def test_a_loop_without_time_loses_blocks_and_counts_them(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, _ = on_kernel(monkeypatch)
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(3, 3.0 * SLACK, driver)
        before = driver.status.dropped
        time.sleep(0.4)  # noqa: ASYNC251 - the loop has no time, that is the test
        blocks = await bench.more(4, 1.0 * SLACK, driver)
        assert driver.status.dropped - before >= 2
    numbers = [block.seq for block in bench.blocks]
    assert numbers[-1] == len(numbers) - 1 + driver.status.dropped
    assert any(Blemish.GAP in block.blemish for block in blocks)
    assert falsehoods(bench, bench.blocks, *ROUGH) == []


async def test_errors_of_the_kernel(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    bench, linux = on_kernel(monkeypatch)
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(3, 3.0 * SLACK, driver)
        linux.fails = [errno.EAGAIN, 0, errno.EREMOTEIO, errno.EREMOTEIO]
        await bench.more(5, 2.0 * SLACK, driver)
        assert linux.closed == 0
        assert not told(caplog)
        linux.fails = [errno.ENODEV]
        await bench.more(5, 4.0 * SLACK, driver)
        assert linux.closed == 1  # opened anew by its name
        assert linux.paths == ["/dev/i2c-1"] * 2
    assert falsehoods(bench, bench.blocks, *ROUGH) == []
    assert told(caplog) == [
        "photodiode: /dev/i2c-1: the adapter was removed (connect it or start its server again; the daemon reopens it)",
        "/dev/i2c-1: MCP3221 at 0x4d delivers samples again",
    ]


async def test_a_kernel_driver_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, linux = on_kernel(monkeypatch)
    linux.claimed = {0x4D}
    driver = bench.driver()
    async with bench.running(driver):
        await asyncio.sleep(0.3)
        assert isinstance(error_of(driver), DeviceRefused)
        assert "address 0x4d is in use by another lumiloop or program, or by a kernel driver" in str(error_of(driver))


async def test_a_second_program_gets_the_converter_when_the_first_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes none of the first one's time on the bus, and needs nobody to begin when it is free."""
    monkeypatch.setattr("hal.photodiode.driver._PAUSE_S", (0.05, 0.2))
    bench, _ = on_kernel(monkeypatch)
    first, second = bench.driver(), bench.driver()
    async with bench.running(first):
        await bench.more(3, 3.0 * SLACK, first)
        async with bench.running(second):
            async with asyncio.timeout(3.0 * SLACK):
                while second.status.error is None:  # it opens in a thread of its own, which a busy computer keeps
                    await bench.more(1, 3.0 * SLACK, first)
            await bench.more(10, 3.0 * SLACK, first)  # and goes on being refused
            assert isinstance(error_of(second), DeviceRefused)
            assert "another lumiloop or its bus server uses address 0x4d" in str(error_of(second))
            assert second.status.blocks == 0
            assert first.status.error is None
    async with bench.running(second):
        await bench.more(3, 3.0 * SLACK, second)
        assert second.status.blocks >= 3


async def test_a_transaction_that_hangs_in_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop goes on, the status says so, and no second thread is started on the bus meanwhile."""
    monkeypatch.setattr("hal.photodiode.bus_watchdog.HANG_S", 0.4)
    bench, linux = on_kernel(monkeypatch)
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(3, 3.0 * SLACK, driver)
        linux.hang = True
        await asyncio.sleep(1.5)
        assert isinstance(error_of(driver), DeviceFault)
        assert "has not returned for 0.4 s" in str(error_of(driver))
        assert len(linux.paths) == 1
        linux.hang = False
        await bench.more(3, 2.0 * SLACK, driver)
        assert driver.status.error is None
        assert driver.status.recoveries == 1


async def test_stopping_while_it_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, linux = on_kernel(monkeypatch)
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(3, 3.0 * SLACK, driver)
        linux.hang = True
        await asyncio.sleep(0.1)
        before = time.monotonic()
    assert time.monotonic() - before < 0.3 * SLACK
    linux.hang = False
    while not linux.closed:
        assert time.monotonic() - before < 2.0 * SLACK
        await asyncio.sleep(0.01)

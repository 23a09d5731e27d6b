"""Names of buses, messages that no kernel would take, and the memory bus."""

from __future__ import annotations

import asyncio
import errno
from itertools import pairwise

import pytest

from hal.bus.i2c import AsyncBus, Message, Transferred, check, read, write
from hal.bus.opening import blocking_opener, open_bus
from hal.clock import LoopClock, run_virtual
from hal.errors import DeviceMissing, DeviceRefused
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.faults.schedule import FaultSchedule


@pytest.mark.parametrize("name", ["", "1", "i2c-1", "serial:/dev/ttyACM0", "http://x", "udp://127.0.0.1:1"])
def test_a_name_of_no_kind_is_refused_with_the_kinds_there_are(name: str) -> None:
    with pytest.raises(DeviceRefused, match=r"not the name of an I2C bus .*adapter:NAME, unix:/path"):
        asyncio.run(open_bus(name))


def test_names_choose_the_kind() -> None:
    from hal.bus.i2c_linux import open_linux
    from hal.bus.i2c_remote import open_remote

    assert blocking_opener("/dev/i2c-1") is blocking_opener("adapter:bcm2835") is open_linux
    assert blocking_opener("unix:/run/x") is blocking_opener("tcp://robot:10941") is open_remote


@pytest.mark.parametrize(
    ("messages", "says"),
    [
        ((), "0 messages"),
        (tuple(read(0x4D, 2) for _ in range(43)), "43 messages"),
        ((read(0x4D, 8193),), "8193 bytes"),
        ((read(0x4D, 65538),), "65538 bytes"),  # would silently become 2 in 16 bits
        ((read(0x4D, 0),), "0 bytes"),
        ((write(0x4D, b""),), "0 bytes"),
        ((read(0x80, 2),), "0x80"),
        ((Message(0x4D, b"x", 2),), "a message must either write or read"),
    ],
)
def test_what_no_kernel_takes(messages: tuple[Message, ...], says: str) -> None:
    with pytest.raises(OSError, match=says) as caught:
        check(messages)
    assert caught.value.errno == errno.EINVAL


def test_the_longest_that_goes() -> None:
    check(tuple(read(0x7F, 8192) for _ in range(42)))


def on_memory(body: object, fault: str = "") -> None:
    async def main() -> None:
        clock = LoopClock(asyncio.get_running_loop())
        fake = FakeAdc(lambda t: 0.0 * t + 0.5, clock)
        buses = FakeBuses(clock)
        buses.plug("x", fake)
        schedule = FaultSchedule({"adc": fake})
        if fault:
            schedule.load(f"[[fault]]\n{fault}")
            await asyncio.sleep(1e-6)
        await body(await buses("x"), fake)  # type: ignore[operator]  # an async function of the test
        schedule.close()

    run_virtual(main(), start=50.0)


def test_a_memory_bus_takes_the_time_of_its_bits() -> None:
    async def body(bus: AsyncBus, fake: FakeAdc) -> None:
        loop = asyncio.get_running_loop()
        before = loop.time()
        done = await bus.transfer((read(0x4D, 1000),))
        assert done.reads == (b"\x08\x00" * 500,)
        assert done.t0 == before
        assert loop.time() == pytest.approx(done.t1)
        assert done.t1 - done.t0 == pytest.approx(9010 / 400e3, abs=1e-4)

    on_memory(body)


def test_a_failure_takes_its_time_too() -> None:
    async def body(bus: AsyncBus, fake: FakeAdc) -> None:
        before = asyncio.get_running_loop().time()
        with pytest.raises(TimeoutError):
            await bus.transfer((read(0x4D, 1000),))
        assert asyncio.get_running_loop().time() - before == pytest.approx(1.0, abs=1e-3)

    on_memory(body, "what = 'timeout'")


def test_transactions_take_turns_with_a_stream() -> None:
    async def body(bus: AsyncBus, fake: FakeAdc) -> None:
        got: list[Transferred] = []
        task = asyncio.create_task(bus.stream((read(0x4D, 2222),), lambda done, dropped: got.append(done)))
        await asyncio.sleep(0.12)
        between = await bus.transfer((read(0x4D, 2),))
        await asyncio.sleep(0.2)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert len(got) >= 5
        assert any(early.t1 <= between.t0 < between.t1 <= late.t0 for early, late in pairwise(got))

    on_memory(body)


def test_an_unplugged_adapter_stays_dead_for_whoever_had_it_open() -> None:
    async def body(bus: AsyncBus, fake: FakeAdc) -> None:
        schedule = FaultSchedule({"adc": fake})
        schedule.load("[[fault]]\nwhat = 'gone'\nfor = 1.0")
        await asyncio.sleep(0.5)
        for _ in range(2):
            with pytest.raises(OSError, match="No such device"):
                await bus.transfer((read(0x4D, 2),))
            await asyncio.sleep(1.0)
        schedule.close()

    on_memory(body)


@pytest.mark.virtual
async def test_an_opener_says_what_is_plugged_in() -> None:
    clock = LoopClock(asyncio.get_running_loop())
    buses = FakeBuses(clock)
    buses.plug("/dev/i2c-1", FakeAdc(lambda t: t, clock))
    with pytest.raises(DeviceMissing, match=r"no such bus .plugged in: /dev/i2c-1"):
        await buses("/dev/i2c-2")

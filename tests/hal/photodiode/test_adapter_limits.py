"""How long a read an adapter carries through."""

import asyncio
import errno
import os

import pytest

from hal.clock import LoopClock, run_virtual
from hal.errors import DeviceRefused
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.adc.i2c_adapters import BCM2835, CH341, CP2112, DESIGNWARE, FT260, MCP2221, Adapter
from hal.fake.faults.schedule import FaultSchedule
from hal.photodiode.adapter_limits import AdapterLimits, measure
from tests.hal.photodiode.bench import Light


def measured(adapter: Adapter, block_s: float = 0.05, fault: str = "") -> tuple[AdapterLimits, FakeAdc]:
    async def main() -> tuple[AdapterLimits, FakeAdc]:
        clock = LoopClock(asyncio.get_running_loop())
        fake = FakeAdc(Light(), clock, adapter=adapter)
        buses = FakeBuses(clock)
        buses.plug("x", fake)
        schedule = FaultSchedule({"adc": fake})
        schedule.load(f"[[fault]]\n{fault}" if fault else "")
        await asyncio.sleep(1e-6)
        try:
            return await measure(await buses("x"), fake.address, block_s), fake
        finally:
            schedule.close()

    return run_virtual(main())


@pytest.mark.parametrize("adapter", [BCM2835, DESIGNWARE], ids=["bcm2835", "designware"])
@pytest.mark.parametrize("block_s", [0.01, 0.05, 0.18])
def test_a_controller_reads_what_is_wanted(adapter: Adapter, block_s: float) -> None:
    found, _ = measured(adapter, block_s)
    assert found.length == pytest.approx(block_s * 400e3 / 9, abs=6)
    assert found.scl_hz == pytest.approx(400e3, rel=1e-3)
    assert found.limit == ""


def test_8192_bytes_are_the_longest() -> None:
    found, _ = measured(DESIGNWARE, 0.5)
    assert found.length == 8192
    assert found.limit == ""


@pytest.mark.parametrize(
    ("adapter", "length"), [(FT260, 60), (MCP2221, 60), (CP2112, 60), (CH341, 60)], ids=lambda v: str(v)[:20]
)
def test_bridges_pause(adapter: Adapter, length: int) -> None:
    found, _ = measured(adapter)
    assert found.length == length
    assert found.limit


def test_a_pause_is_found_without_knowing_the_name() -> None:
    found, _ = measured(Adapter("something", chunk=700, chunk_pause_s=2e-3))
    assert found.length == 512
    assert "pauses inside 2048 bytes" in found.limit


def test_a_short_time_out_is_found() -> None:
    """The old bcm2708 driver gave up after 150 ms: 1.5 kB at 100 kHz."""
    found, fake = measured(Adapter("old", scl_hz=100e3, timeout_s=0.15, fails_after_timeout=True), 0.3)
    assert found.length == 512
    assert found.limit == "2048 bytes: Connection timed out"
    assert not fake.bus.gone()


def test_an_adapter_with_a_limit() -> None:
    found, _ = measured(Adapter("small", max_read=1000))
    assert (found.length, found.limit) == (512, "2048 bytes: Operation not supported")


def test_what_cannot_read_a_block_at_all() -> None:
    with pytest.raises(
        DeviceRefused,
        match=r"at once .60 bytes: Operation not.*without any, use an I2C controller of the",
    ):
        measured(Adapter("tiny", max_read=32))


def test_passing_errors_do_not_count() -> None:
    found, fake = measured(BCM2835, fault="what = 'nack'; on = 'all'; every = 4".replace("; ", "\n"))
    assert found.length == pytest.approx(2222, abs=6)
    assert fake.orders.struck["nack"] > 5


@pytest.mark.parametrize("name", ["ENXIO", "EREMOTEIO", "ENODEV", "EBUSY"])
def test_lasting_errors_do(name: str) -> None:
    with pytest.raises(OSError, match=os.strerror(getattr(errno, name))):
        measured(BCM2835, fault=f"what = 'error'\nname = '{name}'\non = 'all'")

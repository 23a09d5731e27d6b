"""Looking for converters: who answers is named, nothing is changed, and every trouble comes with its remedy."""

import asyncio
import errno
from pathlib import Path

import numpy as np
import pytest

import hal.bus.i2c_linux
from hal.bus.opening import open_bus
from hal.clock import LoopClock, run_virtual
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused
from hal.fake.adc.chips import Adc121c021, Eeprom24c02, Lm75, Mcp3221
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.adc.i2c_adapters import BCM2835, DESIGNWARE, FT260, Adapter
from hal.fake.faults.schedule import FaultSchedule
from hal.photodiode.probe import ADDRESSES, BusFinding, probe_buses
from tests.hal.bus.i2c_kernel import kernel
from tests.hal.photodiode.bench import Light


def looked_at(adapter: Adapter = BCM2835, fault: str = "", crowd: bool = False) -> tuple[BusFinding, FakeAdc]:
    async def main() -> tuple[BusFinding, FakeAdc]:
        clock = LoopClock(asyncio.get_running_loop())
        fake = FakeAdc(Light(), clock, adapter=adapter)
        fake.add_level(lambda t: np.full_like(t, 0.4))
        if crowd:
            fake.bus.chips |= {0x49: Lm75(), 0x4F: Mcp3221(Light()), 0x50: Eeprom24c02(), 0x54: Adc121c021(Light())}
        buses = FakeBuses(clock)
        buses.plug("x", fake)
        schedule = FaultSchedule({"adc": fake})
        schedule.load(f"[[fault]]\n{fault}" if fault else "")
        await asyncio.sleep(1e-6)
        (finding,) = await probe_buses(buses, ["x"])
        schedule.close()
        return finding, fake

    return run_virtual(main())


@pytest.mark.parametrize("adapter", [BCM2835, DESIGNWARE, FT260], ids=lambda a: a.name.split()[0])
def test_converters_are_named_and_told_from_others(adapter: Adapter) -> None:
    finding, _ = looked_at(adapter, crowd=True)
    assert finding.error is None
    assert [(chip.address, chip.name, chip.usable) for chip in finding.chips] == [
        (0x48, "ADS1015 or ADS1115", False),
        (0x49, "", False),
        (0x4D, "MCP3221", True),
        (0x4F, "MCP3221", True),
        (0x50, "", False),
        (0x54, "ADC121C021", True),
    ]
    assert str(finding).startswith(f"x: {adapter.name}\n  0x48: ADS1015 or ADS1115 (levels only")
    assert "\n  0x49: an unsupported device" in str(finding)


@pytest.mark.virtual
async def test_nothing_is_changed() -> None:
    fake = FakeAdc(Light(), LoopClock(asyncio.get_running_loop()))
    adc, memory = Adc121c021(Light()), Eeprom24c02()
    adc.registers[2:6] = [0x24, 0x0123, 0x0456, 0x0007]
    memory.values = {k: bytes([0]) for k in range(256)}
    fake.bus.chips |= {0x50: memory, 0x54: adc}
    buses = FakeBuses(LoopClock(asyncio.get_running_loop()))
    buses.plug("x", fake)
    before, contents = adc.registers[2:6], dict(memory.values)
    await probe_buses(buses, ["x"])
    assert adc.registers[2:6] == before
    assert memory.values == contents


@pytest.mark.parametrize(
    ("fault", "noun", "says"),
    [
        ("what = 'gone'", DeviceMissing, "no such bus"),
        ("what = 'refuse'", DeviceRefused, "permission denied .*group i2c"),
        ("what = 'hang'", DeviceFault, "the bus is stuck .*SDA or SCL"),
    ],
)
def test_trouble_comes_with_its_remedy(fault: str, noun: type, says: str) -> None:
    finding, fake = looked_at(fault=fault)
    assert isinstance(finding.error, noun)
    assert finding.error.remedy
    with pytest.raises(AssertionError, match=says):
        raise AssertionError(str(finding))
    assert fake.bus.transactions <= 1  # a bus that hangs is not asked for seventeen seconds


def test_an_empty_bus() -> None:
    finding, fake = looked_at(fault="what = 'off'")
    assert [chip.address for chip in finding.chips] == [0x48]
    assert fake.bus.transactions >= len(ADDRESSES)


def test_buses_of_this_computer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert "i2c-dev" in hal.bus.i2c_linux.ENABLE
    monkeypatch.setattr(hal.bus.i2c_linux, "DEV", tmp_path)
    assert hal.bus.i2c_linux.buses() == []
    for name in ("i2c-10", "i2c-1", "i2c-2", "i2c-stub", "ttyS0"):
        (tmp_path / name).touch()
    assert [Path(bus).name for bus in hal.bus.i2c_linux.buses()] == ["i2c-1", "i2c-2", "i2c-10"]


def test_through_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    linux = kernel(monkeypatch)
    linux.claimed = {0x48}
    (finding,) = asyncio.run(probe_buses(open_bus, ["/dev/i2c-1"]))
    assert [str(chip) for chip in finding.chips] == [
        "0x48: in use by another program or a kernel driver; end or unbind it first",
        "0x4d: MCP3221",
    ]
    assert linux.closed == 1
    linux.open_error = errno.EACCES
    (finding,) = asyncio.run(probe_buses(open_bus, ["/dev/i2c-1"]))
    assert isinstance(finding.error, DeviceRefused)
    assert "group i2c" in str(finding)

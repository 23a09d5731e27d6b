"""Whether a device is there at all: looked at before the first test of it, so that what is missing is said once."""

import asyncio
from dataclasses import dataclass, field

import pytest

from hal.bus.i2c import NACKS, AsyncBus, BusOpener, read
from hal.bus.opening import open_bus
from hal.errors import DeviceMissing, HalError
from hal.photodiode.io_errors import explain, policy_for
from hal.photodiode.probe import probe_bus
from tests.hil.ends import AdcEnd, LidarEnd


def lidar_lacks(name: str) -> HalError | None:
    """Why nothing can be tried on this lidar; None: it answers."""
    return asyncio.run(LidarEnd(name).identify()).error


def adc_lacks(name: str, opener: BusOpener = open_bus) -> HalError | None:
    """Why nothing can be tried on this converter; None: something answers at its address."""
    return asyncio.run(_adc_lacks(AdcEnd(name, opener=opener)))


async def _adc_lacks(end: AdcEnd) -> HalError | None:
    """Its own address alone is asked: what else is on the bus, and may be at fault, is no reason to try nothing."""
    try:
        bus = await end.opener(end.bus)
    except HalError as error:
        return error
    try:
        wrong = await _answers(bus, end.address)
    finally:
        await bus.close()
    if wrong is None:
        return None
    if wrong.errno in NACKS:
        there = [hex(chip.address) for chip in (await probe_bus(end.opener, end.bus)).chips]
        remedy = f"name one of {', '.join(there)} with --adc" if there else "check power, SDA and SCL"
        return DeviceMissing(end.bus, f"nothing answers at {end.address:#04x}", remedy)
    return explain(wrong, end.bus, end.chip, end.address)


async def _answers(bus: AsyncBus, address: int) -> OSError | None:
    """What is wrong with a read of two bytes; tried again as often, and after such pauses, as the driver does it."""
    tries = 0
    while True:
        try:
            await bus.transfer((read(address, 2),))
            return None
        except OSError as error:
            policy = policy_for(error)
            if tries >= policy.retries:
                return error
            tries += 1
            await asyncio.sleep(policy.pause_s)


LACKS = {"lidar": lidar_lacks, "adc": adc_lacks}


@dataclass
class Presence:
    """What is known of the devices of this run, by option and name."""

    found: set[tuple[str, str]] = field(default_factory=set)
    missing: dict[tuple[str, str], HalError] = field(default_factory=dict)

    def demand(self, option: str, name: str) -> None:
        """The first test of a device that is not there fails and says why; the others are not run for that reason."""
        device = option, name
        if (error := self.missing.get(device)) is not None:
            pytest.skip(f"not run: {error.device}: {error.problem}")
        if device in self.found:
            return
        if (error := LACKS[option](name)) is not None:
            self.missing[device] = error
            pytest.fail(f"--{option}={name} cannot be used, no test of it is run: {error}", pytrace=False)
        self.found.add(device)

    def doubt(self) -> None:
        """A test has failed: each device is looked at again before the next one."""
        self.found.clear()

"""Whether a device is there at all: looked at before the first test of it, so that what is missing is said once."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

import pytest

from hal.errors import DeviceMissing, HalError
from hal.photodiode.probe import probe_bus
from hal.probe import identify_at
from tests.hil.ends import AdcEnd, LidarEnd


def lidar_lacks(name: str) -> HalError | None:
    """Why nothing can be tried on this lidar; None: it answers."""
    end = LidarEnd(name)
    return asyncio.run(identify_at(end.opener, end.device)).error


def adc_lacks(name: str) -> HalError | None:
    """Why nothing can be tried on this converter; None: something answers at its address."""
    end = AdcEnd(name)
    finding = asyncio.run(probe_bus(end.opener, end.bus))
    there = {chip.address for chip in finding.chips}
    if finding.error is not None or end.address in there:
        return finding.error
    remedy = f"name one of {', '.join(map(hex, sorted(there)))} with --adc" if there else "check power, SDA and SCL"
    return DeviceMissing(end.bus, f"nothing answers at {end.address:#04x}", remedy)


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

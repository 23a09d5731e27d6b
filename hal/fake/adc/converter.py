"""The fake light receiver: a converter and an optional DC channel on a simulated bus, with fault injection.

A :data:`hal.fake.adc.chips.SampleSource` of a simulator supplies the light. The same object is a memory bus under
virtual time and, behind :class:`hal.bus.i2c_server.BusServer`, a bus of this computer in real time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.bus.i2c import AsyncBus, Message
from hal.bus.i2c_memory import LoopBus
from hal.clock import Clock
from hal.errors import DeviceMissing, DeviceRefused
from hal.fake.adc.chips import Adc121c021, Ads1x15, Eeprom24c02, FakeChip, Lm75, Mcp3221, SampleSource
from hal.fake.adc.faults import ADC
from hal.fake.adc.i2c_adapters import BCM2835, Adapter
from hal.fake.adc.i2c_bus import FakeBus, Transaction
from hal.fake.adc.i2c_timing import Times
from hal.fake.faults.orders import Fault, FaultError, Vocabulary
from hal.fake.faults.schedule import ActiveFaults

MIDDLE: Final = 0.5
"""Rest level of an AC-coupled input, as a fraction of the supply."""
OWN_NOISE: Final = 1.1e-4
"""Noise of amplifier and converter without light, one sigma as a fraction of the supply: 0.45 words of 12 bits."""

CHIPS: Final[dict[str, Callable[[SampleSource], FakeChip]]] = {
    "MCP3221": Mcp3221,
    "ADC121C021": Adc121c021,
    "ADS1115": Ads1x15,
    "ADS1015": lambda source: Ads1x15(source, bits=12),
    "LM75": lambda _source: Lm75(),
    "24C02": lambda _source: Eeprom24c02(),
}


class FakeAdc:
    """One bus with one converter and an optional DC channel; a :class:`hal.fake.faults.schedule.Target`.

    Args:
        source: the signal at the converter. clock: the loop's.
        chip: of the converter, a key of :data:`CHIPS`. address: of the converter.
        adapter: of the host. seed: of jitter and of random faults.
    """

    def __init__(
        self,
        source: SampleSource,
        clock: Clock,
        *,
        chip: str = "MCP3221",
        address: int = 0x4D,
        adapter: Adapter = BCM2835,
        seed: int = 0,
    ) -> None:
        self._source, self._clock = source, clock
        self._noise = np.random.default_rng(seed)
        self.address = address
        self.bus = FakeBus(adapter, clock.now, seed=seed)
        self._chip = CHIPS[chip](self._signal)
        self._dc: tuple[int, FakeChip] | None = None
        self.unplugged = 0
        self._arrange()

    def add_level(self, source: SampleSource, address: int = 0x48, chip: str = "ADS1115") -> None:
        """Add a DC channel: ``source`` is the amplifier's output before the coupling capacitor."""

        def level(t_mono: Times) -> npt.NDArray[np.float64]:
            if self.orders.on("dark"):
                return np.zeros_like(t_mono)
            return np.ones_like(t_mono) if self.orders.on("saturated") else source(t_mono)

        self._dc = (address, CHIPS[chip](level))
        self._arrange()

    @property
    def orders(self) -> ActiveFaults:
        """The faults in force, and the number of strikes of each word."""
        return self.bus.orders

    @property
    def vocabulary(self) -> Vocabulary:
        """The words of its fault orders."""
        return ADC

    def in_force(self) -> list[Fault]:
        """Faults neither lifted nor used up."""
        return self.orders.in_force()

    def check(self, fault: Fault) -> None:
        """Refuse an order that this receiver cannot carry out.

        Raises:
            FaultError: ``dc_off`` or ``foreign`` without a DC channel, ``moved`` to the address of another chip.
        """
        if fault.what in ("dc_off", "foreign") and self._dc is None:
            raise FaultError(fault.what, "this receiver has no DC channel")
        taken = {self.address} | ({self._dc[0]} if self._dc else set())
        if fault.what == "moved" and int(fault.number("address")) in taken:
            raise FaultError("moved.address", "another device has this address already")

    def begin(self, fault: Fault) -> None:
        """A fault comes into force (one that happens once happens now)."""
        if ADC[fault.what].kind == "once":
            self._power_on()
            return
        self.orders.add(fault)
        if fault.what == "gone":
            self.unplugged += 1
        self._arrange()
        if fault.what == "foreign":
            self._write_foreign(fault)

    def end(self, fault: Fault) -> None:
        """A fault is lifted."""
        self.orders.remove(fault)
        self._arrange()
        if fault.what in ("off", "gone", "replaced"):
            self._power_on()

    def _write_foreign(self, fault: Fault) -> None:
        """Let the other program write its configuration to the DC channel's chip, now and again."""
        chip = self._dc[1] if self._dc else None
        if not isinstance(chip, Ads1x15):
            return
        if self.orders.on("foreign") is not fault:
            chip.second_v = None
            return
        chip.second_v = fault.number("volts")
        now = self._clock.now()
        chip.write(b"\x01" + int(fault.number("config")).to_bytes(2, "big"), now)
        chip.write(b"\x00", now)
        asyncio.get_running_loop().call_later(fault.number("every_s"), self._write_foreign, fault)

    def _power_on(self) -> None:
        for chip in self.bus.chips.values():
            chip.power_on(self._clock.now())

    def _arrange(self) -> None:
        """Set the chips at their present addresses."""
        moved, replaced = self.orders.on("moved"), self.orders.on("replaced")
        chip = CHIPS[replaced.text("chip")](self._signal) if replaced else self._chip
        where = int(moved.number("address")) if moved else self.address
        self.bus.chips = {where: chip}
        self.bus.converter = self.address
        if self._dc is not None and not self.orders.on("dc_off"):
            self.bus.chips[self._dc[0]] = self._dc[1]

    def _signal(self, t_mono: Times) -> npt.NDArray[np.float64]:
        """The input signal, altered by the faults in force."""
        if self.orders.on("dark") or self.orders.on("saturated"):
            return MIDDLE + OWN_NOISE * self._noise.standard_normal(t_mono.size)
        fraction = self._source(t_mono)
        clip = self.orders.on("clip")
        if not clip:
            return fraction
        stop = clip.number("stop")
        return np.clip(MIDDLE + clip.number("gain") * (fraction - MIDDLE), stop, 1.0 - stop)


class _Handle:
    """One open handle of a memory bus: dead once the adapter has been unplugged."""

    def __init__(self, device: FakeAdc) -> None:
        self._device, self._unplugged = device, device.unplugged

    @property
    def about(self) -> str:
        return self._device.bus.about

    def begin(self, messages: tuple[Message, ...]) -> Transaction:
        return self._device.bus.begin(messages, dead=self._device.unplugged != self._unplugged)


class FakeBuses:
    """A :class:`hal.bus.i2c.BusOpener` under which fake converters are plugged in by the name of their bus.

    Args:
        clock: the loop's, real or virtual.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._devices: dict[str, FakeAdc] = {}
        self.opened = 0

    def plug(self, name: str, device: FakeAdc) -> None:
        """Make the bus of ``device`` openable as ``name``."""
        self._devices[name] = device

    async def __call__(self, name: str) -> AsyncBus:
        """Open a bus.

        Raises:
            DeviceMissing: no bus of that name, or its adapter is unplugged. DeviceRefused: by a fault order.
        """
        device = self._devices.get(name)
        if device is None or device.orders.on("gone"):
            there = ", ".join(sorted(n for n, d in self._devices.items() if not d.orders.on("gone"))) or "nothing"
            raise DeviceMissing(name, "no such bus", f"plugged in: {there}")
        refused = device.orders.on("refuse")
        if refused and refused.text("why") == "permission":
            raise DeviceRefused(name, "permission denied", "add the user to group i2c and log in again")
        if refused:
            raise DeviceRefused(name, "in use by another program", f"find it with: fuser -v {name}")
        self.opened += 1
        return LoopBus(name, _Handle(device), self._clock)

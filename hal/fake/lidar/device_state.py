"""State shared by the parts of the fake sensor: mode, laser, clock, output line, faults in force, timers."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from random import Random

from hal.fake.faults.orders import Fault
from hal.fake.faults.schedule import ActiveFaults
from hal.fake.lidar.damage import DAMAGE, splice
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import LidarModel, Unit
from hal.fake.lidar.output_line import OutputLine, Pacing
from hal.fake.lidar.sensor_clock import SensorClock

LINE_RATES = {"usb": 1.0e6, "ethernet": 12.5e6}
"""Bytes per second; RS-232 follows its baud rate, ten bit times a byte."""


class DeviceState:
    """Shared state of the sensor. All times are the loop's.

    Attributes:
        clock: the 24-bit clock. output: the line to the host. orders: faults in force.
        state, laser, baud: present mode, laser state and line rate. ready_at: time from which the motor turns.
        trouble: replaces the health text of II. started: time of the latest start.
    """

    def __init__(self, model: LidarModel, unit: Unit, loop: asyncio.AbstractEventLoop) -> None:
        self.model, self.unit, self.loop = model, unit, loop
        self.chance = Random(unit.seed)
        self.clock = SensorClock(loop.time(), unit.clock_ms, unit.clock_gain)
        self.orders = ActiveFaults(unit.seed + 1)
        self.baud = unit.baud
        self.output = OutputLine(loop, Pacing(rate=self.line_rate()), self._received)
        self.state = State.IDLE
        self.laser = False
        self.laser_since = self.ready_at = loop.time()
        self.trouble = ""
        self.started = -math.inf
        self.foreign: Callable[[str], bytes] = lambda _command: b""
        self._timers: dict[str, asyncio.TimerHandle] = {}

    def now(self) -> float:
        """The loop's time."""
        return self.loop.time()

    def at(self, name: str, when: float, call: Callable[[], None]) -> None:
        """Call at a time; replaces a timer of the same name."""
        self.cancel(name)
        self._timers[name] = self.loop.call_at(when, call)

    def cancel(self, name: str) -> None:
        """Cancel a timer if it is set."""
        if name in self._timers:
            self._timers.pop(name).cancel()

    def cancel_all(self) -> None:
        """Cancel every timer."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()

    def not_ready(self) -> Fault | None:
        """The fault by which the sensor does not measure yet after its start; None where it measures."""
        fault = self.orders.on("not_ready")
        return fault if fault and self.now() < self.started + fault.number("by_s") else None

    def line_rate(self) -> float:
        """Bytes per second of the line."""
        return LINE_RATES.get(self.model.link, self.baud / 10.0)

    def use_baud(self, baud: int) -> None:
        """Change the line rate."""
        self.baud = baud
        self.output.pacing.rate = self.line_rate()

    def at_same_rate(self) -> bool:
        """False where the host's line rate is known and differs from that of an RS-232 sensor."""
        host = self.output.host
        return self.model.link != "rs232" or host is None or host.baud() in (0, self.baud)

    def _received(self, data: bytes) -> bytes:
        return data if self.at_same_rate() else self.chance.randbytes(len(data))

    def laser_on(self, state: State) -> None:
        """Switch the laser on and set the mode."""
        if not self.laser:
            self.laser_since = self.now()
        self.laser, self.state = True, state

    def laser_off(self, state: State) -> None:
        """Switch the laser off and set the mode."""
        self.laser, self.state = False, state

    def send(self, reply: bytes, *, is_scan: bool = False) -> None:
        """Send a reply to the host, altered by the faults in force."""
        orders, on = self.orders, "scans" if is_scan else "replies"
        if orders.on("silence") or orders.on("off") or orders.strike("intermittent", on=on):
            return
        fault = orders.strike("alien_reply") if is_scan else None
        if fault:
            reply = splice(reply, self.foreign(fault.text("command")), self.chance)
        for what, harm in DAMAGE.items():
            fault = orders.strike(what, on=on)
            if fault:
                reply = harm(reply, fault, self.chance)
        delayed = orders.on("delayed")
        after = delayed.number("by_s") if delayed else 0.0
        self.output.send(reply, is_scan=is_scan, delay=after)

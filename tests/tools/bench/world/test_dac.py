"""Light through a DAC: lamps are decoded behind its low pass, in order."""

import asyncio
from collections.abc import Callable, Generator

import numpy as np

from hal.bus.i2c import Message, Transferred
from tests.daemon.scenarios.test_lights import Bench, run_daemon
from tests.daemon.support.light_room import CODES, Lit
from tools.bench.world.dac import Player

Floats = np.ndarray
LOW_PASS_S = 47e-6
"""4.7 kOhm and 10 nF."""


class Wire:
    """A bus with an MCP4725 that keeps what it puts out, decoded by the data sheet; its own SCL, pauses between."""

    name, about = "/dev/i2c-9", "fake"

    def __init__(self, start: float, scl_hz: float, pause_s: float) -> None:
        self.now, self.scl_hz, self.pause_s = start, scl_hz, pause_s
        self.times: list[Floats] = []
        self.words: list[Floats] = []

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        (message,) = messages
        assert message.address == 0x60
        pairs = np.frombuffer(message.data, dtype=np.uint8).reshape(-1, 2).astype(int)
        assert not (pairs[:, 0] & 0xF0).any(), "C2 C1 = 00: fast mode, PD1 PD0 = 00: not powered down"
        self.now += self.pause_s
        t0 = self.now
        self.times.append(t0 + (10 + 18 * (1 + np.arange(len(pairs)))) / self.scl_hz)
        self.words.append((pairs[:, 0] & 0x0F) << 8 | pairs[:, 1])
        self.now += (11 + 18 * len(pairs)) / self.scl_hz
        return Transferred(t0, self.now, ())

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        while True:
            yield self.transfer(messages)

    def release(self) -> None:
        """Nothing is held."""

    def close(self) -> None:
        """Nothing is open."""

    def voltage(self, tau_s: float) -> Callable[[Floats], Floats]:
        """Behind a low pass, as a fraction of the supply; the output holds between its steps."""
        times, steps = np.concatenate(self.times), np.concatenate(self.words) / 4096.0
        at_step = np.empty(len(steps))
        now = steps[0]
        for k, decay in enumerate(np.exp(-np.diff(times, append=times[-1]) / tau_s)):
            at_step[k] = now
            now = steps[k] + (now - steps[k]) * decay

        def at(t_mono: Floats) -> Floats:
            k = np.maximum(np.searchsorted(times, t_mono, side="right") - 1, 0)
            return np.asarray(steps[k] + (at_step[k] - steps[k]) * np.exp(-np.maximum(t_mono - times[k], 0.0) / tau_s))

        return at


def test_lamps_are_told_apart_and_in_order_through_the_dac() -> None:
    """Light to voltage to converter to daemon: every ID, strongest first."""
    wire = Wire(99.9, 397e3, 0.3e-3)
    player = Player(wire, 0x60, Lit(), lambda: wire.now)
    while wire.now < 102.7:
        player.block()

    async def scenario(bench: Bench) -> None:
        bench.adc._source = wire.voltage(LOW_PASS_S)  # the wire from the DAC's pin to the converter's
        await bench.until(lambda snapshot: snapshot.links == len(CODES), 2.0)
        await asyncio.sleep(0.5)
        result = bench.daemon.cycle.result
        assert result is not None
        assert result.lights is not None
        links = sorted(result.lights.links, key=lambda link: -link.amplitude)
        assert [link.code for link in links] == list(CODES)
        held = [snapshot.links == len(CODES) for snapshot in bench.snapshots[-10:]]
        assert all(held), "and goes on so"

    run_daemon(scenario)

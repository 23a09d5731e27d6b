"""Light as a voltage: an MCP4725 on the bench's I2C bus plays what the photodiode's amplifier would put out.

Microchip DS22039D: in fast mode (figure 6-1) a write is any number of byte pairs ``0 0 PD1 PD0 D11..D8``, ``D7..D0``
after one address byte, and the output follows each pair. A pair takes 18 clocks, at 400 kHz 22 222 pairs a second: as
often as an MCP3221 samples.

Two clocks of nearly the same rate beat: steps that a converter samples as they are look like a second, shifted signal,
and no lamp is decoded. A low pass of 3.4 kHz (4.7 kOhm, 10 nF) on the wire mends that.

What it proves is that lamps are told apart and in what order; their strengths come through a second converter, a
divider and steps of its own clock, so 0.1 % amplitudes are not proved this way.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.bus.i2c import Bus, Message, Transferred, write
from hal.bus.opening import blocking_opener
from hal.errors import DeviceRefused, HalError
from hal.fake.adc.chips import SampleSource
from hal.photodiode.io_errors import explain

ADDRESSES: Final = range(0x60, 0x68)
"""A2 and A1 are set at the factory, A0 by a pin."""
CLOCKS: Final = 18
OVERHEAD_CLOCKS: Final = 11
"""START, address with acknowledgement, STOP."""
PAIRS: Final = 1500
"""Of one transaction: 3001 bytes with the address, which every adapter's driver takes, 68 ms at 400 kHz."""
TOP: Final = 4095
FINER: Final = 4
"""A step is the mean of the light while it lasts."""
FOLLOW: Final = 0.1
HELD_UP: Final = 0.2
"""Of a block: begun that much beside the plan, the next one is planned anew."""
Floats = npt.NDArray[np.float64]


def encoded(fractions: Floats) -> bytes:
    """Fast-mode pairs of voltages as fractions of the supply; what is beyond it stands at the rail. PD1 = PD0 = 0."""
    codes = np.clip(np.rint(TOP * np.nan_to_num(fractions, nan=0.5)), 0, TOP).astype(">u2")
    return codes.tobytes()


class Player:
    """Plays a source block after block; where it stands between blocks, the output holds its last value.

    Args:
        bus: open. address: of the DAC. source: the voltage at instants of ``now``'s clock. now: seconds.
        rate_hz: pairs a second at first; the bus is then measured.
    """

    def __init__(
        self, bus: Bus, address: int, source: SampleSource, now: Callable[[], float] = time.monotonic,
        rate_hz: float = 400e3 / CLOCKS,
    ) -> None:  # fmt: skip
        if address not in ADDRESSES:
            raise DeviceRefused(bus.name, f"{address:#04x} is no address of an MCP4725", "it is one of 0x60 to 0x67")
        self._bus, self._address, self._source, self._now = bus, address, source, now
        self.rate_hz = rate_hz
        self.blocks = 0
        self.held_s = 0.0
        self._call_s, self._pause_s = 0.0, 0.5e-3
        self._ended: float | None = None
        self._next: tuple[float, Message] | None = None

    def block(self) -> None:
        """Play one; the one after it is made while this is on the bus. Raises `OSError` of the bus."""
        called = self._now()
        begins, message = self._next or self._made(called + self._call_s)
        making = threading.Thread(
            target=self._make_next, args=(called + self._call_s + self._length_s() + self._pause_s,)
        )
        making.start()
        try:
            done = self._bus.transfer((message,))
        finally:
            making.join()
        self.blocks += 1
        self._learn(called, done)
        if abs(done.t0 - begins) > HELD_UP * (done.t1 - done.t0):
            self._next = None  # what was made ahead is for another instant

    def _learn(self, called: float, done: Transferred) -> None:
        """What the bus really does: pairs a second, time until a block begins, pause between blocks."""
        part = max(1.0 / self.blocks, FOLLOW)
        took = done.t1 - done.t0
        rate = (PAIRS + OVERHEAD_CLOCKS / CLOCKS) / max(took, 1e-4)
        self.rate_hz += part * (rate - self.rate_hz)
        self._call_s += part * (done.t0 - called - self._call_s)
        if self._ended is not None:
            pause = max(done.t0 - self._ended, 0.0)
            self.held_s += pause
            self._pause_s += part * (min(pause, 0.1 * took) - self._pause_s)
        self._ended = done.t1

    def _length_s(self) -> float:
        return (PAIRS + OVERHEAD_CLOCKS / CLOCKS) / self.rate_hz

    def _make_next(self, begins: float) -> None:
        self._next = self._made(begins)

    def _made(self, begins: float) -> tuple[float, Message]:
        steps = 1.0 + np.arange(PAIRS * FINER) / FINER + 0.5 / FINER
        times = begins + (OVERHEAD_CLOCKS - 1 + CLOCKS * steps) / (CLOCKS * self.rate_hz)
        return begins, write(self._address, encoded(self._source(times).reshape(PAIRS, FINER).mean(axis=1)))


class DacThread:
    """Plays until it is closed; what ends it before that is kept as ``lost``."""

    def __init__(self, name: str, address: int, source: SampleSource) -> None:
        self._bus = blocking_opener(name)(name)
        self.player = Player(self._bus, address, source)
        self.lost: HalError | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, name="dac", daemon=True)
        self._thread.start()

    def _play(self) -> None:
        while not self._stop.is_set():
            try:
                self.player.block()
            except OSError as error:
                self.lost = explain(error, self._bus.name, "MCP4725", self.player._address)
                return

    def close(self) -> None:
        """Stop after the block that is on the bus."""
        self._stop.set()
        self._thread.join(2.0)
        self._bus.close()

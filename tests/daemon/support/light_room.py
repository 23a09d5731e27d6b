"""A photodiode at rest under a few coded lamps, as words of a fake converter on a fake bus; nothing finer."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter.survey import Lamp, Survey
from hal.adc import Blemish, RawSamples
from hal.clock import Clock
from hal.fake.adc.converter import FakeAdc, FakeBuses
from tools.sim.light import transmitter
from tools.sim.light.waveform import Ambient, Ceiling

BUS = "/dev/i2c-7"
Floats = npt.NDArray[np.float64]

CODES = (5, 17, 60, 101)
CURRENTS_A = (2.4e-6, 1.6e-6, 0.9e-6, 0.5e-6)

SURVEY = Survey(
    tuple(
        Lamp(100 + code, code, x, y, 2.6)
        for code, (x, y) in zip(CODES, ((0.8, 0.5), (-1.4, 0.9), (0.6, -2.0), (-2.2, -1.8)), strict=True)
    )
)


class Lit:
    """The converter's input under lamps that never change; it may be told other lamps while it runs."""

    def __init__(self, codes: Sequence[int] = CODES, currents_a: Sequence[float] = CURRENTS_A) -> None:
        self.under(codes, currents_a)

    def under(self, codes: Sequence[int], currents_a: Sequence[float] = CURRENTS_A) -> None:
        """Other lamps from now on."""
        lamps = [
            transmitter.Lamp(
                code=code, current_a=current, ppm=7.0 * n - 10.0, phase_chips=31.7 * n, lamp_id=code + 100,
                position_m=(1.5 * n, 2.0 - n, 2.6), data=True,
            )
            for n, (code, current) in enumerate(zip(codes, currents_a, strict=False))
        ]  # fmt: skip
        self._ceiling = Ceiling(lamps, Ambient(current_a=20e-6), seed=3)

    def __call__(self, t_mono: Floats) -> Floats:
        """Fraction of the converter's range at each instant."""
        ceiling = self._ceiling
        current = ceiling._signal(t_mono) + ceiling._tones(t_mono) + ceiling._noise(t_mono.size)
        return np.asarray(0.5 + current / ceiling.receiver.full_scale_a)


def plugged(clock: Clock, source: Lit, bus: str = BUS) -> tuple[FakeBuses, FakeAdc]:
    """A fake converter on a bus of its own."""
    device = FakeAdc(source, clock)
    buses = FakeBuses(clock)
    buses.plug(bus, device)
    return buses, device


def raw_block(seq: int, blemish: Blemish = Blemish.NONE, rate_hz: float = PROFILE_A.sample_rate) -> RawSamples:
    """A block as the driver delivers it, 50 ms of a sawtooth."""
    t0 = 10.0 + 0.051 * seq
    words = (1000 + np.arange(1111) % 700).astype(np.uint16)
    return RawSamples(seq, t0, t0 + 0.0505, t0 + 2e-5, rate_hz, words, 12, blemish, 1e-4)

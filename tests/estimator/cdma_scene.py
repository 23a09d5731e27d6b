"""Ceilings, blocks and decoder runs for the tests of the light decoder."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import PROFILE_A, Profile
from estimator.cdma.decoder import Decoder, decode, new_decoder, search
from estimator.cdma.epoch import LightEpoch, SampleBlock
from tools.sim.light.transmitter import Lamp
from tools.sim.light.waveform import Ambient, Block, Bus, Ceiling, Receiver

Array = npt.NDArray[np.float64]

SAMPLES = 1111
"""50 ms of profile A."""

EFFORT = 150
"""Codes per slice of search: 1 ms with profile A."""


def currents(x: float, y: float) -> Array:
    """Mean photocurrents (A) of a 4 x 4 ceiling of 10 x 10 m at 2.6 m above a photodiode; no field of view."""
    grid = np.array([1.25, 3.75, 6.25, 8.75])
    r2 = (grid[:, None] - x) ** 2 + (grid - y) ** 2
    return np.sort((2.79e-6 * (2.6**2 / (r2 + 2.6**2)) ** 1.823).ravel())[::-1]


def ceiling(
    seed: int, current: Array | None = None, data: bool = True, scl_error: float = 0.0, profile: Profile = PROFILE_A
) -> Ceiling:
    """Asynchronous lamps with random codes, +-50 ppm, under 500 lx with 20 % flicker; the strongest comes first."""
    rng = np.random.default_rng(seed)
    current = currents(*rng.uniform(3.0, 7.0, 2)) if current is None else current
    codes = rng.choice(2**profile.degree + 1, len(current), replace=False)
    lamps = [
        Lamp(
            code=int(code), current_a=float(a), lamp_id=int(code) + 1000, depth=profile.depth, data=data,
            position_m=(*np.round(rng.uniform(-20.0, 20.0, 2), 2).tolist(), 2.6), ppm=rng.uniform(-50, 50),
            phase_chips=rng.uniform(0, profile.length * 116),
        )
        for code, a in zip(codes, current, strict=True)
    ]  # fmt: skip
    front = profile.front_end
    receiver = Receiver(lpf_hz=front.lpf_hz, hpf_hz=front.hpf_hz)
    bus = Bus(scl_hz=18 * profile.sample_rate, scl_error=scl_error)
    return Ceiling(lamps, Ambient(), receiver, bus, profile.chip_rate, profile.degree, seed)


def sampled(block: Block) -> SampleBlock:
    return SampleBlock(block.t0, block.t1, block.words, block.nominal_rate)


@dataclass
class Run:
    """A decoder in front of a ceiling; time goes on from block to block with gaps of 0.1 to 1 ms."""

    ceiling: Ceiling
    profile: Profile = PROFILE_A
    clock_ppm: float | None = 0.0
    samples: int = SAMPLES
    slices: int = 2
    t: float = 1.0
    hung: tuple[int, ...] = ()
    decoder: Decoder = field(init=False)

    def __post_init__(self) -> None:
        self.decoder = new_decoder(self.profile, self.clock_ppm, self.hung)

    def block(self, stalls: tuple[tuple[int, float], ...] = ()) -> tuple[Block, LightEpoch]:
        block = self.ceiling.block(self.t, self.samples, stalls)
        self.t = block.t1 + float(self.ceiling.rng.uniform(1e-4, 1e-3))
        epoch = decode(self.decoder, sampled(block))
        for _ in range(self.slices):
            search(self.decoder, EFFORT)
        return block, epoch

    def blocks(self, count: int) -> Iterator[tuple[Block, LightEpoch]]:
        for _ in range(count):
            yield self.block()

    def settle(self, count: int = 20) -> LightEpoch:
        return [epoch for _, epoch in self.blocks(count)][-1]

    def codes(self) -> list[int]:
        return [lamp.code for lamp in self.ceiling.lamps]

    def errors(self, block: Block, epoch: LightEpoch) -> Array:
        """Relative error of each lamp's amplitude, NaN where it is not reported."""
        row = np.full(len(self.ceiling.lamps), np.nan)
        for code, amplitude in zip(epoch.ids.tolist(), epoch.amplitude, strict=True):
            if code in self.codes():
                at = self.codes().index(code)
                row[at] = amplitude / block.truth_a[at] - 1.0
        return row

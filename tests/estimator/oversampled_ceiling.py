"""A ceiling computed sample by sample at sixteen times the rate of the converter: for light that is not linear.

The photocurrent may be limited, as by a first stage that saturates; single lamps may rise slowly. It takes the lamps,
ambient light and receiver of a :class:`tools.sim.light.waveform.Ceiling`, and yields blocks like it.
"""

import numpy as np
import numpy.typing as npt

from tools.sim.light.waveform import Block, Ceiling

Array = npt.NDArray[np.float64]

TIMES = 16
BEGIN_S = 1.0
"""Start of the light; a run begins there too, and the AC coupling has 50 ms to settle."""
SETTLE_S = 0.05


class OversampledCeiling:
    """Blocks of a stretch of light that is computed once."""

    def __init__(
        self,
        world: Ceiling,
        seconds: float,
        limit_a: float = np.inf,
        rise_s: dict[int, float] | None = None,
    ) -> None:
        """``limit_a``: largest photocurrent; ``rise_s``: time constants of single lamps, by their index."""
        self._world, self.lamps, self.rng = world, world.lamps, np.random.default_rng(world.seed)
        self._step = world.bus.clocks_per_sample / world.bus.scl_hz / TIMES
        self._begin = BEGIN_S - SETTLE_S
        times = self._begin + self._step * np.arange(int((seconds + SETTLE_S) / self._step))
        spectrum_hz = np.fft.rfftfreq(len(times), self._step)
        current = np.full(len(times), world.ambient.current_a)
        for hertz, amplitude in world.ambient.tones():
            current += amplitude * np.cos(2.0 * np.pi * hertz * times)
        for k, lamp in enumerate(world.lamps):
            rise = (rise_s or {}).get(k, world.receiver.led_tau_s)
            delay = np.fft.rfft(self._light(lamp.edges(times[0], times[-1], world.chip_rate, world.degree), times))
            current += np.fft.irfft(delay / (1.0 + 2j * np.pi * spectrum_hz * rise), len(times)) + lamp.current_a
        current += self.rng.normal(0.0, np.sqrt(1.602e-19 * current.mean() / self._step), len(times))
        current = np.minimum(current, limit_a)
        low = 2.0 * np.pi * world.receiver.lpf_hz
        s = 2j * np.pi * spectrum_hz
        gain = s / (s + 2.0 * np.pi * world.receiver.hpf_hz) * low**2 / (s**2 + np.sqrt(2.0) * low * s + low**2)
        self._seen = np.fft.irfft(np.fft.rfft(current) * gain, len(times))

    def _light(self, edges: tuple[Array, Array], times: Array) -> Array:
        """Mean of a step train over each time step, without its mean level."""
        when, jump = edges
        at = np.clip((when - times[0]) / self._step, 0.0, len(times) - 1.0)
        whole = at.astype(np.int64)
        part = at - whole
        level = np.bincount(whole, jump * (1.0 - part), len(times) + 1)
        level += np.bincount(whole + 1, jump * part, len(times) + 1)
        light: Array = np.cumsum(level)[: len(times)]
        return light - light.mean()

    def block(self, t_start: float, samples: int, stalls: tuple[tuple[int, float], ...] = ()) -> Block:
        """See :meth:`tools.sim.light.waveform.Ceiling.block`."""
        assert not stalls
        world, rx = self._world, self._world.receiver
        t_sample = t_start + TIMES * self._step * np.arange(samples)
        place = (t_sample - self._begin) / self._step
        current = np.interp(place, np.arange(len(self._seen)), self._seen)
        step = rx.full_scale_a / 2.0**rx.bits
        converter = step / np.sqrt(12.0) * np.sqrt(4.0 ** (rx.bits - rx.enob) - 1.0)
        current = current + self.rng.normal(0.0, converter, samples)
        words = np.clip(np.round((current / rx.full_scale_a + 0.5) * 2**rx.bits), 0, 2**rx.bits - 1)
        early, late = self.rng.uniform(0.1, 1.0, 2) * world.bus.late_s
        truth = np.array([lamp.depth * lamp.current_a for lamp in self.lamps])
        nominal = world.bus.scl_hz / world.bus.clocks_per_sample
        return Block(t_start - early, float(t_sample[-1]) + late, words, nominal, truth, t_sample)

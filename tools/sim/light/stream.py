"""The ceiling at waveform level, for as long as a drive lasts: what a converter's input sees at any instants.

Each lamp goes by a crystal of its own and tells where it hangs; its strength follows the robot
(:mod:`tools.sim.ceiling.ceiling`); daylight, mains flicker of ordinary lamps, shot and thermal noise come with it, and
the front end filters it all. The object is a :data:`hal.fake.adc.chips.SampleSource`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.ceiling.ceiling import Ceiling
from tools.sim.light.kernels import COLUMNS, CURRENT, DEPTH, PHASE, RATE, SLOPE, hum, ring, steps
from tools.sim.light.transmitter import Lamp, code_bits
from tools.sim.light.waveform import ELECTRON, SETTLE, Ambient, Receiver

Array = npt.NDArray[np.float64]
Poses = Callable[[Array], Array]
"""(n, 3) poses in the building's frame at (n,) ``t_mono``."""

CHIP_RATE: Final = 5000.0
DEGREE: Final = 7
PPM: Final = 50.0
KNOT_S: Final = 0.025
"""Between these instants strengths go straight."""
AHEAD: Final = 40
"""Knots that are worked out together."""
IN_VIEW_A: Final = 0.2e-9
"""Modulated current below which a lamp is left out: a decoder's error in one block."""
DAYLIGHT_SWING: Final = 0.3
"""By how much daylight and ordinary lamps differ over the room."""


def transmitters(ceiling: Ceiling, seed: int = 0) -> list[Lamp]:
    """The lamps' senders: crystals up to 50 ppm off, any phase, frames that tell what the plan says of them."""
    rng = np.random.default_rng((seed, 11))
    return [
        Lamp(
            code=f.code, current_a=0.0, lamp_id=f.lamp_id, position_m=(f.x, f.y, f.z), power_w=f.power_w,
            half_angle_deg=round(f.half_angle_deg), depth=ceiling.depth, ppm=float(rng.uniform(-PPM, PPM)),
            phase_chips=float(rng.uniform(0.0, 127.0 * 116.0)),
        )
        for f in ceiling.fixtures
    ]  # fmt: skip


class Track:
    """Strengths of all lamps along a drive, worked out a second at a time."""

    def __init__(self, ceiling: Ceiling, poses: Poses) -> None:
        self._ceiling, self._poses = ceiling, poses
        self._first = 0
        self._knots = np.zeros((0, len(ceiling.fixtures)))

    def forget(self) -> None:
        """The drive is another than was thought (a robot that stood still has been sent off)."""
        self._knots = self._knots[:0]

    def at(self, t: float) -> Array:
        """(lamps,) modulated current in A at ``t``."""
        knot = int(np.floor(t / KNOT_S))
        if not self._first <= knot < self._first + len(self._knots) - 1:
            self._first = knot
            when: Array = KNOT_S * np.arange(knot, knot + AHEAD + 1, dtype=np.float64)
            self._knots = self._ceiling.amplitudes(self._poses(when), when)
        row, part = knot - self._first, t / KNOT_S - knot
        return np.asarray((1.0 - part) * self._knots[row] + part * self._knots[row + 1])


class LightStream:
    """See the module. Instants may skip ahead; going back (a converter that holds a stale sample) starts afresh.

    Args:
        ceiling: the lamps; its clock is ``t_mono``. poses: where the robot truly is.
        receiver: front end and converter. ambient: light that carries no code, in the middle of its range.
        seed: of crystals, phases and noise. noise_rate_hz: samples per second, for the bandwidth of the noise.
    """

    def __init__(
        self, ceiling: Ceiling, poses: Poses, *, receiver: Receiver | None = None, ambient: Ambient | None = None,
        seed: int = 0, noise_rate_hz: float = 400e3 / 18,
    ) -> None:  # fmt: skip
        self.ceiling, self.track = ceiling, Track(ceiling, poses)
        self.receiver, self.ambient = receiver or Receiver(), ambient or Ambient()
        self.lamps = transmitters(ceiling, seed)
        self._noise_rate, self._poses = noise_rate_hz, poses
        self._rng = np.random.default_rng((seed, 13))
        self._rows = np.zeros((len(self.lamps), COLUMNS))
        self._rows[:, RATE] = [2.0 * CHIP_RATE * (1.0 + 1e-6 * lamp.ppm) for lamp in self.lamps]
        self._rows[:, PHASE] = [2.0 * lamp.phase_chips for lamp in self.lamps]
        self._rows[:, DEPTH] = ceiling.depth
        chips = np.array([code_bits(DEGREE, lamp.code) for lamp in self.lamps], dtype=np.uint8)
        frames = np.array([[int(bit) for bit in lamp.frame()] for lamp in self.lamps], dtype=np.uint8)
        self._codes = (chips, frames)
        self._chain = chain_of(self.receiver)
        self._tones = tones_of(self.receiver, self.ambient)
        self._settle = SETTLE / (2.0 * np.pi * self.receiver.hpf_hz)
        self._state = np.zeros((self._chain.shape[1], 2))
        self._t = -np.inf

    def __call__(self, t_mono: Array) -> Array:
        """Input voltage as a fraction of the supply at each instant; 0.5 is no light, or light that never changes."""
        t = np.ascontiguousarray(t_mono, dtype=np.float64)
        current = self.coded(t) + self._flicker(t) + self._noise(t)
        return np.asarray(0.5 + current / self.receiver.full_scale_a)

    def coded(self, t: Array) -> Array:
        """(n,) A of the lamps' light behind the filters, without noise."""
        if len(t) > 1 and np.any(np.diff(t) < 0.0):
            return np.concatenate([self.coded(t[:1]), self.coded(t[1:])])  # a stale sample, then fresh ones
        if t[0] <= self._t or t[0] - self._t > self._settle:
            self._t = float(t[0]) - self._settle
            self._state[:] = 0.0
            self._rows[:, SLOPE + 2 :] = 0.0
        self._set_currents(self._t, float(t[-1]))
        drive = np.zeros((len(t), self._chain.shape[1], 2))
        out = np.empty(len(t))
        steps(t, np.array([self._t, self._t]), self._rows, self._codes, self._chain, drive)
        ring(t, self._t, self._chain, self._state, drive, out)
        self._t = float(t[-1])
        return out

    def level(self, t_mono: Array, full_scale_a: float = 2e-3) -> Array:
        """Amplifier's output before the coupling capacitor as a fraction of its range: a source for a DC channel."""
        coded = sum(float(self.track.at(float(t)).sum()) for t in t_mono) / max(len(t_mono), 1) / self.ceiling.depth
        return np.clip((coded + self.ambient.current_a * self._share(t_mono)) / full_scale_a, 0.0, 1.0)

    def _set_currents(self, begin: float, end: float) -> None:
        """Mean currents that go straight from ``begin`` to ``end``; what is out of view is dark."""
        a, b = self.track.at(begin), self.track.at(end)
        seen = np.maximum(a, b) > IN_VIEW_A
        depth, span = self.ceiling.depth, max(end - begin, 1e-9)
        self._rows[:, CURRENT] = np.where(seen, a, 0.0) / depth
        self._rows[:, SLOPE] = np.where(seen, (b - a) / span, 0.0) / depth

    def _share(self, t: Array) -> Array:
        """How much of the ambient light there is where the robot is, 1 on average."""
        pose = self._poses(t[:1])[0]
        swing = np.sin(0.45 * pose[0] + 0.9) * np.cos(0.38 * pose[1] - 0.4)
        return np.full(len(t), 1.0 + DAYLIGHT_SWING * swing)

    def _flicker(self, t: Array) -> Array:
        total = np.zeros(len(t))
        hum(t, self._tones, total)
        return total * self._share(t)

    def _noise(self, t: Array) -> Array:
        """Shot and thermal noise, and the converter's own beyond that of rounding."""
        rx = self.receiver
        mean = self.ambient.current_a * float(self._share(t)[0]) + float(self._rows[:, CURRENT].sum())
        shot = np.sqrt(ELECTRON * mean * self._noise_rate)
        rounding = rx.full_scale_a / 2**rx.bits / np.sqrt(12)
        converter = rounding * np.sqrt(max(0.0, 4.0 ** (rx.bits - rx.enob) - 1.0))
        return self._rng.normal(0.0, np.sqrt(shot**2 + rx.thermal_a**2 + converter**2), len(t))


def chain_of(receiver: Receiver) -> Array:
    """(4, modes) for the kernels: of a pair of conjugate poles one, with twice its residue."""
    poles, residues = receiver.modes()
    upper = poles.imag > -1e-9
    twice = np.where(poles.imag > 1e-9, 2.0, 1.0)
    rows = (poles.real, poles.imag, twice * residues.real, twice * residues.imag)
    return np.ascontiguousarray(np.array(rows)[:, upper])


def tones_of(receiver: Receiver, ambient: Ambient) -> Array:
    """(k, 3) mains flicker behind the filters, for the kernel."""
    gains = [(f, amplitude * receiver.gain(f)) for f, amplitude in ambient.tones()]
    return np.array([(2.0 * np.pi * f, gain.real, -gain.imag) for f, gain in gains]).reshape(-1, 3)

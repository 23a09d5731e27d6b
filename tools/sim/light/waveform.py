"""Waveform-level ceiling: coded lamps, daylight and mains flicker in, words of an SCL-clocked ADC out.

Shares no code with the decoder. Light is a train of steps at exact times; each step passes LED, low-pass and high-pass
as a sum of decaying exponentials, evaluated at the instants at which the converter really samples. What it does not
model: aperture jitter of the converter, colour, saturation of the amplifier before the converter, and differing rise
times between lamps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tools.sim.light.transmitter import Lamp, PwmLamp

Array = npt.NDArray[np.float64]
ELECTRON = 1.602e-19
SETTLE = 16.0
"""Time constants of the AC coupling for which light is followed before a block: of a step then 1e-7 is left."""


@dataclass(frozen=True)
class Ambient:
    """Light that carries no code: its mean photocurrent, and the mains flicker on it.

    Attributes:
        current_a: 79 uA is 500 lx on 1.2 cm2 at 0.4 A/W. flicker: percent flicker / 100 at the fundamental.
        flicker_a: if not None, absolute amplitude of the flicker instead (daylight does not flicker).
        mains_hz: twice the line frequency. harmonics: amplitudes of the multiples relative to the first.
    """

    current_a: float = 79e-6
    flicker: float = 0.20
    flicker_a: float | None = None
    mains_hz: float = 100.0
    harmonics: tuple[float, ...] = (1.0, 0.12, 0.05, 0.03, 0.02)

    def tones(self) -> list[tuple[float, float]]:
        """(frequency, amplitude in A) of each component."""
        first = self.flicker * self.current_a if self.flicker_a is None else self.flicker_a
        return [((h + 1) * self.mains_hz, first * part) for h, part in enumerate(self.harmonics)]


@dataclass(frozen=True)
class Receiver:
    """Photodiode, transimpedance stage and converter.

    Attributes:
        full_scale_a: AC-coupled range from rail to rail. enob: effective number of bits, noise included.
        lpf_hz: second-order Butterworth. hpf_hz: first-order AC coupling. led_tau_s: rise of the lamps.
    """

    full_scale_a: float = 50e-6
    bits: int = 12
    enob: float = 11.3
    lpf_hz: float = 8000.0
    hpf_hz: float = 50.0
    led_tau_s: float = 1.5e-6
    thermal_a: float = 0.1e-9

    def modes(self) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.complex128]]:
        """Poles of the chain and residues of its step response: response(t) = sum residue exp(pole t)."""
        low = 2 * np.pi * self.lpf_hz
        poles = np.array([low * np.exp(0.75j * np.pi), low * np.exp(-0.75j * np.pi), -1 / self.led_tau_s])
        poles = np.append(poles, -2 * np.pi * self.hpf_hz)
        gain = low**2 / self.led_tau_s  # step response: gain / prod (s - p), the high-pass zero cancels the step's 1/s
        residues = [gain / np.prod([p - q for q in poles if q is not p and q != p]) for p in poles]
        return poles, np.array(residues)

    def gain(self, frequency: float) -> complex:
        """Complex gain of the whole chain (lamp rise excepted) for a sinusoid."""
        s = 2j * np.pi * frequency
        low = 2 * np.pi * self.lpf_hz
        return complex(s / (s + 2 * np.pi * self.hpf_hz) * low**2 / (s**2 + np.sqrt(2) * low * s + low**2))


@dataclass(frozen=True)
class Bus:
    """An I2C adapter that clocks the converter: 18 clocks per sample, the first after 8.

    Attributes:
        scl_hz: nominal; scl_error: relative error of the real one. late_s: largest ordinary delay of each time stamp.
    """

    scl_hz: float = 400e3
    scl_error: float = 0.0
    clocks_per_sample: int = 18
    late_s: float = 60e-6


@dataclass(frozen=True, eq=False)
class Block:
    """One block read as a driver would hand it over, with what only the simulator knows.

    Attributes:
        t0, t1: stamps before and after the read. words: ADC words. nominal_rate: samples per second by the book.
        truth_a: modulated amplitude of each lamp, averaged over the block. t_sample: true sampling instants.
    """

    t0: float
    t1: float
    words: Array
    nominal_rate: float
    truth_a: Array
    t_sample: Array


@dataclass
class Ceiling:
    """All of it; `block` may be asked for any time, in any order. ``dimmed``: PWM lamps, which carry no code."""

    lamps: list[Lamp]
    ambient: Ambient = field(default_factory=Ambient)
    receiver: Receiver = field(default_factory=Receiver)
    bus: Bus = field(default_factory=Bus)
    chip_rate: float = 5000.0
    degree: int = 7
    seed: int = 0
    dimmed: list[PwmLamp] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def block(self, t_start: float, samples: int, stalls: tuple[tuple[int, float], ...] = ()) -> Block:
        """Read `samples` words; START is put on the bus at `t_start`.

        `stalls`: (sample, seconds): the bus stands still for so long before that sample is taken.
        """
        scl = self.bus.scl_hz * (1 + self.bus.scl_error)
        t_sample = t_start + (8 + self.bus.clocks_per_sample * np.arange(samples)) / scl
        for index, pause in stalls:
            t_sample[index:] += pause
        t_end = t_sample[-1] + (self.bus.clocks_per_sample + 2) / scl
        current = self._signal(t_sample) + self._tones(t_sample) + self._noise(samples)
        rx = self.receiver
        words = np.clip(np.round((current / rx.full_scale_a + 0.5) * 2**rx.bits), 0, 2**rx.bits - 1)
        middle = 0.5 * (t_sample[0] + t_sample[-1])
        truth = np.array([lamp.depth * (lamp.current_a + lamp.slope_a_s * middle) for lamp in self.lamps])
        early, late = self.rng.uniform(0.1, 1.0, 2) * self.bus.late_s
        nominal = self.bus.scl_hz / self.bus.clocks_per_sample
        return Block(t_start - early, t_end + late, words, nominal, truth, t_sample)

    def _signal(self, t_sample: Array) -> Array:
        begin = t_sample[0] - SETTLE / (2 * np.pi * self.receiver.hpf_hz)
        pairs = [lamp.edges(begin, t_sample[-1], self.chip_rate, self.degree) for lamp in self.lamps]
        pairs += [lamp.edges(begin, t_sample[-1]) for lamp in self.dimmed]
        if not pairs:
            return np.zeros_like(t_sample)
        when = np.concatenate([pair[0] for pair in pairs])
        jump = np.concatenate([pair[1] for pair in pairs])
        total = np.zeros_like(t_sample)
        for pole, residue in zip(*self.receiver.modes(), strict=True):
            total += (residue * _respond(pole, t_sample, when, jump)).real
        return total

    def _tones(self, t_sample: Array) -> Array:
        total = np.zeros_like(t_sample)
        for frequency, amplitude in self.ambient.tones():
            gain = self.receiver.gain(frequency)
            total += amplitude * (gain * np.exp(2j * np.pi * frequency * t_sample)).real
        return total

    def _noise(self, samples: int) -> Array:
        """Shot and thermal noise, and the converter's own beyond that of rounding."""
        rx = self.receiver
        mean = self.ambient.current_a + sum(lamp.current_a for lamp in (*self.lamps, *self.dimmed))
        shot = np.sqrt(ELECTRON * mean * self.bus.scl_hz / self.bus.clocks_per_sample)
        step = rx.full_scale_a / 2**rx.bits
        rounding = step / np.sqrt(12)
        converter = rounding * np.sqrt(max(0.0, 4.0 ** (rx.bits - rx.enob) - 1.0))
        return self.rng.normal(0.0, np.hypot(np.hypot(shot, rx.thermal_a), converter), samples)


def _respond(pole: complex, t_sample: Array, when: Array, jump: Array) -> npt.NDArray[np.complex128]:
    """Sum over past jumps of jump * exp(pole * age), at each sample, by recursion from sample to sample."""
    inside = when <= t_sample[-1]
    when, jump = when[inside], jump[inside]
    index = np.searchsorted(t_sample, when)
    kick = jump * np.exp(pole * (t_sample[index] - when))
    n = len(t_sample)
    drive = np.bincount(index, kick.real, n) + 1j * np.bincount(index, kick.imag, n)
    decay = np.exp(pole * np.diff(t_sample, prepend=t_sample[0]))
    return _recursion(decay, drive)


def _recursion(decay: npt.NDArray[np.complex128], drive: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """s[n] = decay[n] s[n - 1] + drive[n] in log2(N) vector steps: two steps of such a recursion are one again."""
    decay, state, reach = decay.copy(), drive.copy(), 1
    while reach < len(drive):
        state[reach:] = state[reach:] + decay[reach:] * state[:-reach]
        decay[reach:] = decay[reach:] * decay[:-reach]
        decay[:reach] = 0.0
        reach *= 2
    return state

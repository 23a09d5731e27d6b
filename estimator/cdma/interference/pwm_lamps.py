"""PWM-dimmed lamps in view: detection, tracking from block to block, and the rows that take them out of a block."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import gcd
from typing import Final

import numpy as np

from estimator.cdma.air_interface import Profile
from estimator.cdma.correlation_kernels import inner, mixed
from estimator.cdma.interference.pwm_detection import fundamental
from estimator.cdma.interference.pwm_kernels import DRIFT, FALL, FALL_SLOPE, RISE, RISE_SLOPE, harmonics
from estimator.cdma.interference.pwm_naming import Named, distinct, named, order
from estimator.cdma.interference.pwm_waveform import Chain, Complex, Pulses, explained, least_squares, orthonormal
from estimator.numerics.arrays import Array

MOST: Final = 3
"""Most PWM lamps that are followed at a time."""

LOOK_EVERY, LOOK_SELDOM = 4, 64
"""Blocks between two searches for the first lamp; the number doubles up to the second one while there is none."""

LOUDER: Final = 1.3
"""Energy of the residual, over that at the last search, from which the next one is due; chance stays below 1.25."""

MERGE_EVERY: Final = 16
"""Blocks with several lamps between two tries to merge two of them."""
RATIOS: Final = range(1, 6)
"""Multiples of a fundamental that may be followed as two lamps."""

GRID: Final = 1024
"""Trial phases per cycle."""

PASSES: Final = 2
"""Gauss-Newton steps per block."""

REACH: Final = 1.0
"""Largest step of an edge, samples."""

FINE: Final = 64
"""Most harmonics that place the edges."""

ABSENT: Final = 20
"""Blocks without significant light until a lamp is dropped."""

SIGNIFICANT: Final = 25.0
"""Energy of its harmonics over that of noise from which a lamp is received."""

GAIN: Final = 0.3
"""Share of a change of frequency and duty cycle that one block corrects, after the first few."""

NAME_EVERY: Final = 16
"""Blocks with a lamp between two looks at its true frequency."""

NAMED_BY: Final = 6
"""Harmonics that show it."""

SEEN_BY_EDGES: Final = 0.1
"""Frequency (cycles per sample) below which edges show that it is not folded."""

EDGED: Final = 0.9
"""Share of a lamp's light below which its edges are looked for again."""

SHORTEST: Final = 0.2
"""Shortest pulse or pause, samples."""

TRIED: Final = 8
"""Blocks after which a lamp is no longer on trial."""

FIRST: Final = 4
"""Blocks that correct all of it."""

SAME_CELLS: Final = 0.5
"""Distance of two fundamentals, in resolution cells, below which they are one lamp."""


@dataclass
class _Track:
    """One PWM lamp.

    Attributes:
        pulses: in the present block. swing: by its edges, ADC steps. seen, missed: blocks with it; without, in a row.
        name: frequency and swing; None while not known.
    """

    pulses: Pulses
    swing: float = 0.0
    seen: int = 0
    missed: int = 0
    name: Named | None = None


class PwmLamps:
    """Tracker of PWM-dimmed lamps, by the nominal sample clock."""

    def __init__(self, profile: Profile) -> None:
        """No lamp yet."""
        self._chain = Chain(profile)
        self._rate, self._usual = profile.sample_rate, round(profile.epoch_s * profile.sample_rate)
        self._tracks: list[_Track] = []
        self._unlooked = self._interval = LOOK_EVERY
        self._searched = 0.0
        self._together = 0

    def __len__(self) -> int:
        """Number of lamps followed."""
        return len(self._tracks)

    @property
    def named(self) -> list[Named]:
        """Each lamp that is beyond doubt; frequencies by the nominal sample clock."""
        return [track.name for track in self._tracks if track.name is not None]

    def find_phases(self, clean: Array, mains: Array) -> float:
        """Find the phase of each lamp's pulses in a block, the oldest lamp first; returns the largest shift, samples.

        ``clean``: (N,) block without the ``mains`` rows.
        """
        times, largest = _centred(len(clean)), 0.0
        for track in self._tracks:
            before = track.pulses
            track.pulses = self._aligned(track.pulses, clean, times)
            for _ in range(PASSES):
                self._step(track, clean, times, mains, common=True)
            shift = (track.pulses.rise - before.rise + 0.5) % 1.0 - 0.5
            largest = max(largest, abs(shift) / before.frequency)
            if track is not self._tracks[-1]:
                clean = clean - self._light(track.pulses, clean, times, mains)[0]
        return largest

    def rows(self, times: Array, mask: Array, mains: Array) -> Array:
        """Orthonormal rows (M, N) of mains and PWM lamps; ``mains``: orthonormal rows; ``times`` in samples."""
        times = times - 0.5 * (times[0] + times[-1])
        for track in self._tracks:
            mains = np.concatenate((mains, orthonormal(self._chain.rows(track.pulses, times) * mask, mains)))
        return mains

    def raw_rows(self, size: int) -> Array:
        """Rows (M, N) of all lamps, of unit power and not orthogonal."""
        times = _centred(size)
        rows = [row for track in self._tracks for row in self._chain.rows(track.pulses, times)]
        raw: Array = np.array(rows, np.float64).reshape(-1, size)
        raw /= np.sqrt(np.maximum(np.einsum("ij,ij->i", raw, raw) / size, 1e-24))[:, None]
        return raw

    def learn(self, light: Array, residual: Array, mains: Array) -> None:
        """Track frequency and duty cycle of all lamps, and find another one.

        Args:
            light: (N,) a block without coded lamps.
            residual: (N,) of the block.
            mains: orthonormal rows.
        """
        self._together = self._together + 1 if len(self._tracks) > 1 else 0
        if self._tracks:
            clean, noise = light - mixed(inner(mains, light), mains), float(np.vdot(residual, residual)) / len(residual)
            if self._together % MERGE_EVERY == MERGE_EVERY // 2 and not self._drop_repeated(clean, noise, mains):
                self._merge(clean, mains)
            self._follow(clean, noise, mains)
        if len(self._tracks) < MOST:
            self._look_for(light, residual, mains)

    def due(self, energy: float) -> bool:
        """Whether to learn from a block with this energy of its residual: always with a lamp, else at times."""
        if self._tracks:
            return True
        self._unlooked += 1
        if energy > LOUDER * self._searched:
            self._interval = LOOK_EVERY
        if self._unlooked < self._interval:
            return False
        self._interval = min(2 * self._interval, LOOK_SELDOM)
        self._unlooked, self._searched = 0, energy
        return True

    def _drop_repeated(self, clean: Array, noise: float, mains: Array) -> bool:
        """Drop the lamp that adds least to the others, if that is not significant; returns whether there was one.

        Such a track follows some of the lines of another lamp.
        """
        times, added = _centred(len(clean)), []
        for track in self._tracks:
            known = mains
            for other in self._tracks:
                if other is not track:
                    known = np.concatenate((known, orthonormal(self._chain.rows(other.pulses, times), known)))
            _, energy, rank = explained(self._chain.rows(track.pulses, times), known, clean)
            added.append(energy / (max(rank, 1) * noise + 1e-30))
        least = int(np.argmin(added))
        if added[least] > SIGNIFICANT:
            return False
        del self._tracks[least]
        return True

    def _merge(self, clean: Array, mains: Array) -> None:
        """Replace two lamps by one if they are multiples of a frequency whose edges explain the light of both."""
        times = _centred(len(clean))
        for a, b in combinations([track for track in self._tracks if track.seen >= FIRST], 2):
            common = _common(a.pulses.frequency, b.pulses.frequency, SAME_CELLS / len(clean))
            if common is None:
                continue
            rest = clean
            for track in self._tracks:
                if track is not a and track is not b:
                    rest = rest - self._light(track.pulses, rest, times, mains)[0]
            trial = _Track(self._placed(common, rest))
            energy = [self._step(trial, rest, times, mains, common=False) for _ in range(2 * PASSES)][-1]
            both = np.concatenate((self._chain.rows(a.pulses, times), self._chain.rows(b.pulses, times)))
            if energy > EDGED * explained(both, mains, rest)[1]:
                self._tracks = [trial, *(track for track in self._tracks if track is not a and track is not b)]
                return

    def _light(self, pulses: Pulses, clean: Array, times: Array, mains: Array) -> tuple[Array, float, int]:
        """Light (N,) of one lamp in a block, its energy, and the rank of its rows."""
        return explained(self._chain.rows(pulses, times), mains, clean)

    def _follow(self, clean: Array, noise: float, mains: Array) -> None:
        """Track all lamps through a block without coded lamps, the oldest first; ``noise``: variance per sample."""
        times = _centred(len(clean))
        for track in self._tracks:
            energy = self._settle(track, clean, times, mains)
            light, total, rank = self._light(track.pulses, clean, times, mains)
            edged = energy > EDGED * total
            if not edged:
                self._follow_line(track, clean, times, mains)
                self._place_again(track, energy, clean, times, mains)
            present = total > SIGNIFICANT * rank * noise
            track.seen += present
            track.missed = 0 if present else track.missed + 1
            if present and track.seen % NAME_EVERY == 0:
                self._name(track, clean, times, edged)
            clean = clean - light
        self._tracks = [track for track in self._tracks if track.missed < (ABSENT if track.seen > TRIED else 2)]

    def _name(self, track: _Track, clean: Array, times: Array, edged: bool) -> None:
        """Find true frequency and swing of a lamp, and follow the true one from now on.

        ``edged``: edges at the present frequency explain its light.
        """
        frequency = track.pulses.frequency
        if edged and frequency < SEEN_BY_EDGES:
            track.name = Named(frequency, track.swing)
            return
        found = np.empty((2, NAMED_BY))
        harmonics(frequency, times, clean, found)
        k = distinct(frequency, NAMED_BY, 1.0 / len(clean))
        lines = (found[0] + 1j * found[1])[k - 1]
        many = order(k, lines) if frequency < 0.5 else 1
        if many > 1:
            folded = abs(many * frequency - round(many * frequency))
            track.pulses, track.name = self._placed(folded, clean), None
            return
        noise = 4.0 * float(np.vdot(clean, clean) - 0.5 * len(clean) * (np.abs(lines) ** 2).sum()) / len(clean) ** 2
        track.name = name = named(self._chain, frequency % 1.0, k, lines, self._rate, max(noise, 0.0))
        if abs(name.frequency - frequency) > SAME_CELLS / len(clean):
            track.pulses = self._placed(name.frequency, clean)

    def _follow_line(self, track: _Track, clean: Array, times: Array, mains: Array) -> None:
        """Track the frequency by the strongest line: an error of it is time times the quadrature of the line."""
        found = np.empty((2, NAMED_BY))
        harmonics(track.pulses.frequency, times, clean, found)
        strongest = int(np.argmax((found**2).sum(axis=0))) + 1
        phasor = np.exp(2j * np.pi * strongest * track.pulses.frequency * times)
        ramp = times / times[-1]
        rows = np.array((phasor.real, phasor.imag, ramp * phasor.real, ramp * phasor.imag))
        (c, s, t_c, t_s), _ = least_squares(rows, mains, clean)
        step = (t_c * s - t_s * c) / (2.0 * np.pi * times[-1] * strongest * max(c * c + s * s, 1e-12))
        reach = SAME_CELLS / len(clean) / strongest
        moved = track.pulses.frequency + min(max(float(step), -reach), reach)
        track.pulses = replace(track.pulses, frequency=moved)

    def _settle(self, track: _Track, clean: Array, times: Array, mains: Array) -> float:
        """Gauss-Newton steps of edges and frequency; returns the energy explained by the edges."""
        return [self._step(track, clean, times, mains, common=False) for _ in range(PASSES)][-1]

    def _place_again(self, track: _Track, energy: float, clean: Array, times: Array, mains: Array) -> None:
        """Look for the edges again, at the same frequency, and keep them if they explain more."""
        trial = _Track(self._placed(track.pulses.frequency, clean))
        if self._settle(trial, clean, times, mains) > energy:
            track.pulses, track.swing = trial.pulses, trial.swing

    def _look_for(self, light: Array, residual: Array, mains: Array) -> None:
        """Add the strongest comb of the residual to the lamps."""
        frequency = fundamental(residual, self._usual)
        cell = SAME_CELLS / len(residual)
        if frequency is None or any(abs(frequency - track.pulses.frequency) < cell for track in self._tracks):
            return
        self._tracks = [
            track
            for track in self._tracks
            if track.seen > TRIED or not _second_of(track.pulses.frequency, frequency, cell)
        ]
        clean = residual if self._tracks else light - mixed(inner(mains, light), mains)
        self._tracks.append(_Track(self._placed(frequency, clean)))

    def _harmonics(self, frequency: float, clean: Array, times: Array) -> tuple[Array, Complex, Complex]:
        """Orders of the harmonics below half the rate, their complex amplitudes, and the gain of the chain there."""
        out = np.empty((2, min(max(int(0.48 / frequency), 1), FINE)))
        harmonics(frequency, times, clean, out)
        order = np.arange(1.0, out.shape[1] + 1.0)
        return order, out[0] + 1j * out[1], self._chain.gain(frequency * order)

    def _placed(self, frequency: float, clean: Array) -> Pulses:
        """Edges of a lamp that is new: extremes of the derivative of its light, correlated with the receiver's."""
        order, found, gain = self._harmonics(frequency, clean, _centred(len(clean)))
        density = _cycle(1j * order * found * np.conj(gain))
        return Pulses(frequency, -float(np.argmax(density)) / GRID, -float(np.argmin(density)) / GRID)

    def _aligned(self, pulses: Pulses, clean: Array, times: Array) -> Pulses:
        """Pulses of known duty cycle at the phase with the largest correlation."""
        order, found, gain = self._harmonics(pulses.frequency, clean, times)
        shape = -1j * gain / order * (1.0 - np.exp(-2j * np.pi * order * pulses.duty))
        rise = -float(np.argmax(_cycle(found * np.conj(shape)))) / GRID
        return replace(pulses, rise=rise, fall=rise - pulses.duty)

    def _step(self, track: _Track, clean: Array, times: Array, mains: Array, common: bool) -> float:
        """Gauss-Newton step of the edges, one common to both, or each its own and the frequency.

        Returns the energy explained by the step's rows.
        """
        pulses = track.pulses
        trains = self._chain.trains(pulses, times)
        light = trains[RISE] - trains[FALL]
        if common:
            rows = np.array((light, trains[RISE_SLOPE] - trains[FALL_SLOPE]))
        else:
            rows = np.array((light, trains[RISE_SLOPE], -trains[FALL_SLOPE], trains[DRIFT]))
        weight, energy = least_squares(rows, mains, clean)
        moves = np.clip(weight[1:] / (abs(weight[0]) + 1e-12) * np.sign(weight[0]), -REACH, REACH) * pulses.frequency
        if common:
            track.pulses = replace(pulses, rise=pulses.rise + moves[0], fall=pulses.fall + moves[0])
            return energy
        gain = 1.0 if track.seen < FIRST else GAIN
        rise, fall, drift = (gain * moves).tolist()
        frequency, rise, fall = pulses.frequency + drift / times[-1], pulses.rise + rise, pulses.fall + fall
        shortest = SHORTEST * frequency
        duty = min(max((rise - fall) % 1.0, shortest), 1.0 - shortest)
        track.pulses = Pulses(frequency, rise, rise - duty)
        track.swing = abs(float(weight[0]))
        return energy


def _second_of(frequency: float, fundamental: float, reach: float) -> bool:
    """Whether a frequency is the second harmonic of a fundamental, within ``reach``."""
    return abs(frequency - 2.0 * fundamental) < reach


def _common(a: float, b: float, reach: float) -> float | None:
    """Largest frequency of which both are different small multiples, within ``reach``; None if there is none."""
    for p, q in sorted(((p, q) for p in RATIOS for q in RATIOS if gcd(p, q) == 1 and p != q), key=sum):
        if abs(a * q - b * p) < reach * max(p, q):
            return 0.5 * (a / p + b / q)
    return None


def _centred(size: int) -> Array:
    """Sample times from the middle of the block."""
    times: Array = np.arange(size, dtype=np.float64)
    times -= 0.5 * (size - 1)
    return times


def _cycle(harmonic: Complex) -> Array:
    """(GRID,) one cycle of the waveform with these harmonics."""
    spectrum = np.zeros(GRID // 2 + 1, np.complex128)
    spectrum[1 : len(harmonic) + 1] = harmonic
    return np.fft.irfft(spectrum, GRID)

"""Pulse of one Manchester chip after LED, low-pass and AC coupling, tabulated for the kernels.

The low-pass has component tolerances. An error of 10 % of its corner would leave 4 % of a strong lamp's light
unexplained. A weak lamp has no more. `Shape` estimates the corner from the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import Profile
from estimator.cdma.correlation_kernels import columns, mixed
from estimator.cdma.sample_block import Fit, Prior, Sampled
from estimator.numerics.arrays import Array

Complex = npt.NDArray[np.complex128]
Index = npt.NDArray[np.int64]

STEPS: Final = 512
"""Table points per chip; expansion around the nearest is good to 5e-5 of the pulse, to 4e-4 at its corners."""

REACH: Final = 0.25
"""Largest relative error of the low-pass corner that is accepted."""

GAIN: Final = 0.7
"""Share of an error that is corrected at a time."""

SOON, LATER = 2, 16
"""Blocks between two updates of the shape: `SOON` while it is wrong, this when it is right."""

SLOW_S: Final = 20e-6
"""Rise time of a slow lamp, s."""

RISE_STEP_S, RISE_WORTH_S = 1e-6, 0.15e-6
"""Rise times, s: step of a derivative, and change that justifies a new table."""

WORTH: Final = 5e-4
"""Relative corner error that justifies a new table."""


def pulse_table(profile: Profile, corner: float = 1.0) -> Array:
    """Rows at k / STEPS chips: pulse in its own chip, in the next one, and the slopes of both per chip; (STEPS + 1, 4).

    Gain is 1 for a current that lies between the two corners: an amplitude is that of the photocurrent. The pulse later
    than one chip after its end is 1e-3 of it (the coupling's droop) and is neglected.

    Args:
        profile: chip rate and front end.
        corner: factor on the low-pass corner.
    """
    rates, weights, final = _chain(profile, corner)
    high = 2 * np.pi * profile.front_end.hpf_hz * (1.0 / profile.chip_rate)
    t = np.arange(2 * STEPS + 1) / STEPS
    states = np.zeros((4, len(t)))
    for begin, jump in ((0.0, 1.0), (0.5, -2.0), (1.0, 1.0)):
        age = t - begin
        decay = np.exp(rates[:, None] * np.maximum(age, 0.0))
        states += jump * np.where(age >= 0.0, final[:, None] + (weights @ decay).real, 0.0)
    pulse = states[1] - states[3]
    slope = states[2] - high * pulse
    own, following = slice(0, STEPS + 1), slice(STEPS, 2 * STEPS + 1)
    return np.column_stack([pulse[own], pulse[following], slope[own], slope[following]])


def _chain(profile: Profile, corner: float) -> tuple[Complex, Complex, Array]:
    """Eigenvalues (per chip) of the chain, step response of its states by mode, and their final values."""
    chip, front = 1.0 / profile.chip_rate, profile.front_end
    low, high = 2 * np.pi * front.lpf_hz * corner * chip, 2 * np.pi * front.hpf_hz * chip
    rise = chip / front.led_tau_s
    chain = np.array(  # lamp, low-pass and its rate, low-pass inside the AC coupling
        [[-rise, 0, 0, 0], [0, 0, 1, 0], [low**2, -(low**2), -np.sqrt(2) * low, 0], [0, high, 0, -high]]
    )
    rates, modes = np.linalg.eig(chain)
    final = np.array([1.0, 1.0, 0.0, 1.0])
    return rates, modes * np.linalg.solve(modes, -final), final


def step_modes(profile: Profile) -> tuple[Complex, Complex]:
    """Rates (per chip) and residues of the step response: it is the real part of ``sum(residues * exp(rates * t))``."""
    rates, weights, _ = _chain(profile, 1.0)
    return rates.astype(np.complex128), (weights[1] - weights[3]).astype(np.complex128)


@cache
def slow_change(profile: Profile) -> Array:
    """Change of the pulse table by lamps that rise with the time constant `SLOW_S`."""
    return slow_table(profile, SLOW_S) - pulse_table(profile)


def slow_table(profile: Profile, rise_s: float, corner: float = 1.0) -> Array:
    """Pulse table of lamps with the time constant ``rise_s``."""
    return pulse_table(replace(profile, front_end=replace(profile.front_end, led_tau_s=rise_s)), corner)


@cache
def pulse_energy(profile: Profile) -> float:
    """Mean square of an endless code of amplitude 1; the tails of neighbours are taken as independent."""
    return _energy(pulse_table(profile))


def _energy(table: Array) -> float:
    """Mean square of an endless code of amplitude 1."""
    return float(np.mean(table[:-1, 0] ** 2 + table[:-1, 1] ** 2))


@cache
def slow_loss(profile: Profile) -> float:
    """Relative error of the amplitude of a lamp with the time constant `SLOW_S`, by the usual table."""
    return 1.0 - float(np.sqrt(_energy(slow_table(profile, SLOW_S)) / pulse_energy(profile)))


@dataclass(frozen=True)
class _Slow:
    """Pulse of one slow lamp: rise time (s) and corner it is made for; table, its derivative, loss of amplitude.

    The loss is the relative error of the amplitude by the usual table.
    """

    rise_s: float
    corner: float
    table: Array
    derivative: Array
    loss: float


class Shape:
    """Pulse tables in use, and the estimate of the low-pass corner.

    Attributes:
        corner, made_corner: of the low-pass, relative to the profile's: estimate, and that of the usual table.
        rise_s: (slots,) rise time of each lamp, s; the usual one where a lamp is not slow.
        tables, derivatives: (T, S, 4) usual table, then those of slow lamps; their derivatives, per s^2, by the square
            of the rise time. A short rise only delays the pulse; its form changes with the square.
        pulse: (slots,) number of each lamp's table. made_s: (slots,) rise time of that table, s.
        loss: (slots,) relative error of the amplitude by the usual table. by_corner: derivative of the usual table.
    """

    def __init__(self, profile: Profile, slots: int) -> None:
        """Start with the nominal corner of the profile, and with no slow lamp."""
        self._profile = profile
        self._wait = SOON
        self._slow: dict[int, _Slow] = {}
        self._changed = False
        self._usual_s = profile.front_end.led_tau_s
        self.corner = 1.0
        self.rise_s = np.full(slots, self._usual_s)
        self._make()
        self._stack()

    def _make(self) -> None:
        """Compute the usual table and its derivative by the corner."""
        self.made_corner = self.corner
        self._usual = pulse_table(self._profile, self.corner)
        more, less = (pulse_table(self._profile, self.corner * factor) for factor in (1.01, 0.99))
        self.by_corner = (more - less) / 0.02

    def _make_slow(self, rise_s: float) -> _Slow:
        """Table of a slow lamp."""
        table = slow_table(self._profile, rise_s, self.corner)
        slower = slow_table(self._profile, rise_s + RISE_STEP_S, self.corner)
        loss = 1.0 - float(np.sqrt(_energy(table) / _energy(self._usual)))
        return _Slow(rise_s, self.corner, table, (slower - table) / ((rise_s + RISE_STEP_S) ** 2 - rise_s**2), loss)

    def _stack(self) -> None:
        """Collect the tables of all lamps."""
        slots, slow = list(self._slow), list(self._slow.values())
        by_rise = slow_change(self._profile) / (SLOW_S**2 - self._usual_s**2)
        self.tables = np.stack([self._usual, *(lamp.table for lamp in slow)])
        self.derivatives = np.stack([by_rise, *(lamp.derivative for lamp in slow)])
        self.pulse, self.loss = np.zeros((2, len(self.rise_s)))
        self.made_s = np.full(len(self.rise_s), self._usual_s)
        self.pulse[slots] = np.arange(1.0, len(slow) + 1.0)
        self.made_s[slots] = [lamp.rise_s for lamp in slow]
        self.loss[slots] = [lamp.loss for lamp in slow]

    def learn(self, block: Sampled, prior: Prior, fit: Fit) -> None:
        """Correct the corner every few blocks: correlate the residual with the signal's derivative by it."""
        self._wait -= 1
        if self._wait:
            return
        self._wait = LATER
        waves = np.empty((2, len(fit.amplitude), len(block.x)))
        lamps = prior.lamps(fit.phase + fit.lag)
        lamps[1] *= 1.0 + fit.clock
        columns(prior.chips, lamps[:2], block.samples, fit.signs, self.by_corner[None], waves)
        change = mixed(fit.amplitude, waves[0])
        columns(prior.chips, lamps, block.samples, fit.signs, self.tables, waves)
        seen = change = block.project(change)
        for wave in np.einsum("i,kij->kj", fit.amplitude, waves):  # the joint fit has solved for amplitude and delay
            row = block.project(wave)
            change = change - row * float(np.dot(change, row) / max(np.dot(row, row), 1e-12))
        energy = float(np.dot(change, change))
        if energy < 1e-3 * float(np.dot(seen, seen)) or energy < 100.0 * fit.noise_var:
            return  # too faint
        error = float(np.dot(change, fit.residual)) / energy
        self.set_corner(self.corner * (1.0 + GAIN * error))
        if abs(error) > 4.0 * WORTH:
            self._wait = SOON

    def forget(self, slots: Index) -> None:
        """Return slots that have another lamp now to the usual table, at once: that lamp was found with it."""
        self.rise_s[slots] = self.made_s[slots] = self._usual_s
        self.pulse[slots] = self.loss[slots] = 0.0

    def set_corner(self, corner: float) -> None:
        """Set the estimate of the corner, within its tolerance."""
        self.corner = float(np.clip(corner, 1.0 - REACH, 1.0 + REACH))

    @staticmethod
    def possible(corner: float) -> bool:
        """Whether a corner lies within its tolerance."""
        return abs(corner - 1.0) <= REACH

    def renew(self) -> Array | None:
        """Recompute a table if the pulse has changed: half a millisecond, so not within a block update.

        Returns how much the pulse in each slot is later than before (slots,), s; None if nothing has changed.
        """
        if abs(self.corner - self.made_corner) > WORTH:
            self._make()
        elif not self._renew_slow():
            return None
        before = self.made_s
        self._stack()
        later: Array = self.made_s - before
        return later

    def _renew_slow(self) -> bool:
        """Recompute the table of one slow lamp; returns whether all are complete and some have changed.

        All lamps change at once: their ratios are what places are found by.
        """
        if not self._slow and self.rise_s.max() == self._usual_s:
            return False
        slow = np.flatnonzero(self.rise_s > self._usual_s).tolist()
        for slot in [slot for slot in self._slow if slot not in slow]:
            del self._slow[slot]
            self._changed = True
        for slot in slow:
            if not self._fits(self._slow.get(slot), slot):
                self._changed = True
                alike = next((lamp for lamp in self._slow.values() if self._fits(lamp, slot)), None)
                self._slow[slot] = alike or self._make_slow(float(self.rise_s[slot]))
                if alike is None:
                    return False
        changed, self._changed = self._changed, False
        return changed

    def _fits(self, made: _Slow | None, slot: int) -> bool:
        """Whether a table is that of the lamp in a slot."""
        if made is None or abs(made.corner - self.corner) > WORTH:
            return False
        return abs(made.rise_s - float(self.rise_s[slot])) <= RISE_WORTH_S

    def behind(self, slots: Index) -> bool:
        """Whether the tables of these lamps are not yet those of the estimates."""
        late = np.abs(self.rise_s[slots] - self.made_s[slots]) > 2.0 * RISE_WORTH_S
        return bool(late.any()) or abs(self.corner - self.made_corner) > 2.0 * WORTH

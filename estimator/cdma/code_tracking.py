"""Code tracking of lamps from block to block: phase and rate (the role of a DLL), amplitude, life cycle, shared clocks.

Each lamp has a two-state Kalman filter [phase, rate]. Shared quantities have filters of their own, so that a late time
stamp shifts no lamp. These are the delay of the block's time stamps, the drift of the host clock against the crystals,
and the sample clock.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import Profile
from estimator.cdma.data_frame import LampFrame
from estimator.cdma.frame_accumulator import BitRings
from estimator.cdma.gold_codes import gold_codes
from estimator.cdma.sample_block import Fit, Prior
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

CAPACITY: Final = 64
"""Most lamps at once."""

NEW_PHASE: Final = 0.06
"""Sigma of a phase from acquisition, chips."""

PHASE_WALK: Final = 2e-4
"""Random walk of the phase beyond the rate, chips per root second."""

RATE_WALK: Final = 1e-8
"""Relative crystal rate per root second (a lamp that warms up)."""

CLOCK_WALK: Final = 3e-6
"""Relative sample clock per root second."""

DRIFT_WALK: Final = 3e-8
"""Host clock relative to the lamps' crystals, per root second."""

STAMP_S: Final = 40e-6
"""One sigma of a block's time base from its two stamps, s."""

APART: Final = 1.0
"""Distance (chips) below which two lamps with the same code cannot be separated."""

MERGED: Final = 0.12
"""Distance (chips) below which two tracked lamps with the same code are taken for one."""

ASTRAY: Final = 0.15
"""Sigma (chips) above which a phase is dropped, as after a long pause; a new acquisition takes 0.2 s."""

LONGEST_S: Final = 1e6
"""Cap of a pause, s: no phase is known after it, and squares stay finite."""

UNTRIED: Final = 1.5e-4
"""One sigma of a sample clock that is stored (good to 200 ppm) or comes from a search."""

MISTAKEN: Final = 1e-3
"""One sigma of a sample clock that lamps contradict: an eighth of a chip at the ends of a block."""

SLOWEST: Final = 0.03
"""Largest relative distance of samples that pauses of the bus may add; more of them leave no code intact."""

STRETCH_GAIN: Final = 0.125
"""Share of a block in the averaged distance of samples by the time stamps."""

FINEST: Final = 3e-4
"""Minimum sigma of a phase, chips (errors of the pulse shape)."""

HITS, MISSES, LOST = 2, 2, 20
"""Block counts: `HITS` until a candidate is confirmed, `MISSES` until it is dropped, this until a lamp is dropped."""

FAINT, CLEAR, EVIDENT = 5.0, 8.0, 20.0
"""Significance in sigmas: below `FAINT` a lamp is not received, `CLEAR` counts as one hit, this as enough hits."""


class Life(IntEnum):
    """Life cycle of a slot."""

    FREE = 0
    TENTATIVE = 1
    CONFIRMED = 2


_FREE, _TENTATIVE, _CONFIRMED = (int(life) for life in Life)
"""The values of `Life` as plain numbers, for comparisons with arrays."""


class Clocks:
    """Clocks that all lamps share: delay and drift (chips, chips per chip), and the sample clock's relative error.

    ``clock`` is positive when samples are farther apart than nominal. ``stretch``: the same by the time stamps of the
    blocks alone, averaged; it contains the delay of the stamps.
    """

    def __init__(self, profile: Profile, clock_ppm: float | None) -> None:
        """``clock_ppm``: stored error of the sample clock; None: not known yet."""
        self._chip_rate = profile.chip_rate
        self.known = clock_ppm is not None
        self.clock = 0.0 if clock_ppm is None else clock_ppm * 1e-6
        self.clock_var = UNTRIED**2
        self.proven, self._proven_var = self.clock, self.clock_var
        self.guess: float | None = None
        self.stretch = 0.0
        self.state = np.zeros(2)  # delay, drift
        self.cov = np.diag([(STAMP_S * self._chip_rate) ** 2, (3e-5) ** 2])

    def predict(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        chips, p = dt * self._chip_rate, self.cov
        self.state[0] += chips * self.state[1]
        p[0, 0] += 2 * chips * p[0, 1] + chips**2 * p[1, 1] + PHASE_WALK**2 * dt
        p[0, 1] += chips * p[1, 1]
        p[1, 0] = p[0, 1]
        p[1, 1] += DRIFT_WALK**2 * dt
        self.clock_var += CLOCK_WALK**2 * dt

    def update(self, lag: float, excess_s: float, fit: Fit) -> None:
        """Update with the delay beyond the prediction, chips; ``excess_s``: uncertainty of the time stamps, s."""
        noise = (max(STAMP_S, 0.3 * excess_s) * self._chip_rate) ** 2
        gain = self.cov[:, 0] / (self.cov[0, 0] + noise)
        self.state = self.state + gain * lag
        self.cov = self.cov - np.outer(gain, self.cov[0])
        self.clock += fit.clock * (1.0 + self.clock)
        self.clock_var = max(fit.clock_var, 1e-14)

    def measure(self, stretch: float) -> None:
        """Average the time between a block's stamps over that of its samples at the nominal clock, less 1."""
        self.stretch += STRETCH_GAIN * (min(max(stretch, -SLOWEST), SLOWEST) - self.stretch)

    def doubt(self) -> None:
        """Widen the prior of the sample clock: lamps contradict it."""
        self.clock_var = max(self.clock_var, MISTAKEN**2)

    def prove(self) -> None:
        """Store the sample clock as proven, because a confirmed lamp depends on it."""
        self.known, self.guess = True, None
        self.proven, self._proven_var = self.clock, self.clock_var

    def suppose(self, clock: float) -> None:
        """Set the sample clock from a search over the whole range; searches of newer blocks confirm or reject it."""
        self.clock = self.guess = clock
        self.clock_var = UNTRIED**2

    def rest(self) -> None:
        """Return to the last proven sample clock when no lamp is left, so that chance finds do not shift it."""
        self.clock = self.proven if self.guess is None else self.guess
        self.clock_var = max(self._proven_var, self.clock_var)


class Tracks:
    """Slots of tracked lamps. Phases are in chips at time ``t``, without the common delay, never wrapped.

    Attributes:
        amplitude, amplitude_var: ADC steps, variance by noise alone. relative_var: variance of a common factor of
            errors, which makes no lamp less certain to be there. shared: whether two lamps may have one code.
    """

    def __init__(self, profile: Profile) -> None:
        """All slots free."""
        self._codes = gold_codes(profile.degree)
        self._chip_rate = profile.chip_rate
        self._crystal = 0.6e-6 * profile.crystal_ppm
        self.length = profile.length
        self.t = -np.inf
        self.life: Index = np.zeros(CAPACITY, np.int64)
        self.code: Index = np.zeros(CAPACITY, np.int64)
        self.phase, self.rate = np.zeros(CAPACITY), np.zeros(CAPACITY)
        self.cov = np.zeros((CAPACITY, 2, 2))
        self.amplitude, self.amplitude_var, self.relative_var = np.zeros((3, CAPACITY))
        self._dark = np.zeros(CAPACITY, bool)
        self.hits: Index = np.zeros(CAPACITY, np.int64)
        self.misses: Index = np.zeros(CAPACITY, np.int64)
        self.shared = False
        self.rings = BitRings(CAPACITY)
        self.frames: list[LampFrame | None] = [None] * CAPACITY

    @property
    def slots(self) -> Index:
        """Occupied slots."""
        return self.life.nonzero()[0]

    @property
    def confirmed(self) -> Index:
        """Slots of confirmed lamps."""
        found: Index = (self.life == _CONFIRMED).nonzero()[0]
        return found

    def predict(self, t: float) -> float:
        """Advance all phases to time ``t``; returns the seconds passed (0 at the first call)."""
        dt = min(max(t - self.t, -LONGEST_S), LONGEST_S) if np.isfinite(self.t) else 0.0
        self.t = t
        chips = dt * self._chip_rate
        self.phase += (1.0 + self.rate) * chips
        p = self.cov
        p[:, 0, 0] += 2 * chips * p[:, 0, 1] + chips**2 * p[:, 1, 1] + PHASE_WALK**2 * abs(dt)
        p[:, 0, 1] += chips * p[:, 1, 1]
        p[:, 1, 0] = p[:, 0, 1]
        p[:, 1, 1] += RATE_WALK**2 * abs(dt)
        for slot in ((p[:, 0, 0] > ASTRAY**2) & (self.life != _FREE)).nonzero()[0]:
            self.drop(int(slot))
        return dt

    def add(self, code: int, phase: float, t: float, amplitude: float) -> None:
        """Add a candidate, its phase at time ``t`` without the common delay; ignored if all slots are occupied.

        A tracked lamp that is received at this phase is left unchanged. One that is faint has been lost: it is moved to
        the candidate's phase, and has to be confirmed again.
        """
        free = np.flatnonzero(self.life == Life.FREE)
        chips = (self.t - t) * self._chip_rate
        same = (self.life != Life.FREE) & (self.code == code)
        apart = np.abs((self.phase - phase - chips + 0.5 * self.length) % self.length - 0.5 * self.length)
        known = np.flatnonzero(same & (apart < APART))
        if len(known) and self.faint(known).all():
            self._place(int(known[0]), phase, t)
            self.life[known[0]] = Life.TENTATIVE
        if len(known) or not len(free):
            return
        k = int(free[0])
        self.shared |= bool(same.any())
        self.life[k], self.code[k] = Life.TENTATIVE, code
        self.frames[k] = None
        self._place(k, phase, t)
        self.amplitude[k], self.amplitude_var[k] = amplitude, 0.0

    def add_twin(self, slot: int, shift: float, amplitude: float) -> None:
        """Add a candidate of a tracked lamp's code, ``shift`` chips from it; ignored if all slots are occupied."""
        free = np.flatnonzero(self.life == Life.FREE)
        if not len(free):
            return
        k = int(free[0])
        self.shared = True
        self.life[k], self.code[k] = Life.TENTATIVE, self.code[slot]
        self.frames[k] = None
        self._place(k, float(self.phase[slot]) + shift, self.t)
        self.amplitude[k], self.amplitude_var[k] = amplitude, 0.0

    def shift(self, slot: int, chips: float) -> None:
        """Correct the phase of a lamp by ``chips``, with the uncertainty of an acquisition, and keep the rest."""
        self.phase[slot] += chips
        self.cov[slot] = [[NEW_PHASE**2, 0.0], [0.0, self.cov[slot, 1, 1]]]

    def merge_twins(self) -> None:
        """Drop the weaker of two lamps of one code that have come too close to be separated."""
        if not self.shared:
            return
        slots = self.slots
        codes = self.code[slots]
        self.shared = len(set(codes.tolist())) < len(slots)
        for k, slot in enumerate(slots.tolist()):
            others = slots[:k][codes[:k] == codes[k]]
            apart = np.abs(
                (self.phase[others] - self.phase[slot] + 0.5 * self.length) % self.length - 0.5 * self.length
            )
            for other in others[(apart < MERGED) & (self.life[others] != _FREE)].tolist():
                self.drop(slot if self.amplitude[slot] < self.amplitude[other] else other)

    def unambiguous(self, slots: Index, window: float) -> tuple[Index, float]:
        """Lamps that determine a common delay, and the reach of its search, chips.

        Twins shifted by their distance look alike. So confirmed lamps without a twin determine it if one is evident;
        else the reach is half the distance of the nearest twins. A candidate may be no lamp.
        """
        twin = (self.code[slots, None] == self.code[slots]).sum(axis=1) > 1
        alone = slots[~twin & (self.life[slots] == _CONFIRMED)]
        if (self.amplitude[alone] > EVIDENT * np.sqrt(self.amplitude_var[alone])).any():
            return alone, window
        apart = np.abs(
            (self.phase[slots, None] - self.phase[slots] + 0.5 * self.length) % self.length - 0.5 * self.length
        )
        other = (self.code[slots, None] == self.code[slots]) & ~np.eye(len(slots), dtype=bool)
        return slots, min(window, 0.5 * float(apart[other].min(initial=np.inf)))

    def _place(self, k: int, phase: float, t: float) -> None:
        """Set a slot to the phase of a search at time ``t``."""
        chips = (self.t - t) * self._chip_rate
        self.phase[k], self.rate[k] = phase + chips, 0.0
        var = self._crystal**2
        self.cov[k] = [[NEW_PHASE**2 + var * chips**2, var * chips], [var * chips, var]]
        self.hits[k] = self.misses[k] = 0
        self._dark[k] = False
        self.rings.forget(k)

    def faint(self, slots: Index) -> npt.NDArray[np.bool_]:
        """Which of these lamps were not received in the last block."""
        dark: npt.NDArray[np.bool_] = self._dark[slots]
        return dark

    def weigh(self, slots: Index, amplitude: Array, variance: Array, relative_var: Array | float = 0.0) -> None:
        """Store the amplitudes of a block. A faint lamp needs more to return: chance reaches 5 sigmas now and then.

        ``variance``: by noise; ``relative_var``: of errors that grow with the amplitude.
        """
        self.amplitude[slots], self.amplitude_var[slots], self.relative_var[slots] = amplitude, variance, relative_var
        self._dark[slots] = amplitude < np.where(self._dark[slots], CLEAR, FAINT) * np.sqrt(variance)

    def drop(self, slot: int) -> None:
        """Free a slot."""
        self.life[slot] = Life.FREE
        self.frames[slot] = None

    def move(self, slot: int, chips: float) -> None:
        """Move a candidate from a side lobe to the peak and restart its confirmation; ``chips``: shift."""
        self.phase[slot] += chips
        self.cov[slot] = [[NEW_PHASE**2, 0.0], [0.0, self._crystal**2]]
        self.hits[slot] = 0
        self.rings.forget(slot)

    def first_period(self, slots: Index, lag: float, span: float) -> Index:
        """Running number of the first code period received in a block that begins ``span`` chips before the middle.

        A period lasts until one chip after its end (its last chip's tail), with a data sign of its own.
        """
        begin = self.phase[slots] + lag - (1.0 + self.rate[slots]) * span
        return np.floor((begin - 1.0) / self.length).astype(np.int64)

    def prior(self, slots: Index, lag: float, variances: tuple[float, float], span: float, pulse: Array) -> Prior:
        """Prediction for a block whose middle is at ``t``; ``variances``: of delay and clock; ``pulse``: tables."""
        first = self.first_period(slots, lag, span)
        bit_sum, bit_weight = self.rings.before(slots, first)
        phase = self.phase[slots] + lag
        return Prior(
            chips=self._codes[self.code[slots]],
            phase=phase - first * self.length,
            rate=1.0 + self.rate[slots],
            phase_var=self.cov[slots, 0, 0],
            lag_var=variances[0],
            clock_var=variances[1],
            amplitude=self.amplitude[slots],
            bit_sum=bit_sum,
            bit_weight=bit_weight,
            pulse=pulse,
        )

    def learn_phases(self, slots: Index, fit: Fit) -> None:
        """Update phase and rate from the fit's posterior of each phase (conditional Gaussian)."""
        before = self.cov[slots, 0, 0]
        after = np.minimum(np.maximum(fit.phase_var, FINEST**2), before)
        share = self.cov[slots, 0, 1] / before
        self.phase[slots] += fit.phase
        self.rate[slots] += share * fit.phase
        self.cov[slots, 1, 1] -= share**2 * (before - after)
        self.cov[slots, 0, 0] = after
        self.cov[slots, 0, 1] = self.cov[slots, 1, 0] = share * after

    def judge(self, slots: Index, floor: float) -> Index:
        """Count hits and misses and drop lost lamps; returns candidates with enough hits.

        ``floor``: smallest amplitude of a hit, ADC steps.
        """
        amplitude, sigma = self.amplitude[slots], np.sqrt(self.amplitude_var[slots])
        seen = (amplitude > CLEAR * sigma) & (amplitude > floor)
        tentative = self.life[slots] == _TENTATIVE
        missed = np.where(tentative, ~seen, self.faint(slots))
        beyond = amplitude > EVIDENT * sigma
        self.hits[slots] += np.where(seen & beyond, HITS, seen)
        self.misses[slots] = np.where(missed, self.misses[slots] + 1, np.where(tentative, self.misses[slots], 0))
        limit = np.where(tentative, MISSES, LOST)
        for slot in slots[self.misses[slots] >= limit].tolist():
            self.drop(slot)
        ripe: Index = slots[(self.life[slots] == _TENTATIVE) & (self.hits[slots] >= HITS)]
        return ripe

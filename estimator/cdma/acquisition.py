"""Cold acquisition by FFT: finds codes and code phases in a block, given only the air interface.

A block without mains and tracked lamps is correlated, by FFT, with one period of every code. The sum of magnitudes over
the code periods touched needs no data signs. The work is cut into slices of as many codes as the caller can afford.
Strong lamps hide weak ones. Only candidates within `DOMINANCE` of the strongest are accepted; the rest are left for the
next block, from which the strong lamps are subtracted.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.acquisition_budget import TURNS
from estimator.cdma.air_interface import Profile
from estimator.cdma.chip_pulse import pulse_energy, pulse_table
from estimator.cdma.correlation_kernels import align, columns, detect
from estimator.cdma.data_bits import without
from estimator.cdma.gold_codes import gold_codes
from estimator.cdma.sample_block import Prior, Sampled, rows_of
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]
Spectrum = npt.NDArray[np.complex64]
Lamps = tuple[Index, Array, Array]
"""Codes, code phases (chips at the middle of the block) and amplitudes."""

THRESHOLD: Final = 5.2
"""Detection threshold: sum of correlations over its noise. The noise is measured on the correlations themselves, so it
contains the interference of other lamps. With 129 codes, 565 phases and 4 sign patterns, noise exceeds it in 6 % of
blocks; the next block rejects these.
"""

COLD_THRESHOLD: Final = 7.0
"""Detection threshold while the sample clock is unknown and the number of trials is eleven times larger."""

DOMINANCE: Final = 0.35
"""Largest cross-correlation of partial code periods, with margin."""

GUARD_CHIPS: Final = 1.6
"""Distance from a tracked lamp within which its own code is not searched (side lobes)."""

BIN: Final = 0.002
"""Spacing of trial clocks (relative): 25 us over half a code period of profile A, a quarter of a half chip."""

FINE_RATES: Final = np.arange(-5, 6) * 4e-4
FINE_LAGS: Final = np.arange(-2, 3) * 0.25
SAME_CLOCK: Final = 4e-4
"""Clock change (relative) that makes a spectrum stale: a fiftieth of a chip at the ends of a period."""

STALE: Final = 6
"""Cost of a code with a stale spectrum, in codes with a valid one."""

MOST_FOUND: Final = 12
"""Most candidates of one sweep."""


@dataclass(frozen=True, slots=True)
class Found:
    """A candidate: code, phase (chips at the middle of the searched block), amplitude (ADC steps), significance."""

    code: int
    phase: float
    amplitude: float
    z: float


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A block to be searched.

    Attributes:
        block: with the residual in place of its photocurrent. t_middle: s. lag: common delay of that block, chips.
        codes, phases: of each tracked lamp, delay included. floor: smallest amplitude worth reporting.
        again: number of earlier sweeps over the same block whose lamps were subtracted.
    """

    block: Sampled
    t_middle: float
    lag: float
    codes: Index
    phases: Array
    floor: float
    again: int = 0

    @property
    def y(self) -> Array:
        """(N,) residual in ADC steps."""
        return self.block.y


Outcome = tuple[Job, float, list[Found]]
"""The searched job, the sample clock of the search, and the candidates."""


class Search:
    """FFT search over all codes, one job at a time, in slices (`step`).

    Args:
        profile: air interface. hung: codes of lamps in the building; empty: all codes.
    """

    def __init__(self, profile: Profile, hung: Collection[int] = ()) -> None:
        """No job in progress and no spectra computed."""
        self._profile = profile
        self._codes = gold_codes(profile.degree)
        self._table = pulse_table(profile)[None]
        self._energy = pulse_energy(profile)
        self._cache: Spectrum = np.empty((0, 0), np.complex64)
        self._cache_clock: Array = np.empty(0)
        self._product: Spectrum = self._cache
        self._lags: npt.NDArray[np.float32] = np.empty((0, 0), np.float32)
        self._waves, self._sums = self._lags, np.empty(0, np.float32)
        self._size = 0
        every = np.arange(len(self._codes))
        hangs = np.isin(every, list(hung)) if len(hung) else np.ones(len(every), np.bool_)
        self._every, self._hung, self._foreign = every, every[hangs], every[~hangs]
        self._order, self._turn = every, 0
        self._job: Job | None = None
        self._plan: list[float] = []
        self._next = 0
        self._found: list[list[Found]] = []
        self._spectrum: Spectrum = np.empty(0, np.complex64)
        self._limit = THRESHOLD

    @property
    def codes(self) -> int:
        """Most codes of a slow sweep."""
        return len(self._hung) - (-len(self._foreign) // TURNS)

    @property
    def idle(self) -> bool:
        """Whether no job is in progress."""
        return self._job is None

    def start(self, job: Job, clocks: list[float], slow: bool = False) -> None:
        """Start a sweep over all codes, once per trial clock.

        A ``slow`` sweep covers the codes of the building's lamps, and a share of the others.
        """
        self._fit_size(len(job.y))
        self._order = self._every
        if slow:
            self._order = np.sort(np.concatenate((self._hung, self._foreign[self._turn :: TURNS])))
            self._turn = (self._turn + 1) % TURNS
        self._job, self._plan, self._next = job, list(clocks), 0
        self._found = [[] for _ in clocks]
        self._limit = THRESHOLD if len(clocks) == 1 else COLD_THRESHOLD
        self._spectrum = _spectrum(job.y, self._size)

    def step(self, codes: int) -> tuple[int, Outcome | None]:
        """Search up to ``codes`` more codes, fewer if their spectra are stale.

        Returns the effort that is left, in codes, and at the end of the sweep its outcome.
        """
        job = self._job
        if job is None:
            return 0, None
        self._fit_size(len(job.y))
        if len(self._spectrum) != self._cache.shape[1]:  # a block of another length was tracked in between
            self._spectrum = _spectrum(job.y, self._size)
        trial, first = divmod(self._next, len(self._order))
        some, cost = self._order[first : first + codes], 1
        if np.any(np.abs(self._cache_clock[some] - self._plan[trial]) > SAME_CLOCK):
            some, cost = some[: max(codes // STALE, 1)], STALE
        self._found[trial] += self._try(job, self._plan[trial], some)
        self._next += len(some)
        if self._next < len(self._plan) * len(self._order):
            return codes - cost * len(some), None
        self._job = None
        strongest = [max((f.z for f in found), default=0.0) for found in self._found]
        best = int(np.argmax(strongest))
        return codes - cost * len(some), (job, self._plan[best], _dominant(self._found[best]))

    def _spc(self, clock: float) -> float:
        """Samples per chip."""
        return self._profile.samples_per_chip / (1.0 + clock)

    def _prepare(self, codes: Index, clock: float) -> None:
        """Recompute stale waveforms and conjugate spectra of these codes, one code period each, for this clock."""
        stale = codes[np.abs(self._cache_clock[codes] - clock) > SAME_CLOCK]
        if not len(stale):
            return
        few, spc = len(stale), self._spc(clock)
        n = int(np.ceil((self._profile.length + 1) * spc))
        samples, lamps = np.stack([np.arange(n) / spc, np.ones(n)]), np.stack([np.zeros(few), np.ones(few)])
        waves = np.empty((2, few, n))
        columns(self._codes[stale], lamps, samples, np.tile([1.0, 0.0], (few, 1)), self._table, waves)
        self._waves[stale, :n], self._waves[stale, n:] = waves[0], 0.0
        self._cache[stale] = np.conj(np.fft.rfft(self._waves[stale], self._size))
        self._cache_clock[stale] = clock

    def warm(self, n: int, clock: float) -> None:
        """Compute all spectra for blocks of ``n`` samples at once (2 to 3 ms), so that no cycle does it."""
        self._fit_size(n)
        self._prepare(np.arange(len(self._codes)), clock)

    def _correlation(self, codes: Spectrum, block: Spectrum) -> npt.NDArray[np.float32]:
        """(K, F) correlation of a block with one period of each code, by lag of its begin; next call reuses it."""
        product, out = self._product[: len(codes)], self._lags[: len(codes)]
        np.multiply(codes, block, out=product)
        np.fft.irfft(product, self._size, out=out)  # type: ignore[arg-type]  # numpy's stubs know double only
        return out

    def _try(self, job: Job, clock: float, some: Index) -> list[Found]:
        """Candidates among these codes (ascending) at one clock."""
        n, spc = len(job.y), self._spc(clock)
        self._prepare(some, clock)
        whole = int(some[-1]) - int(some[0]) == len(some) - 1  # then the spectra need not be copied
        correlation = self._correlation(
            self._cache[some[0] : some[-1] + 1] if whole else self._cache[some], self._spectrum
        )
        middle, period = 0.5 * (n - 1), self._profile.length * spc
        row = np.full(len(self._codes), -1)
        row[some] = np.arange(len(some))
        known = rows_of(row[job.codes], (middle - job.phases * spc) % period)
        out = np.empty((len(some), 5))
        detect(correlation, known, float(np.ceil(GUARD_CHIPS * spc)), n, period, self._sums[: int(period) + 3], out)
        power = sorted(out[:, 4].tolist())
        usual = 0.5 * (power[(len(power) - 1) // 2] + power[len(power) // 2])
        noise = math.sqrt(usual / (max(n - int(period), 1) * period))  # of periods that lie inside the block
        z = out[:, 1] / (math.sqrt(n) * max(noise, 1e-9))
        amplitude = out[:, 1] / (self._energy * n)
        good = np.flatnonzero((z > self._limit) & (amplitude > job.floor))
        found = []
        for k in good.tolist():
            lag, there, before, behind, _ = out[k].tolist()
            offset = 0.5 * (behind - before) / max(2 * there - before - behind, 1e-9)
            phase = (middle - lag - min(max(offset, -0.5), 0.5)) / spc % self._profile.length
            found.append(Found(int(some[k]), phase, float(amplitude[k]), float(z[k])))
        return found

    def common_lag(self, y: Array, clock: float, lamps: Lamps, window: float) -> tuple[float, float]:
        """Common delay (chips) of all lamps relative to their predicted phases, within ``window`` chips; correlation.

        Each code is correlated near the expected begin of its periods, on a grid of half samples.
        """
        codes, phase, amplitude = lamps
        spc, n = self._spc(clock), len(y)
        self._fit_size(n)
        self._prepare(codes, clock)
        period = self._profile.length * spc
        half = int(np.ceil(2 * window * spc)) + 1
        score = np.empty(2 * half + 1)
        begin = (0.5 * (n - 1) - phase * spc) % period
        align(self._waves[codes], y.astype(np.float32), rows_of(begin, amplitude), period, score)
        best = min(max(int(score.argmax()), 1), 2 * half - 1)
        before, there, behind = score[best - 1 : best + 2].tolist()
        fine = 0.25 * (behind - before) / max(2 * there - before - behind, 1e-9)
        return float(0.5 * (best - half) + min(max(fine, -0.25), 0.25)) / spc, there

    def _fit_size(self, n: int) -> None:
        """Set the FFT length for blocks of ``n`` samples; another length clears the stored spectra."""
        longest = int((self._profile.length + 1) * self._spc(-self._profile.clock_ppm * 1e-6) * 1.01) + 1
        size = _fast_length(n + longest)
        if self._cache.shape[1] != size // 2 + 1:
            self._waves = np.empty((len(self._codes), longest), np.float32)
            self._sums = np.empty(longest + 3, np.float32)
            self._cache = np.empty((len(self._codes), size // 2 + 1), np.complex64)
            self._cache_clock = np.full(len(self._codes), np.inf)
            self._product = np.empty_like(self._cache)
            self._lags = np.empty((len(self._codes), size), np.float32)
        self._size = size

    def refine(self, job: Job, clock: float, found: Found) -> float:
        """Sample clock (relative error) from one candidate, by a local grid search: 11 rates x 5 delays."""
        spc, n = self._spc(clock), len(job.y)
        rate, shift = np.meshgrid(1.0 - FINE_RATES, FINE_LAGS / spc)
        phase, rate = found.phase + shift.ravel(), rate.ravel()
        x = (np.arange(n) - 0.5 * (n - 1)) / spc
        phase = phase - np.floor((phase + rate * x[0]) / self._profile.length) * self._profile.length
        touched = int((x[-1] - x[0]) * 1.01 / self._profile.length) + 3
        chips = np.repeat(self._codes[[found.code]], len(rate), axis=0)
        waves, ones = np.empty((2, len(rate), n)), np.ones((len(rate), touched))
        bounds = columns(chips, np.stack([phase, rate]), np.stack([x, np.ones(n)]), ones, self._table, waves)
        total = np.concatenate([np.zeros((len(rate), 1)), np.cumsum(waves[0] * job.y, axis=1)], axis=1)
        score = np.abs(np.diff(np.take_along_axis(total, bounds, axis=1), axis=1)).sum(axis=1)
        best = int(np.argmax(score))
        return (1.0 + clock) * float(rate[best]) - 1.0

    def peeled(self, job: Job, found: list[Found]) -> Job:
        """The same block after subtracting the candidates, to be searched again for lamps that they hid.

        The subtraction is approximate, at the phases found.
        """
        few = len(found)
        phase = np.array([f.phase for f in found])
        prior = Prior(
            chips=self._codes[[f.code for f in found]],
            phase=phase - np.floor((phase + job.block.x[0]) / self._profile.length) * self._profile.length,
            rate=np.ones(few), phase_var=np.ones(few), lag_var=1.0, clock_var=1.0,
            amplitude=np.array([f.amplitude for f in found]),
            bit_sum=np.zeros(few), bit_weight=np.zeros(few), pulse=np.zeros(few),
        )  # fmt: skip
        block = replace(job.block, y=without(job.block, prior, self._table))
        codes = np.append(job.codes, [f.code for f in found])
        return Job(block, job.t_middle, job.lag, codes, np.append(job.phases, phase), job.floor, job.again + 1)


@cache
def _fast_length(n: int) -> int:
    """Smallest even number of at least ``n`` without prime factors above 5, for a fast FFT."""
    odd: list[int] = [3**i * 5**j for i in range(11) for j in range(8)]
    return min(k << max((n - 1) // k, 1).bit_length() for k in odd if k < 2 * n)


def _spectrum(y: Array, size: int) -> Spectrum:
    """Half spectrum of a zero-padded block in single precision, which is fast and sufficient to find peaks."""
    return np.fft.rfft(y.astype(np.float32), size).astype(np.complex64, copy=False)


def _dominant(found: list[Found]) -> list[Found]:
    """Candidates too strong to be a cross-correlation of the strongest one, strongest first."""
    found = sorted(found, key=lambda f: -f.amplitude)[:MOST_FOUND]
    return [f for f in found if f.amplitude > DOMINANCE * found[0].amplitude]

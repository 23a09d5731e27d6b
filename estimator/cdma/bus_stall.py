"""I2C bus stall inside a block: detection from the residual, and correction of a single pause.

After a pause of d seconds every lamp is d chip_rate chips ahead of the time base, all at once. A pause of 4 us (2 % of
a chip) already costs 1 to 6 % of a weak lamp's amplitude. No time stamp shows it; the strong lamps do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.correlation_kernels import columns
from estimator.cdma.interference.background import Background
from estimator.cdma.joint_fit import joint_fit
from estimator.cdma.sample_block import Fit, Prior, Sampled
from estimator.numerics.arrays import Array

PARTS: Final = 12
"""Parts of a block whose phases are compared."""

BENT: Final = 4.0
"""Threshold of the energy explained by different phases, per degree of freedom and over the noise. Undisturbed blocks
stay below 2.
"""

SLIGHT: Final = 0.1
"""Share of the residual that different phases explain up to which amplitudes suffer no more from it than from noise:
signals correlate with a lamp by 0.1 rms, noise by 0.03.
"""

SMALLEST: Final = 0.002
"""Chips: phase differences below this do no harm (0.4 us with profile A)."""

LOUD: Final = 1.5
"""Noise over its usual level that requires an explanation."""

SMOOTH: Final = 0.4
"""Share of slow signal in the residual above which it is mains flicker; 0.11 for noise, less for codes."""

CLEARER: Final = 1.01
"""Correlation with two delays over that with one, above which a pause is accepted."""

SEGMENT_CHIPS: Final = 10.0
LEADERS: Final = 4
LONGEST_CHIPS: Final = 3.2
"""Longest pause searched for: 640 us with profile A."""

PASSES: Final = 3
"""Passes to find the length of a pause. The mains rows change with it: 1 us of it is 10 nA of 100 Hz flicker."""

MARGIN: Final = 12
"""Samples masked on both sides of a small pause, whose position is uncertain by a few samples, and of a burst."""

BURST: Final = 0.25
"""Share of the residual within 2 `MARGIN` samples from which it is a burst: a flash, a spark, or light that stands
still. Residuals of a lamp or a pause spread over the block.
"""


@dataclass(frozen=True, eq=False)
class Verdict:
    """Quality of a fit to its block.

    Attributes:
        bent: phases differ over the block. loud: the residual is far larger than usual.
        skewed: phases change steadily over the block, which no pause does, but an error of the sample clock.
        slight: phases differ evidently, but so little that it hardly changes amplitudes.
        smooth: and the residual is mains flicker, which a pause has torn, not the light of an untracked lamp.
    """

    bent: bool
    loud: bool
    smooth: bool
    skewed: bool = False
    slight: bool = False

    @property
    def good(self) -> bool:
        """Whether the fit explains the block."""
        return not (self.bent or self.loud)


@dataclass(frozen=True, eq=False)
class Mended:
    """A block with a corrected time base, and its fit; ``lag``: delay of its prior beyond the first one, chips."""

    block: Sampled
    prior: Prior
    fit: Fit
    lag: float


def judge(block: Sampled, fit: Fit, usual_noise: float) -> Verdict:
    """Compare the phases of parts of the block, and the residual with the usual noise (ADC steps; 0 if unknown)."""
    edges = _edges(len(block.y))
    slope = fit.mixed_slope
    energy = np.maximum(np.add.reduceat(slope * slope, edges), 1e-12)
    overlap = np.add.reduceat(slope * fit.residual, edges)
    explained = float(np.sum(overlap**2 / energy))
    left = float(np.einsum("i,i->", fit.residual, fit.residual))
    rest = max(left - explained, 1e-12) / len(block.y)
    bent = explained / PARTS > BENT * rest and float(np.max(np.abs(overlap / energy))) > SMALLEST
    loud = usual_noise > 0.0 and fit.noise_var > (LOUD * usual_noise) ** 2
    skewed = bent and _is_ramp(overlap / energy, energy)
    slight = bent and not loud and explained < SLIGHT * left
    return Verdict(bent, loud, loud and _slow_energy(fit.residual) > SMOOTH * left, skewed, slight)


def _is_ramp(shift: Array, weight: Array) -> bool:
    """Whether a ramp explains these shifts of the parts of a block better than any step does."""
    trials = np.concatenate((np.linspace(-1.0, 1.0, PARTS)[None], np.tri(PARTS, PARTS, -1)[1:]))
    trials = trials - (trials * weight).sum(axis=1, keepdims=True) / weight.sum()
    explained = (trials * weight * shift).sum(axis=1) ** 2 / (trials**2 * weight).sum(axis=1)
    return int(np.argmax(explained)) == 0


@lru_cache(maxsize=64)
def _edges(size: int) -> npt.NDArray[np.int64]:
    """First samples of the parts of a block."""
    return np.linspace(0, size, PARTS + 1).astype(np.int64)[:-1]


def _slow_energy(row: Array) -> float:
    """Energy of the part of a row that is slower than the codes."""
    slow = _two_chips(row)
    return float(np.einsum("i,i->", slow, slow))


def _two_chips(row: Array) -> Array:
    """Mean over nine samples, two chips of any profile: the signal slower than the codes."""
    return np.convolve(row, np.full(9, 1.0 / 9.0), "same")


def mend(
    block: Sampled,
    fit: Fit,
    prior_at: Callable[[float], Prior],
    tables: Array,
    background: Background,
    usual_noise: float,
) -> Mended | bool:
    """Try to explain a block by a burst or one pause. If that fails, return whether there is evidence of a pause.

    Args:
        block: as it was solved.
        fit: the fit to it.
        prior_at: prediction of the tracks for a common delay beyond the one `fit` started from, chips.
        tables: pulse tables.
        background: for the rows of a corrected time base.
        usual_noise: ADC steps, to judge the result by.
    """
    verdict = judge(block, fit, usual_noise)
    without = _without_burst(block, fit, prior_at(0.0), tables, background) if verdict.loud else None
    if without is not None:
        better = judge(without.block, without.fit, usual_noise)
        if better.good or better.slight:
            return without
    evident = verdict.bent or verdict.smooth
    for place in (_large_pause, _small_pause):
        found = place(block, fit, prior_at(fit.lag), tables)
        if found is None or (place is _small_pause and not evident):
            continue
        low, high, at, chips, lag = found
        lag += fit.lag
        mask = block.mask.copy()
        mask[low:high] = 0.0
        for _ in range(PASSES):
            x = block.x.copy()
            x[at:] += chips
            rows = background.masked((x - x[0]) / (block.x[1] - block.x[0]), mask)
            bent, prior = Sampled(block.y * mask, x, mask, rows, (at,)), prior_at(lag)
            again = joint_fit(bent, prior, tables)
            verdict = judge(bent, again, usual_noise)
            if verdict.good:
                return Mended(bent, prior, again, lag)
            lag, chips = lag + again.lag, chips + float(again.steps[0])
        evident = True
    return evident


def _without_burst(block: Sampled, fit: Fit, prior: Prior, tables: Array, background: Background) -> Mended | None:
    """The block with its loudest samples masked; None if the residual is not concentrated there."""
    power = np.cumsum(np.concatenate(((0.0,), fit.residual**2)))
    within = power[2 * MARGIN :] - power[: -2 * MARGIN]
    begin = int(np.argmax(within))
    if within[begin] < BURST * power[-1]:
        return None
    mask = block.mask.copy()
    mask[begin : begin + 2 * MARGIN] = 0.0
    rows = background.masked((block.x - block.x[0]) / (block.x[1] - block.x[0]), mask)
    quiet = Sampled(block.y * mask, block.x, mask, rows)
    return Mended(quiet, prior, joint_fit(quiet, prior, tables), 0.0)


_Pause = tuple[int, int, int, float, float]
"""Masked samples (first, end), first sample after the pause, its length (chips), delay of the front part (chips)."""


def _large_pause(block: Sampled, fit: Fit, prior: Prior, tables: Array) -> _Pause | None:
    """Find a pause by two delays, before and after it, correlating the strongest lamps at whole-sample lags."""
    chosen = np.argsort(-fit.amplitude)[:LEADERS]
    n, spacing = len(block.x), float(block.x[1] - block.x[0])
    waves, ones = np.empty((2, len(chosen), n)), np.ones((len(chosen), fit.soft.shape[1]))
    lamps = np.ascontiguousarray(prior.lamps(fit.phase)[:, chosen])
    columns(prior.chips[chosen], lamps, block.samples, ones, tables, waves)
    y = (block.y - _two_chips(block.y)) * block.mask  # without the step of the mains flicker at the pause
    segment = max(int(SEGMENT_CHIPS / spacing), 4)
    edges = np.arange(0, n - segment // 2, segment)
    reach = int(np.ceil(LONGEST_CHIPS / spacing))
    lags = np.arange(-reach, reach + 1)
    score = np.empty((len(lags), len(edges)))
    for row, lag in zip(score, lags.tolist(), strict=True):
        ahead, behind = max(lag, 0), max(-lag, 0)
        moved = np.zeros((len(chosen), n))
        moved[:, behind : n - ahead] = waves[0, :, ahead : n - behind]
        row[:] = np.einsum("i,is->s", fit.amplitude[chosen], np.abs(np.add.reduceat(moved * y, edges, axis=1)))
    front = np.cumsum(score, axis=1)[:, :-1]
    back = score.sum(axis=1)[:, None] - front
    best = np.max(front, axis=0) + np.max(back, axis=0)
    k = int(np.argmax(best))
    before, after = int(lags[np.argmax(front[:, k])]), int(lags[np.argmax(back[:, k])])
    if after <= before or best[k] < CLEARER * np.max(score.sum(axis=1)):
        return None
    at = int(edges[k + 1])
    return max(at - segment, 0), min(at + segment, n), at, (after - before) * spacing, before * spacing


def _small_pause(block: Sampled, fit: Fit, prior: Prior, tables: Array) -> _Pause | None:
    """Find the position at which a phase step explains most of the residual."""
    del prior, tables
    n = len(block.y)
    overlap = np.cumsum(fit.mixed_slope * fit.residual)
    energy = np.cumsum(fit.mixed_slope**2)
    share = np.clip(energy / energy[-1], 1e-3, 1.0 - 1e-3)
    at = int(np.argmax(overlap**2 / (share * (1.0 - share)))) + 1
    return max(at - MARGIN, 0), min(at + MARGIN, n), min(at, n - 1), 0.0, 0.0

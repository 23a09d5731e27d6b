"""A bus that stood still inside a block: found by what it leaves over, and corrected where one pause explains it.

After a pause of d seconds every lamp is d chip_rate chips ahead of the time base, all at once. One of 4 us (2 % of a
chip) already costs 1 to 6 % of a weak lamp's amplitude, and no time stamp shows it; the strong lamps do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.correlation_kernels import columns
from estimator.cdma.joint_fit import joint_fit
from estimator.cdma.mains_rejection import Mains
from estimator.cdma.sample_block import Fit, Prior, Sampled
from estimator.numerics.arrays import Array

PARTS: Final = 12
"""Parts of a block whose phases are compared."""

BENT: Final = 4.0
"""Energy explained by different phases per degree of freedom, over the noise; undisturbed blocks stay below 2."""

SMALLEST: Final = 0.002
"""Chips: phase differences below this do no harm (0.4 us with profile A)."""

LOUD: Final = 1.5
"""Noise over its usual level that calls for an explanation."""

SMOOTH: Final = 0.4
"""Share of slow signal in what is left over, beyond which it is mains flicker; 0.11 for noise, less for codes."""

CLEARER: Final = 1.01
"""Correlation with two lags over that with one, beyond which a pause is believed."""

SEGMENT_CHIPS: Final = 10.0
LEADERS: Final = 4
LONGEST_CHIPS: Final = 3.2
"""Pauses up to 640 us with profile A are looked for."""

PASSES: Final = 3
"""The mains rows bend with the pause, so its length is found in passes: 1 us of it is 10 nA of 100 Hz flicker."""

MARGIN: Final = 12
"""Samples left out on both sides of a small pause, whose place is known to a few samples."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """How well a fit explains its block.

    Attributes:
        bent: phases differ over the block. loud: far more is left over than usual. smooth: and it is mains flicker that
            is left, which a pause has torn, not the light of a lamp that is not known yet.
    """

    bent: bool
    loud: bool
    smooth: bool

    @property
    def good(self) -> bool:
        """Nothing to be explained."""
        return not (self.bent or self.loud)


@dataclass(frozen=True, eq=False)
class Mended:
    """A block with its time base bent, and the fit to it; ``lag``: of its prior beyond the first one, chips."""

    block: Sampled
    prior: Prior
    fit: Fit
    lag: float


def judge(block: Sampled, fit: Fit, usual_noise: float) -> Verdict:
    """Compare the phases of parts of the block, and what is left over with the usual (ADC steps; 0 if not known)."""
    edges = _edges(len(block.y))
    slope = fit.mixed_slope
    energy = np.maximum(np.add.reduceat(slope * slope, edges), 1e-12)
    overlap = np.add.reduceat(slope * fit.residual, edges)
    explained = float(np.sum(overlap**2 / energy))
    left = float(np.einsum("i,i->", fit.residual, fit.residual))
    rest = max(left - explained, 1e-12) / len(block.y)
    bent = explained / PARTS > BENT * rest and float(np.max(np.abs(overlap / energy))) > SMALLEST
    loud = usual_noise > 0.0 and fit.noise_var > (LOUD * usual_noise) ** 2
    return Verdict(bent, loud, loud and _slow_energy(fit.residual) > SMOOTH * left)


@lru_cache(maxsize=64)
def _edges(size: int) -> npt.NDArray[np.int64]:
    """First samples of the parts of a block."""
    return np.linspace(0, size, PARTS + 1).astype(np.int64)[:-1]


def _slow_energy(row: Array) -> float:
    slow = _two_chips(row)
    return float(np.einsum("i,i->", slow, slow))


def _two_chips(row: Array) -> Array:
    """Mean over nine samples, two chips of any profile: what is slower than codes."""
    return np.convolve(row, np.full(9, 1.0 / 9.0), "same")


def mend(
    block: Sampled, fit: Fit, prior_at: Callable[[float], Prior], table: Array, mains: Mains, usual_noise: float
) -> Mended | bool:
    """Try to explain a block by one pause; if that fails, whether there is evidence of a pause all the same.

    Args:
        block: as it was solved.
        fit: what came of that.
        prior_at: prediction of the tracks for a common lag beyond the one `fit` started from, chips.
        table: pulse table.
        mains: for rows that follow a bent time base.
        usual_noise: ADC steps, to judge the result by.
    """
    verdict = judge(block, fit, usual_noise)
    evident = verdict.bent or verdict.smooth
    for place in (_large_pause, _small_pause):
        found = place(block, fit, prior_at(fit.lag), table)
        if found is None or (place is _small_pause and not evident):
            continue
        low, high, at, chips, lag = found
        lag += fit.lag
        mask = block.mask.copy()
        mask[low:high] = 0.0
        for _ in range(PASSES):
            x = block.x.copy()
            x[at:] += chips
            rows = mains.masked((x - x[0]) / (block.x[1] - block.x[0]), mask)
            bent, prior = Sampled(block.y * mask, x, mask, rows, (at,)), prior_at(lag)
            again = joint_fit(bent, prior, table)
            verdict = judge(bent, again, usual_noise)
            if verdict.good:
                return Mended(bent, prior, again, lag)
            lag, chips = lag + again.lag, chips + float(again.steps[0])
        evident = True
    return evident


_Pause = tuple[int, int, int, float, float]
"""First and last sample left out, first sample behind the pause, chips it lasted, chips by which the front was off."""


def _large_pause(block: Sampled, fit: Fit, prior: Prior, table: Array) -> _Pause | None:
    """Two different lags before and behind a place: correlate the strongest lamps at whole-sample lags."""
    chosen = np.argsort(-fit.amplitude)[:LEADERS]
    n, spacing = len(block.x), float(block.x[1] - block.x[0])
    waves, ones = np.empty((2, len(chosen), n)), np.ones((len(chosen), fit.soft.shape[1]))
    lamps = np.ascontiguousarray(prior.lamps(fit.phase)[:, chosen])
    columns(prior.chips[chosen], lamps, block.samples, ones, table, waves)
    y = (block.y - _two_chips(block.y)) * block.mask  # without what mains flicker does at the pause
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


def _small_pause(block: Sampled, fit: Fit, prior: Prior, table: Array) -> _Pause | None:
    """Where a step of phase explains most of what is left over."""
    del prior, table
    n = len(block.y)
    overlap = np.cumsum(fit.mixed_slope * fit.residual)
    energy = np.cumsum(fit.mixed_slope**2)
    share = np.clip(energy / energy[-1], 1e-3, 1.0 - 1e-3)
    at = int(np.argmax(overlap**2 / (share * (1.0 - share)))) + 1
    return max(at - MARGIN, 0), min(at + MARGIN, n), min(at, n - 1), 0.0, 0.0

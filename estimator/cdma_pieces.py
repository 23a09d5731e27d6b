"""The data signs of a block: amplitude of every lamp in every code period touched, solved jointly.

One more pair of rows stands for what the leaders' lag and clock are off by; without it their errors, ten times a weak
lamp's light, would look like noise and hide its signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma_block import Fit, Prior, Sampled
from estimator.cdma_kernels import columns, cut, gram, gram_within, inner, invert, mixed

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

LEADER: Final = 0.4
"""Lamps of at least this share of the strongest lead: their signs are certain before anything is solved."""

SURE: Final = 4.0
"""A data sign is certain when it is so many standard deviations clear."""

ALIKE: Final = 0.1
"""Relative change of a lamp's strength within a block that surprises nobody."""

LONG_PIECE: Final = 0.25
"""A code period of which the block holds at least this share gets its likelier sign in any case."""

REACH: Final = 0.12
"""Chips: the derivative columns are trusted so far."""


@dataclass(eq=False)
class Pieces:
    """The block's signal, a row per lamp and code period touched (K), and two for lag and clock.

    Attributes:
        lamp, period: (K,) of each row. size: (L, P) samples of each period. rows: (K + 2, N).
        found: (K + 2,) amplitudes with their signs; lag in chips; relative clock.
        unit_var: (K,) variance at unit noise. noise_var: per sample.
    """

    lamp: Index
    period: Index
    size: Index
    rows: Array
    found: Array
    unit_var: Array
    noise_var: float


@dataclass(eq=False)
class Signs:
    """Data signs (L, P), 0 where a short piece is not certain; amplitudes with sign and their variances, inf if absent.

    ``lag`` and ``clock``: first corrections to the prior's. ``noise_var``: per sample.
    """

    signs: Array
    soft: Array
    soft_var: Array
    lag: float
    clock: float
    noise_var: float


def solve_pieces(block: Sampled, prior: Prior, table: Array) -> Pieces:
    """Solve for the amplitude of each lamp in each code period touched, at the phases of the prior."""
    waves, bounds = _waves(block, prior, table)
    size = np.diff(bounds, axis=1)
    touched = size > 0
    touched[:, 0] = True  # if by nothing else, by the tail of its last chip
    period, lamp = np.nonzero(touched.T)  # in order of time: neighbours in the Gram matrix cover the same samples
    k, n = len(lamp), len(block.x)
    stack = stacked(block, k + 2)
    extent = np.zeros((2, len(stack)), np.int64)
    extent[1] = n
    drive = np.where(prior.amplitude > LEADER * np.max(prior.amplitude), prior.amplitude, 0.0)
    tail = int(2.0 / (block.x[1] - block.x[0]))
    data, index = np.stack([block.clean, block.x]), np.stack([lamp, period])
    cut(waves, bounds, index, data, drive, tail, extent, stack)
    normal, right, power = reduced(stack, k + 2, extent)
    normal[range(k), range(k)] += 1e-3  # a thousandth of a sample's worth: pieces of one sample
    normal[k, k] *= 1.001
    normal[k + 1, k + 1] *= 1.001
    invert(normal)
    found = np.einsum("ij,j->i", normal, right)
    noise_var = max(power - float(np.einsum("i,i->", right, found)), 1e-30) / max(n - len(block.q) - k - 2, 1)
    return Pieces(lamp, period, size, stack[: k + 2], found, np.maximum(normal.diagonal()[:k], 1e-12), noise_var)


def _waves(block: Sampled, prior: Prior, table: Array) -> tuple[Array, Index]:
    """Waveforms (2, 2 * L, N) without data signs, of even periods and then of odd ones, and bounds (L, P + 1).

    A chip's tail reaches into the next code period with the sign of its own, hence one without the other.
    """
    n_lamps, length = prior.chips.shape
    touched = (
        int((block.x[-1] - block.x[0]) / length) + 4
    )  # a tail in front, and one spare for corrections of the clock
    signs = np.zeros((2 * n_lamps, touched))
    signs[:n_lamps, ::2] = 1.0
    signs[n_lamps:, 1::2] = 1.0
    waves = np.empty((2, 2 * n_lamps, len(block.x)))
    chips, lamps = np.concatenate([prior.chips, prior.chips]), np.tile(prior.lamps(), 2)
    return waves, columns(chips, lamps, block.samples, signs, table, waves)[:n_lamps]


def stacked(block: Sampled, free: int) -> Array:
    """Room for ``free`` rows (not initialised) above the block's mains rows and its y."""
    stack = np.empty((free + len(block.q) + 1, len(block.y)))
    stack[free:-1] = block.q
    stack[-1] = block.y
    return stack


def reduced(stack: Array, free: int, extent: Index | None = None) -> tuple[Array, Array, float]:
    """Normal matrix and right side of the first ``free`` rows with the mains rows eliminated; power of y likewise.

    Args:
        stack: unknowns' rows, then the orthonormal mains rows, then y.
        free: number of unknowns.
        extent: (2, M) where rows are not zero; None: everywhere.
    """
    out = np.empty((len(stack), free))
    if extent is None:
        gram(stack, free, out)
    else:
        gram_within(stack, extent, free, out)
    inside, y_inside = np.ascontiguousarray(out[free:-1].T), inner(stack[free:-1], stack[-1])
    overlap = np.empty((free, free))
    gram(inside, free, overlap)
    power = np.einsum("i,i->", stack[-1], stack[-1]) - np.einsum("i,i->", y_inside, y_inside)
    return out[:free] - overlap, out[-1] - np.einsum("ij,j->i", inside, y_inside), float(power)


def without(block: Sampled, prior: Prior, table: Array) -> Array:
    """What is left of a block when these lamps are taken out near these phases; (N,), mains taken out as well."""
    pieces = solve_pieces(block, prior, table)
    return block.project(block.y - mixed(pieces.found, pieces.rows))


def data_signs(block: Sampled, prior: Prior, table: Array) -> Signs:
    """Data signs of a block, from this block and from what the last one said about the first period touched."""
    pieces = solve_pieces(block, prior, table)
    at = (pieces.lamp, pieces.period)
    soft, variance = np.zeros(pieces.size.shape), np.full(pieces.size.shape, np.inf)
    soft[at] = pieces.found[:-2]
    variance[at] = pieces.noise_var * pieces.unit_var
    total, weight = soft / variance, 1.0 / variance
    total[:, 0] += prior.bit_sum
    weight[:, 0] += prior.bit_weight
    whole = prior.chips.shape[1] * len(block.x) / (block.x[-1] - block.x[0])
    long = pieces.size > LONG_PIECE * whole
    settled = _settled(prior, soft, variance, long)
    settled[:, 1:] |= pieces.size[:, 1:] == 0
    lag = float(np.clip(pieces.found[-2], -REACH, REACH))
    clock = float(np.clip(pieces.found[-1], -REACH / block.x[-1], REACH / block.x[-1]))
    signs = np.where(total < 0, -1.0, 1.0) * settled
    return Signs(signs, soft, variance, lag, clock, pieces.noise_var)


def _settled(prior: Prior, soft: Array, variance: Array, long: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(L, P) periods whose sign is certain: by what the last block said, or by length.

    A short piece must be both clear and as strong as the rest of its lamp: what disturbs a block's last samples must
    not pass for a sign.
    """
    weight = np.where(long, 1.0 / variance, 0.0)
    usual = np.sum(np.abs(soft) * weight, axis=1) / np.maximum(np.sum(weight, axis=1), 1e-30)
    sigma, strength = np.sqrt(variance), np.abs(soft)
    alike = np.abs(strength - usual[:, None]) < SURE * sigma + ALIKE * usual[:, None]
    settled: npt.NDArray[np.bool_] = long | (alike & (strength > SURE * sigma))
    settled[:, 0] |= np.abs(prior.bit_sum) > SURE * np.sqrt(prior.bit_weight)
    return settled


SHIFTS: Final = np.array([0.0, -0.5, 0.5, -1.0, 1.0])
"""Chips: where a Manchester code has side lobes (-0.5 at half a chip)."""


def side_lobe(block: Sampled, prior: Prior, fit: Fit, lamp: int, table: Array) -> float:
    """Chips by which one lamp of a fit sits beside its correlation peak: 0, or one of the side lobes' distances."""
    few = len(SHIFTS)
    waves, signs = np.empty((2, few, len(block.x))), np.ones((few, fit.soft.shape[1]))
    phase = prior.phase[lamp] + SHIFTS + fit.phase[lamp] + fit.lag
    lamps = np.stack([phase, np.full(few, prior.rate[lamp] * (1.0 + fit.clock))])
    bounds = columns(np.repeat(prior.chips[[lamp]], few, axis=0), lamps, block.samples, signs, table, waves)
    cut = bounds[0]
    bits = np.repeat(np.where(fit.soft[lamp] < 0, -1.0, 1.0), np.diff(cut))
    target = fit.residual + fit.amplitude[lamp] * bits * waves[0, 0]
    score = np.array([np.abs(np.add.reduceat(row * target, cut[:-1][np.diff(cut) > 0])).sum() for row in waves[0]])
    return float(SHIFTS[np.argmax(score)])

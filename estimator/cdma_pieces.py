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
from estimator.cdma_kernels import columns, gram, invert

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

LEADER: Final = 0.4
"""Lamps of at least this share of the strongest lead: their signs are certain before anything is solved."""

SURE: Final = 4.0
"""A data sign is certain when it is so many standard deviations clear."""

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
    waves, bounds, place, leads = _waves(block, prior, table)
    size = np.diff(bounds, axis=1)
    lamp, period = np.nonzero(size)
    k, n, clean = len(lamp), len(block.x), block.clean
    tail = int(2.0 / (block.x[1] - block.x[0]))
    stack = stacked(block, k + 2)
    stack[: k + 1] = 0.0
    for row, (i, p) in enumerate(zip(lamp.tolist(), period.tolist(), strict=True)):
        if leads[i]:
            piece, wave = slice(bounds[i, p], bounds[i, p + 1] + tail), place[i, p % 2]
            stack[row, piece] = waves[0, wave, piece]
            sign = np.sign(np.einsum("i,i->", waves[0, wave, piece], clean[piece]))
            stack[k, piece] += sign * prior.amplitude[i] * waves[1, wave, piece]
        else:
            piece = slice(bounds[i, p], bounds[i, p + 1])
            stack[row, piece] = waves[0, place[i, 0], piece]
    stack[k + 1] = stack[k] * block.x
    normal, right, power = reduced(stack, k + 2)
    normal[range(k), range(k)] += 1e-3  # a thousandth of a sample's worth: pieces of one sample
    normal[k, k] *= 1.001
    normal[k + 1, k + 1] *= 1.001
    invert(normal)
    found = np.einsum("ij,j->i", normal, right)
    noise_var = max(power - float(np.einsum("i,i->", right, found)), 1e-30) / max(n - len(block.q) - k - 2, 1)
    return Pieces(lamp, period, size, stack[: k + 2], found, np.maximum(normal.diagonal()[:k], 1e-12), noise_var)


def _waves(block: Sampled, prior: Prior, table: Array) -> tuple[Array, Index, Index, npt.NDArray[np.bool_]]:
    """Waveforms without data signs, bounds (L, P + 1), rows of each lamp's even and odd periods (L, 2), and who leads.

    A chip's tail reaches into the next code period, with the sign of its own; where the sign changes that is a fifth of
    a weak lamp's light. So the leaders' odd periods are computed without the even ones and the other way round.
    """
    n_lamps, length = prior.chips.shape
    touched = int((block.x[-1] - block.x[0]) / length) + 3  # one spare for corrections of the clock
    leads: npt.NDArray[np.bool_] = prior.amplitude > LEADER * np.max(prior.amplitude)
    first, second = np.arange(n_lamps), np.arange(n_lamps)
    second[leads] = n_lamps + np.arange(np.count_nonzero(leads))
    order = np.append(first, np.flatnonzero(leads))
    signs = np.ones((len(order), touched))
    signs[np.flatnonzero(leads), 1::2] = 0.0
    signs[n_lamps:, ::2] = 0.0
    waves = np.empty((2, len(order), len(block.x)))
    lamps = np.ascontiguousarray(prior.lamps()[:, order])
    bounds = columns(prior.chips[order], lamps, block.samples, signs, table, waves)
    return waves, bounds[:n_lamps], np.stack([first, second], axis=1), leads


def stacked(block: Sampled, free: int) -> Array:
    """Room for ``free`` rows (not initialised) above the block's mains rows and its y."""
    stack = np.empty((free + len(block.q) + 1, len(block.y)))
    stack[free:-1] = block.q
    stack[-1] = block.y
    return stack


def reduced(stack: Array, free: int) -> tuple[Array, Array, float]:
    """Normal matrix and right side of the first ``free`` rows with the mains rows eliminated; power of y likewise.

    ``stack``: unknowns' rows, then the orthonormal mains rows, then y.
    """
    out = np.empty((len(stack), free))
    gram(stack, free, out)
    inside = np.ascontiguousarray(out[free:-1].T)
    y_inside = np.einsum("ij,j->i", stack[free:-1], stack[-1])
    overlap = np.empty((free, free))
    gram(inside, free, overlap)
    power = np.einsum("i,i->", stack[-1], stack[-1]) - np.einsum("i,i->", y_inside, y_inside)
    return out[:free] - overlap, out[-1] - np.einsum("ij,j->i", inside, y_inside), float(power)


def without(block: Sampled, prior: Prior, table: Array) -> Array:
    """What is left of a block when these lamps are taken out near these phases; (N,), mains taken out as well."""
    pieces = solve_pieces(block, prior, table)
    return block.project(block.y - np.einsum("i,ij->j", pieces.found, pieces.rows))


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
    settled = (np.abs(total) > SURE * np.sqrt(weight)) | long | (pieces.size == 0)
    lag = float(np.clip(pieces.found[-2], -REACH, REACH))
    clock = float(np.clip(pieces.found[-1], -REACH / block.x[-1], REACH / block.x[-1]))
    signs = np.where(total < 0, -1.0, 1.0) * settled
    return Signs(signs, soft, variance, lag, clock, pieces.noise_var)


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

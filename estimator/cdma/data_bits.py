"""Data signs of a block: joint solution for the amplitude of every lamp in every code period touched.

A further pair of rows corrects the delay and clock of the leading lamps. Without it their errors, ten times a weak
lamp's light, would look like noise and hide its signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.code_period_kernels import TAIL_CHIPS, compare_shifts, cut, decide_signs, lay_out, solve_rows
from estimator.cdma.correlation_kernels import columns, mixed
from estimator.cdma.joint_fit_kernels import REACH
from estimator.cdma.sample_block import Fit, Prior, Sampled, rows_of
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

LEADER: Final = 0.4
"""Share of the strongest amplitude from which lamps lead: their signs are certain before the solution."""

LONG_PIECE: Final = 0.25
"""Share of a code period within the block from which it gets its likelier sign in any case."""


@dataclass(eq=False)
class Pieces:
    """The block's signal: one row per lamp and code period touched (K), and two rows for delay and clock.

    Attributes:
        index, bounds: of :func:`estimator.cdma.code_period_kernels.lay_out`. rows: (K + 2, N).
        found: (K + 2,) amplitudes with their signs; delay in chips; relative clock.
        unit_var: (K,) variance at unit noise. noise_var: per sample.
    """

    index: Index
    bounds: Index
    rows: Array
    found: Array
    unit_var: Array
    noise_var: float


@dataclass(eq=False)
class Signs:
    """Data signs (L, P), 0 where a short piece is uncertain; signed amplitudes with their variances, inf if absent.

    ``lag`` and ``clock``: first corrections to the prior's. ``noise_var``: per sample.
    """

    signs: Array
    soft: Array
    soft_var: Array
    lag: float
    clock: float
    noise_var: float


def solve_pieces(block: Sampled, prior: Prior, tables: Array) -> Pieces:
    """Solve for the amplitude of each lamp in each code period touched, at the phases of the prior."""
    n_lamps, length = prior.chips.shape
    span = float(block.x[-1] - block.x[0])
    periods = int(span / length) + 4  # a tail in front, and one spare period for clock corrections
    tail = int(TAIL_CHIPS / (block.x[1] - block.x[0]))
    bounds, index = np.empty((n_lamps, periods + 1), np.int64), np.empty((4, n_lamps * periods), np.int64)
    samples, lamps = rows_of(block.x, block.mask, block.clean), prior.lamps()
    k = lay_out(prior.chips, lamps, samples, tail, bounds, index)
    stack = stacked(block, k + 2)
    drive = np.where(prior.amplitude > LEADER * np.max(prior.amplitude), prior.amplitude, 0.0)
    cut(prior.chips, lamps, samples, index, k, tables, drive, stack)
    found, unit_var = np.empty(k + 2), np.empty(k)
    noise_var = solve_rows(stack, index, k, len(block.q), found, unit_var)
    return Pieces(index, bounds, stack[: k + 2], found, unit_var, noise_var)


def stacked(block: Sampled, free: int) -> Array:
    """Array with ``free`` uninitialised rows above the block's mains rows and its y."""
    stack = np.empty((free + len(block.q) + 1, len(block.y)))
    stack[free:-1] = block.q
    stack[-1] = block.y
    return stack


def without(block: Sampled, prior: Prior, tables: Array) -> Array:
    """(N,) residual of a block after subtracting these lamps near these phases, and the mains."""
    pieces = solve_pieces(block, prior, tables)
    return block.project(block.y - mixed(pieces.found, pieces.rows))


def data_signs(block: Sampled, prior: Prior, tables: Array) -> Signs:
    """Data signs of a block, from this block and from the last block's soft bits of the first period touched."""
    pieces = solve_pieces(block, prior, tables)
    whole = prior.chips.shape[1] * len(block.x) / float(block.x[-1] - block.x[0])
    found = rows_of(pieces.found[:-2], pieces.noise_var * pieces.unit_var)
    decided = np.empty((3, len(prior.phase), pieces.bounds.shape[1] - 1))
    decide_signs(
        pieces.index, found, pieces.bounds, rows_of(prior.bit_sum, prior.bit_weight), LONG_PIECE * whole, decided
    )
    reach = REACH / float(block.x[-1])
    lag, clock = pieces.found[-2:].tolist()
    lag, clock = min(max(lag, -REACH), REACH), min(max(clock, -reach), reach)
    return Signs(decided[2], decided[0], decided[1], lag, clock, pieces.noise_var)


SHIFTS: Final = np.array([0.0, -0.5, 0.5, -1.0, 1.0])
"""Side lobes of a Manchester code, chips (-0.5 at half a chip)."""


def side_lobe(block: Sampled, prior: Prior, fit: Fit, lamp: int, tables: Array) -> float:
    """Distance (chips) of one lamp of a fit from its correlation peak: 0, or that of a side lobe."""
    few = len(SHIFTS)
    waves, signs, score = np.empty((2, few, len(block.x))), np.ones((few, fit.soft.shape[1])), np.empty(few)
    phase = prior.phase[lamp] + SHIFTS + fit.phase[lamp] + fit.lag
    lamps = rows_of(phase, *np.full((few, 2), (prior.rate[lamp] * (1.0 + fit.clock), prior.pulse[lamp])).T)
    bounds = columns(prior.chips[[lamp] * few], lamps, block.samples, signs, tables, waves)
    bits = np.where(fit.soft[lamp] < 0, -1.0, 1.0) * fit.amplitude[lamp]
    compare_shifts(waves[0], bounds[0], bits, fit.residual, score)
    return float(SHIFTS[score.argmax()])

"""Joint least squares of one block: all lamps in view, their code phases, common clock, offset and mains at once.

The unknowns are [amplitude of each lamp | code phase of each lamp | common delay | common clock | stalls]. The rows of
the mains subspace are eliminated beforehand. Phases have priors from the tracks: a weak lamp keeps its predicted phase
while a strong one corrects it. Amplitude and phase are bilinear: a few Gauss-Newton steps suffice.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.cdma.data_bits import Signs, data_signs, stacked
from estimator.cdma.joint_fit_kernels import (
    AMPLITUDE,
    AMPLITUDE_VAR,
    AT,
    COMMON_PRECISION,
    COMMON_ROWS,
    COMMON_VAR,
    LAMP_ROWS,
    MOVED,
    MOVED_VAR,
    PHASE,
    PRECISION,
    PULSE,
    RATE,
    SETTLED,
    VALUE,
    build,
    leave,
    solve_once,
)
from estimator.cdma.sample_block import Fit, Prior, Sampled
from estimator.numerics.arrays import Array

MAX_STEPS: Final = 6
"""Most Gauss-Newton steps."""


def joint_fit(block: Sampled, prior: Prior, tables: Array) -> Fit:
    """Fit all lamps of ``prior`` (at least one) to one block: Gauss-Newton until the steps are small.

    ``stack`` holds the columns of the system as rows: values (L), slopes (L), clock, stalls. One row follows for each
    code period of uncertain sign, with an amplitude of its own; then the mains rows and the block.
    """
    first = data_signs(block, prior, tables)
    lamps, common = _start(block, prior, first)
    n, pauses = len(prior.phase), len(block.steps)
    loose = np.array(np.nonzero(first.signs == 0.0), dtype=np.int64)
    free = 2 * n + 1 + pauses + loose.shape[1]
    stack = stacked(block, free)
    noise = np.array((first.noise_var, max(int(block.mask.sum()) - len(block.q) - free, 1)))
    loose_precision = 1.0 / (4.0 * lamps[AMPLITUDE, loose[0]] ** 2 + 1e-12)
    theta, variance, left = np.empty(free + 1), np.empty(free + 1), np.empty((3, len(block.x)))
    for _ in range(MAX_STEPS):
        build(stack, block.samples, lamps, common, prior.chips, first.signs, loose, tables)
        scale = lamps[AMPLITUDE].copy()
        if solve_once(stack, lamps, common, loose_precision, noise, theta, variance) < SETTLED:
            break
    leave(stack, lamps, scale, theta, left)
    return Fit(
        amplitude=lamps[AMPLITUDE],
        amplitude_var=lamps[AMPLITUDE_VAR],
        phase=lamps[MOVED],
        phase_var=lamps[MOVED_VAR],
        lag=float(common[VALUE, 0]),
        lag_var=float(common[COMMON_VAR, 0]),
        clock=float(common[VALUE, 1]),
        clock_var=float(common[COMMON_VAR, 1]),
        steps=common[VALUE, 2:],
        residual=left[0],
        noise_var=float(noise[0]),
        soft=first.soft,
        soft_var=first.soft_var,
        signs=first.signs,
        mixed_slope=left[1],
        nuisance=left[2],
    )


def _start(block: Sampled, prior: Prior, first: Signs) -> tuple[Array, Array]:
    """Initial unknowns in the layout of the kernels: those of the lamps, and those common to them."""
    weight = 1.0 / first.soft_var
    lamps = np.zeros((LAMP_ROWS, len(prior.phase)))
    lamps[PHASE], lamps[RATE], lamps[PRECISION] = prior.phase, prior.rate, 1.0 / prior.phase_var
    lamps[PULSE] = prior.pulse
    lamps[AMPLITUDE] = (np.abs(first.soft) * weight).sum(axis=1) / weight.sum(axis=1)
    common = np.zeros((COMMON_ROWS, 2 + len(block.steps)))
    common[VALUE, :2] = first.lag, first.clock
    common[COMMON_PRECISION, :2] = 1.0 / prior.lag_var, 1.0 / prior.clock_var
    common[AT, 1], common[AT, 2:] = block.x[-1], block.steps
    return lamps, common

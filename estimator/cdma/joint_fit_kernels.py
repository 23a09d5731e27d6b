"""Gauss-Newton kernels of the joint fit: normal equations with the mains eliminated, step, residual.

Each step is one kernel. A block takes a few hundred operations on small arrays. Calling numpy for each of them costs
more than all the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from estimator.cdma.correlation_kernels import columns, gram_within, inner, invert, mixed
from estimator.numerics.jit import kernel

F8 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int64]

LAMP_ROWS = 8
PHASE, RATE, PRECISION, AMPLITUDE, MOVED, AMPLITUDE_VAR, MOVED_VAR, PULSE = range(LAMP_ROWS)
"""Rows of ``lamps``: phase, rate and inverse phase variance of the prior; amplitude; phase correction; variances of the
last two; number of the pulse table.
"""
COMMON_ROWS = 4
VALUE, COMMON_PRECISION, COMMON_VAR, AT = range(COMMON_ROWS)
"""Rows of ``common``, whose columns are delay, clock and the pauses: correction, inverse prior variance, variance, and
the sample at which the pause ends.
"""

SETTLED = 0.006
"""Chips: a last step below this is corrected to second order, with an error below 1e-4 of the amplitude."""
REACH = 0.12
"""Range of validity of the derivative columns, chips."""


@kernel("f8(f8[:,::1], i8[:,::1], i8, f8[:,::1], f8[::1])", inner=True)
def reduce_rows(stack: F8, extent: I8, free: int, matrix: F8, right: F8) -> float:
    """Normal matrix and right side of the first ``free`` rows, with the mains rows eliminated.

    Returns the power of y, likewise without the mains.

    Args:
        stack: (M, N) unknowns' rows, then the orthonormal mains rows, then y.
        extent: (2, M) first sample of each row that may not be zero, and the one behind the last.
        free: number of unknowns.
        matrix: (free, free) out.
        right: (free,) out.
    """
    rows = stack.shape[0]
    out = np.empty((rows, free))
    gram_within(stack, extent, free, out)
    y = stack[rows - 1]
    y_inside = inner(stack[free : rows - 1], y)
    for i in range(free):
        for j in range(i + 1):
            overlap = 0.0
            for m in range(free, rows - 1):
                overlap += out[m, i] * out[m, j]
            matrix[i, j] = matrix[j, i] = out[i, j] - overlap
        inside = 0.0
        for m in range(free, rows - 1):
            inside += out[m, i] * y_inside[m - free]
        right[i] = out[rows - 1, i] - inside
    power = 0.0
    for k in range(y.shape[0]):
        power += y[k] * y[k]
    for m in range(y_inside.shape[0]):
        power -= y_inside[m] * y_inside[m]
    return power


@kernel("void(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[:,::1], f8[:,:,::1])")
def build(stack: F8, samples: F8, lamps: F8, common: F8, chips: F8, signs: F8, loose: I8, tables: F8) -> None:
    """Fill the rows of the unknowns at the present phases: values, slopes, clock, pauses, pieces of uncertain sign."""
    n, size, pauses, last = lamps.shape[1], samples.shape[1], common.shape[1] - 2, loose.shape[1]
    free = 2 * n + 1 + pauses + last
    moved = np.empty((2, size))
    moved[1] = samples[1]
    for k in range(size):
        moved[0, k] = samples[0, k] * (1.0 + common[VALUE, 1])
    for s in range(pauses):
        for k in range(int(common[AT, 2 + s]), size):
            moved[0, k] += common[VALUE, 2 + s]
    at = np.empty((3, n))
    for i in range(n):
        at[0, i] = lamps[PHASE, i] + (common[VALUE, 0] + lamps[MOVED, i])
        at[1, i], at[2, i] = lamps[RATE, i], lamps[PULSE, i]
    columns(chips, at, moved, signs, tables, stack[: 2 * n].reshape((2, n, size)))
    slope = mixed(lamps[AMPLITUDE], stack[n : 2 * n])
    for k in range(size):
        stack[2 * n, k] = slope[k] * samples[0, k]
    for s in range(pauses):
        row, begin = stack[2 * n + 1 + s], int(common[AT, 2 + s])
        row[:begin] = 0.0
        row[begin:] = slope[begin:]
    wave, only, one = np.empty((2, 1, size)), np.empty((1, signs.shape[1])), np.empty((3, 1))
    for r in range(last):
        i = loose[0, r]
        only[:] = 0.0
        only[0, loose[1, r]] = 1.0
        one[:, 0] = at[:, i]
        columns(chips[i : i + 1], one, moved, only, tables, wave)
        stack[free - last + r] = wave[0, 0]


@kernel("void(f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1])", inner=True)
def _share_lag(matrix: F8, right: F8, amplitude: F8, normal: F8, target: F8) -> None:
    """Normal equations of the unknowns: slopes times amplitude are phases, and the common delay shifts all phases.

    Args:
        matrix: (free, free) of the rows.
        right: (free,) of the rows.
        amplitude: (L,).
        normal: (free + 1, free + 1) out.
        target: (free + 1,) out.
    """
    n, free = amplitude.shape[0], right.shape[0]
    lag, unit = 2 * n, np.ones(free)
    unit[n:lag] = amplitude
    normal[lag], target[lag] = 0.0, 0.0
    for i in range(free):
        a = i if i < lag else i + 1
        for j in range(free):
            b = j if j < lag else j + 1
            value = matrix[i, j] * unit[i] * unit[j]
            normal[a, b] = value
            if n <= i < lag:
                normal[lag, b] += value
        target[a] = unit[i] * right[i]
        if n <= i < lag:
            target[lag] += target[a]
    for i in range(n, lag):
        normal[lag, lag] += normal[lag, i]
    for b in range(free + 1):
        normal[b, lag] = normal[lag, b]


@kernel("f8(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1], i8)", inner=True)
def _move(lamps: F8, common: F8, theta: F8, variance: F8, bend: F8, size: int) -> float:
    """Apply the step, limited to the validity of the columns; returns its size in chips for significant lamps.

    The amplitude is corrected for the curvature of the correlation peak (slope energy over value energy).
    """
    n, more = lamps.shape[1], common.shape[1]
    end = common[AT, 1]  # the last sample's time
    largest, shared = 0.0, 0.0
    for k in range(more):
        reach = REACH / end if k == 1 else REACH
        step = min(max(theta[2 * n + k], -reach), reach)
        common[VALUE, k] += step
        common[COMMON_VAR, k] = variance[2 * n + k]
        if k == 0:
            shared += step
        elif k == 1:
            largest = max(largest, abs(step) * end)
        else:
            shared += (1.0 - common[AT, k] / size) * step
            largest = max(largest, abs(step))
    for i in range(n):
        own = min(max(theta[n + i], -REACH), REACH)
        moved = abs(own + shared)
        if abs(theta[i]) > 5.0 * math.sqrt(variance[i]):
            largest = max(largest, moved)
        lamps[AMPLITUDE, i] = abs(theta[i]) * (1.0 + bend[i] * min(moved, 2.0 * SETTLED) ** 2)
        lamps[MOVED, i] += own
        lamps[AMPLITUDE_VAR, i], lamps[MOVED_VAR, i] = variance[i], variance[n + i]
    return largest


@kernel("f8(f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def solve_once(stack: F8, lamps: F8, common: F8, loose_precision: F8, noise: F8, theta: F8, variance: F8) -> float:
    """One Gauss-Newton step from the present rows; returns its size in chips for significant lamps.

    The unknowns are those of the rows and one more, the common delay, behind the slopes. Each phase moves with both its
    own correction and the delay.

    Args:
        stack: as filled by :func:`build`, mains rows and y below.
        lamps: see :data:`LAMP_ROWS`; amplitude, correction and variances are updated.
        common: see :data:`COMMON_ROWS`; likewise.
        loose_precision: inverse prior variance of each uncertain piece.
        noise: variance per sample, updated; degrees of freedom.
        theta: (free + 1,) out: the unknowns.
        variance: (free + 1,) out.
    """
    n, pauses, last = lamps.shape[1], common.shape[1] - 2, loose_precision.shape[0]
    free, lag = 2 * n + 1 + pauses + last, 2 * n
    matrix, right = np.empty((free, free)), np.empty(free)
    extent = np.zeros((2, stack.shape[0]), np.int64)
    extent[1] = stack.shape[1]
    power = reduce_rows(stack, extent, free, matrix, right)
    normal, target, bend = np.zeros((free + 1, free + 1)), np.zeros(free + 1), np.empty(n)
    _share_lag(matrix, right, lamps[AMPLITUDE], normal, target)
    for i in range(n):
        bend[i] = 0.5 * matrix[n + i, n + i] / matrix[i, i]
    weight, current = np.zeros(free + 1), np.zeros(free + 1)
    for i in range(n):
        weight[n + i], current[n + i] = lamps[PRECISION, i], lamps[MOVED, i]
    for k in range(2):
        weight[lag + k], current[lag + k] = common[COMMON_PRECISION, k], common[VALUE, k]
    for r in range(last):
        weight[free + 1 - last + r] = loose_precision[r]
    inverse, pulled = normal.copy(), np.empty(free + 1)
    for a in range(free + 1):
        weight[a] *= noise[0]
        inverse[a, a] += weight[a] + 1e-9 * normal[a, a]
        pulled[a] = target[a] - weight[a] * current[a]
    invert(inverse)
    left = power
    for a in range(free + 1):
        total = 0.0
        for b in range(free + 1):
            total += inverse[a, b] * pulled[b]
        theta[a] = total
        variance[a] = noise[0] * inverse[a, a]  # with the noise that weighted the prior
    for a in range(free + 1):
        product = 0.0
        for b in range(free + 1):
            product += normal[a, b] * theta[b]
        left += theta[a] * (product - 2.0 * target[a])
    noise[0] = max(left, 1e-30) / noise[1]
    for i in range(n):
        variance[i] = noise[0] * inverse[i, i]
    return _move(lamps, common, theta, variance, bend, stack.shape[1])


@kernel("void(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1])")
def leave(stack: F8, lamps: F8, scale: F8, theta: F8, out: F8) -> None:
    """Residual of the last step's solution, derivative of the whole signal by a common phase, and the nuisance part.

    Args:
        stack: as for :func:`solve_once`.
        lamps: after it.
        scale: amplitudes before it.
        theta: its solution.
        out: (3, N) out.
    """
    n, size, free = lamps.shape[1], stack.shape[1], theta.shape[0] - 1
    weights = np.empty(free)
    for i in range(n):
        weights[i] = theta[i]
        weights[n + i] = scale[i] * (theta[n + i] + theta[2 * n])
    for i in range(2 * n, free):
        weights[i] = theta[i + 1]
    signal = mixed(weights, stack[:free])
    q, y = stack[free : stack.shape[0] - 1], stack[stack.shape[0] - 1]
    for k in range(size):
        out[0, k] = y[k] - signal[k]
    out[2] = mixed(inner(q, out[0]), q)
    for k in range(size):
        out[0, k] -= out[2, k]
    out[1] = mixed(lamps[AMPLITUDE], stack[n : 2 * n])

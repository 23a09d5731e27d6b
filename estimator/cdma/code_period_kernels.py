"""Kernels that split a block by code period: one row per lamp and code period, its amplitude and its data sign.

Each step is one kernel for the same reason as in :mod:`estimator.cdma.joint_fit_kernels`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.cdma.correlation_kernels import first_from, invert
from estimator.cdma.joint_fit_kernels import reduce_rows
from estimator.numerics.jit import kernel

F8 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int64]

TAIL_CHIPS = 2.0
"""Length (chips) by which a period outlasts itself: the tail of its last chip, with room for corrections."""

SURE = 4.0
"""Standard deviations from zero beyond which a data sign is certain."""

ALIKE = 0.1
"""Usual relative change of a lamp's amplitude within a block."""


@kernel("i8(f8[:,::1], f8[:,::1], f8[:,::1], i8, i8[:,::1], i8[:,::1])")
def lay_out(chips: F8, lamps: F8, samples: F8, tail: int, bounds: I8, index: I8) -> int:
    """List the code periods of each lamp that a block touches, in order of time; returns their number.

    Args:
        chips: (L, C) chips of each lamp's code.
        lamps: (2 or more, L) phase in chips at time 0, counted from the begin of the first period, and rate.
        samples: times in row 0, non-decreasing; other rows are not used.
        tail: samples by which a period outlasts itself.
        bounds: (L, P + 1) out: index of the first sample of each period; N behind the last.
        index: (4, L * P) out: lamp, period, first sample and the one behind the last of each piece.
    """
    n_lamps, length, size, periods = lamps.shape[1], chips.shape[1], samples.shape[1], bounds.shape[1] - 1
    x = samples[0]
    for i in range(n_lamps):
        phase, at = lamps[0, i], 0
        for p in range(periods):
            bounds[i, p] = at
            limit = (length - phase) / lamps[1, i]
            at = first_from(x, at, limit)
            phase -= length
        bounds[i, periods] = size
    count = 0
    for p in range(periods):
        for i in range(n_lamps):
            if p == 0 or bounds[i, p + 1] > bounds[i, p]:  # at least the tail of the first period is in the block
                index[0, count], index[1, count] = i, p
                index[2, count], index[3, count] = bounds[i, p], min(bounds[i, p + 1] + tail, size)
                count += 1
    return count


@kernel("void(f8[:,::1], f8[:,::1], f8[:,::1], i8[:,::1], i8, f8[:,:,::1], f8[::1], f8[:,::1])")
def cut(chips: F8, lamps: F8, samples: F8, index: I8, count: int, tables: F8, drive: F8, out: F8) -> None:
    """Rows of one lamp in one code period each, with the tail beyond its end, at amplitude and sign 1.

    Args:
        chips: (L, C), as for :func:`lay_out`.
        lamps: (3, L), likewise; row 2: number of the lamp's pulse table.
        samples: (3, N) times; the weight of each sample, 1 or 0; the received signal.
        index: as written by :func:`lay_out`.
        count: number of pieces, K.
        tables: (T, S, 4) of :func:`estimator.cdma.chip_pulse.pulse_table`.
        drive: (L,) amplitude of lamps whose sign is certain from correlation alone; 0 for the others.
        out: (K + 2 or more, N) the rows; then the derivative of all driven lamps together, and that times time.
    """
    length, steps, size = chips.shape[1], tables.shape[1] - 1, samples.shape[1]
    x, received = samples[0], samples[2]
    mixed, slope = out[count], np.empty(size)
    mixed[:] = 0.0
    for r in range(count):
        i, p, low, high = index[0, r], index[1, r], index[2, r], index[3, r]
        code, row, rate, phase, table = chips[i], out[r], lamps[1, i], lamps[0, i], tables[int(lamps[2, i])]
        before = code[length - 1] if p == 0 else 0.0  # the sign of the period before the first is not resolved
        for _ in range(p):
            phase -= length
        row[:low] = 0.0
        row[high:] = 0.0
        total = 0.0
        for n in range(low, high):
            u = max(phase + rate * x[n], 0.0)
            k = np.uint64(u)  # unsigned: no test for indices from the end
            if k > length:
                row[n] = slope[n] = 0.0
                continue
            own = code[k] if k < length else 0.0
            last = code[k - np.uint64(1)] if k > 0 else before
            at = (u - k) * steps
            j = np.uint64(at + 0.5)
            ramp = own * table[j, 2] + last * table[j, 3]
            value = (own * table[j, 0] + last * table[j, 1] + (at - j) / steps * ramp) * samples[1, n]
            row[n], slope[n] = value, ramp * samples[1, n]
            total += value * received[n]
        if drive[i] > 0.0:
            weight = drive[i] if total >= 0.0 else -drive[i]
            for n in range(low, high):
                mixed[n] += weight * slope[n]
    for n in range(size):
        out[count + 1, n] = mixed[n] * x[n]


@kernel("f8(f8[:,::1], i8[:,::1], i8, i8, f8[::1], f8[::1])")
def solve_rows(stack: F8, index: I8, count: int, mains: int, found: F8, unit_var: F8) -> float:
    """Amplitudes of the pieces, with corrections of delay and clock of the leading lamps; returns the noise variance.

    Args:
        stack: (K + 2 + mains + 1, N) rows of :func:`cut`, the mains rows, and the block itself.
        index: of :func:`lay_out`.
        count: K.
        mains: rows of the mains subspace.
        found: (K + 2,) out: amplitudes, delay, clock.
        unit_var: (K,) out, variance at unit noise.
    """
    size, free = stack.shape[1], count + 2
    extent = np.zeros((2, stack.shape[0]), np.int64)
    extent[1] = size
    for r in range(count):
        extent[0, r], extent[1, r] = index[2, r], index[3, r]
    normal, right = np.empty((free, free)), np.empty(free)
    power = reduce_rows(stack, extent, free, normal, right)
    for r in range(count):
        normal[r, r] += 1e-3  # regularises pieces of one sample
    normal[count, count] *= 1.001
    normal[count + 1, count + 1] *= 1.001
    invert(normal)
    for a in range(free):
        total = 0.0
        for b in range(free):
            total += normal[a, b] * right[b]
        found[a] = total
        power -= right[a] * total
    for r in range(count):
        unit_var[r] = max(normal[r, r], 1e-12)
    noise_var: float = max(power, 1e-30) / max(size - mains - free, 1)
    return noise_var


@kernel("void(i8[:,::1], f8[:,::1], i8[:,::1], f8[:,::1], f8, f8[:,:,::1])")
def decide_signs(index: I8, pieces: F8, bounds: I8, earlier: F8, long: float, out: F8) -> None:
    """Data sign of each lamp in each code period, where it is certain.

    A sign is certain by the last block's soft bit, by the length of the piece, or by its significance.

    A short piece must be both significant and as strong as the rest of its lamp. A disturbance of a block's last
    samples must not pass for a sign.

    Args:
        index: of :func:`lay_out`.
        pieces: (2, K) amplitude and variance of each piece.
        bounds: of :func:`lay_out`.
        earlier: (2, L) soft bit of the first period from the last block: sum of soft / variance, and of 1 / variance.
        long: samples from which a period gets its likelier sign in any case.
        out: (3, L, P) amplitude with its sign, 0 where not touched; its variance, inf there; the sign, 0 if uncertain.
    """
    soft, variance, signs = out[0], out[1], out[2]
    soft[:] = 0.0
    variance[:] = np.inf
    for r in range(pieces.shape[1]):
        soft[index[0, r], index[1, r]], variance[index[0, r], index[1, r]] = pieces[0, r], pieces[1, r]
    for i in range(signs.shape[0]):
        usual, weight = 0.0, 1e-30
        for p in range(signs.shape[1]):
            if bounds[i, p + 1] - bounds[i, p] > long:
                usual += abs(soft[i, p]) / variance[i, p]
                weight += 1.0 / variance[i, p]
        usual /= weight
        for p in range(signs.shape[1]):
            size, strength, clear = bounds[i, p + 1] - bounds[i, p], abs(soft[i, p]), SURE * np.sqrt(variance[i, p])
            certain = size > long or (clear < strength and abs(strength - usual) < clear + ALIKE * usual)
            total = soft[i, p] / variance[i, p]
            if p == 0:
                total += earlier[0, i]
                certain = certain or abs(earlier[0, i]) > SURE * np.sqrt(earlier[1, i])
            elif size == 0:
                certain = True
            signs[i, p] = (-1.0 if total < 0.0 else 1.0) if certain else 0.0


@kernel("void(f8[:,::1], i8[::1], f8[::1], f8[::1], f8[::1])")
def compare_shifts(waves: F8, bounds: I8, light: F8, residual: F8, score: F8) -> None:
    """Fit of one lamp at several code shifts: sum over code periods of |correlation|.

    Args:
        waves: (S, N) its waveform at each shift, the first being that of the fit; signs 1.
        bounds: (P + 1,) first sample of each period, by the first shift.
        light: (P,) its amplitude with the sign of each period, as subtracted by the fit.
        residual: (N,) of the fit.
        score: (S,) out.
    """
    for s in range(waves.shape[0]):
        score[s] = 0.0
        for p in range(light.shape[0]):
            total = 0.0
            for n in range(bounds[p], bounds[p + 1]):
                total += waves[s, n] * (residual[n] + light[p] * waves[0, n])
            score[s] += abs(total)

"""Correlation and Gram matrix kernels of the light decoder: all loops over samples.

The caller allocates the large arrays.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from estimator.numerics.jit import kernel

F8 = npt.NDArray[np.float64]
F4 = npt.NDArray[np.float32]
I8 = npt.NDArray[np.int64]


@kernel("i8(f8[:], i8, f8)", inner=True)
def first_from(x: F8, begin: int, limit: float) -> int:
    """Index of the first time at or after ``limit``, from ``begin`` on; N if there is none, or if the limit is NaN.

    ``x`` is non-decreasing, (N,). `np.searchsorted` would make every start load the part of numba that tests for
    scipy's BLAS, and scipy with it. That is half of the loading time of the decoder, and 16 MB.
    """
    low, high = begin, x.shape[0]
    while low < high:
        middle = (low + high) // 2
        if x[middle] < limit or limit != limit:  # NaN: behind all of them
            low = middle + 1
        else:
            high = middle
    return low


@kernel("i8[:,::1](f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1])")
def columns(chips: F8, lamps: F8, samples: F8, signs: F8, tables: F8, out: F8) -> I8:
    """Received waveform of each lamp at amplitude 1, and its derivative with respect to the code phase.

    The pulse table is expanded to first order around its nearest point (5e-5 of the pulse, 4e-4 at its corners).

    Args:
        chips: (L, C) chips of each lamp's code.
        lamps: (3, L) phase, rate, and number of the pulse table; (2, L) if all have the first one. The phase is in
            chips at time 0, counted from the begin of the first period. A first sample slightly before that begin is
            taken as at it. The rate is in chips per unit of time.
        samples: (2, N) times, non-decreasing, and weight: 1, or 0 for a sample that is not to be used.
        signs: (L, P) data sign of each code period touched, in order (0 leaves the period out).
        tables: (T, S, 4) of :func:`estimator.cdma.chip_pulse.pulse_table`.
        out: (2, L, N) waveforms and derivatives.

    Returns:
        (L, P + 1) index of the first sample of each period; N behind the last.
    """
    length, steps = chips.shape[1], tables.shape[1] - 1
    n_lamps, n_samples = out.shape[1], out.shape[2]
    bounds, sent = np.full((n_lamps, signs.shape[1] + 1), n_samples), np.empty(length + 1)
    for i in range(n_lamps):
        phase, rate = lamps[0, i], lamps[1, i]
        table = tables[int(lamps[2, i]) if lamps.shape[0] > 2 else 0]
        before = signs[i, 0]
        begin, period = 0, 0
        while begin < n_samples and period < signs.shape[1]:
            bounds[i, period] = begin
            sign, end = signs[i, period], first_from(samples[0], begin, (length - phase) / rate)
            sent[0] = chips[i, length - 1] * before
            for c in range(length):
                sent[c + 1] = chips[i, c] * sign
            x, weight = samples[0, begin:end], samples[1, begin:end]
            value, slope = out[0, i, begin:end], out[1, i, begin:end]
            lit = x.shape[0] if sign != 0.0 or before != 0.0 else 0
            value[lit:] = 0.0
            slope[lit:] = 0.0
            for n in range(lit):
                u = phase + rate * x[n]
                u = u if u > 0.0 else 0.0  # so that no value, not even NaN, indexes beyond a table
                u = u if u < length else float(length)
                k = np.uint64(min(np.int32(u), np.int32(length - 1)))  # unsigned: no test for indices from the end
                at = (u - k) * steps
                j = np.uint64(np.int32(at + 0.5))
                last, own = sent[k], sent[k + np.uint64(1)]
                ramp = own * table[j, 2] + last * table[j, 3]
                value[n] = (own * table[j, 0] + last * table[j, 1] + (at - j) / steps * ramp) * weight[n]
                slope[n] = ramp * weight[n]
            begin = end
            phase -= length
            before = sign
            period += 1
        out[:, i, begin:] = 0.0
    return bounds


@kernel("UniTuple(i8, 2)(i8[:,::1], UniTuple(i8, 4))", inner=True)
def within(extent: I8, rows: tuple[int, int, int, int]) -> tuple[int, int]:
    """First sample at which one of four rows may not be zero, and the one behind the last."""
    a, b, c, d = rows
    low, high = extent[0], extent[1]
    return min(min(low[a], low[b]), min(low[c], low[d])), max(max(high[a], high[b]), max(high[c], high[d]))


@kernel("void(f8[:,::1], i8[:,::1], i8, f8[:,::1])", inner=True)
def gram_within(rows: F8, extent: I8, free: int, out: F8) -> None:
    """Inner products of all M rows with the first ``free`` rows, in tiles of 4 x 4; ``out`` is (M, free).

    Smaller tiles are bound by their loads: a 2 x 4 tile has six loads for eight products, this one eight for sixteen.
    BLAS is not used: its threads would compete with the daemon's for two cores and can take 50 times as long.

    Args:
        rows: (M, N).
        extent: (2, M) first sample of each row that may not be zero, and the one behind the last.
        free: number of rows to multiply with.
        out: (M, free).
    """
    last = rows.shape[0] - 1
    for i in range(0, last + 1, 4):
        i1, i2, i3 = min(i + 1, last), min(i + 2, last), min(i + 3, last)
        from_i, to_i = within(extent, (i, i1, i2, i3))
        for j in range(0, min(i3 + 1, free), 4):
            j1, j2, j3 = min(j + 1, last), min(j + 2, last), min(j + 3, last)
            from_j, to_j = within(extent, (j, j1, j2, j3))
            begin = max(from_i, from_j)
            end = max(begin, min(to_i, to_j))
            a0, a1, a2, a3 = rows[i, begin:end], rows[i1, begin:end], rows[i2, begin:end], rows[i3, begin:end]
            b0, b1, b2, b3 = rows[j, begin:end], rows[j1, begin:end], rows[j2, begin:end], rows[j3, begin:end]
            s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
            t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
            u0, u1, u2, u3 = 0.0, 0.0, 0.0, 0.0
            v0, v1, v2, v3 = 0.0, 0.0, 0.0, 0.0
            for n in range(a0.shape[0]):
                s0 += a0[n] * b0[n]
                s1 += a0[n] * b1[n]
                s2 += a0[n] * b2[n]
                s3 += a0[n] * b3[n]
                t0 += a1[n] * b0[n]
                t1 += a1[n] * b1[n]
                t2 += a1[n] * b2[n]
                t3 += a1[n] * b3[n]
                u0 += a2[n] * b0[n]
                u1 += a2[n] * b1[n]
                u2 += a2[n] * b2[n]
                u3 += a2[n] * b3[n]
                v0 += a3[n] * b0[n]
                v1 += a3[n] * b1[n]
                v2 += a3[n] * b2[n]
                v3 += a3[n] * b3[n]
            out[i, j], out[i1, j], out[i2, j], out[i3, j] = s0, t0, u0, v0
            if j1 < free:
                out[i, j1], out[i1, j1], out[i2, j1], out[i3, j1] = s1, t1, u1, v1
            if j2 < free:
                out[i, j2], out[i1, j2], out[i2, j2], out[i3, j2] = s2, t2, u2, v2
            if j3 < free:
                out[i, j3], out[i1, j3], out[i2, j3], out[i3, j3] = s3, t3, u3, v3
    for i in range(free):
        for j in range(i):
            out[j, i] = out[i, j]


@kernel("void(f8[:,::1], i8, f8[:,::1])")
def gram(rows: F8, free: int, out: F8) -> None:
    """Inner products of all M rows with the first ``free`` rows, over all samples."""
    extent = np.zeros((2, rows.shape[0]), np.int64)
    extent[1] = rows.shape[1]
    gram_within(rows, extent, free, out)


@kernel("f8[::1](f8[:,::1], f8[::1])")
def inner(rows: F8, row: F8) -> F8:
    """(M,) inner products of (M, N) rows with one row."""
    out = np.empty(rows.shape[0])
    for i in range(rows.shape[0]):
        a, total = rows[i], 0.0
        for n in range(a.shape[0]):
            total += a[n] * row[n]
        out[i] = total
    return out


@kernel("f8[::1](f8[::1], f8[:,::1])")
def mixed(weights: F8, rows: F8) -> F8:
    """(N,) weighted sum of (M, N) rows."""
    out = np.zeros(rows.shape[1])
    count = rows.shape[0]
    for i in range(0, count - 3, 4):
        a, b, c, d = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
        wa, wb, wc, wd = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
        for n in range(out.shape[0]):
            out[n] += (wa * a[n] + wb * b[n]) + (wc * c[n] + wd * d[n])
    for i in range(count - count % 4, count):
        a = rows[i]
        for n in range(out.shape[0]):
            out[n] += weights[i] * a[n]
    return out


@kernel("void(f8[:,::1], f8[:,::1], f8[:,::1])")
def combine(weights: F8, rows: F8, out: F8) -> None:
    """Weighted sums (K, N) of (M, N) rows, each with the weights (M,) of one row of ``weights``, in tiles of 4 x 4."""
    count, many = weights.shape
    tiled = many - many % 4
    out[:] = 0.0
    for i in range(0, count - 3, 4):
        a, b, c, d = out[i], out[i + 1], out[i + 2], out[i + 3]
        wa, wb, wc, wd = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
        for k in range(0, tiled, 4):
            p, q, r, s = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
            a0, a1, a2, a3 = wa[k], wa[k + 1], wa[k + 2], wa[k + 3]
            b0, b1, b2, b3 = wb[k], wb[k + 1], wb[k + 2], wb[k + 3]
            c0, c1, c2, c3 = wc[k], wc[k + 1], wc[k + 2], wc[k + 3]
            d0, d1, d2, d3 = wd[k], wd[k + 1], wd[k + 2], wd[k + 3]
            for n in range(p.shape[0]):
                x, y, z, t = p[n], q[n], r[n], s[n]
                a[n] += a0 * x + a1 * y + a2 * z + a3 * t
                b[n] += b0 * x + b1 * y + b2 * z + b3 * t
                c[n] += c0 * x + c1 * y + c2 * z + c3 * t
                d[n] += d0 * x + d1 * y + d2 * z + d3 * t
        for k in range(tiled, many):
            p = rows[k]
            for n in range(p.shape[0]):
                a[n] += wa[k] * p[n]
                b[n] += wb[k] * p[n]
                c[n] += wc[k] * p[n]
                d[n] += wd[k] * p[n]
    for i in range(count - count % 4, count):
        out[i] = mixed(weights[i], rows)


@kernel("void(f8[:,::1])")
def invert(a: F8) -> None:
    """Inverse of a symmetric positive definite matrix in place, by sweeping each pivot.

    A pivot that vanishes indicates an unknown that depends on others. Its row and column become zero, as if it were
    absent.
    """
    size = a.shape[0]
    for k in range(size):
        scale = a[k, k]
        a[k, k] = 1.0
        for j in range(size):
            a[k, j] = a[k, j] / scale if scale > 0.0 else 0.0
        for i in range(size):
            if i != k:
                factor = a[i, k]
                a[i, k] = 0.0
                for j in range(size):
                    a[i, j] -= factor * a[k, j]


@kernel("void(f4[:,::1], f8[:,::1], f8, i8, f8, f4[::1], f8[:,::1])")
def detect(correlation: F4, known: F8, guard: float, n_samples: int, period: float, sums: F4, out: F8) -> None:
    """Best code phase of each code for unknown data signs: the largest sum of |correlation| over the periods touched.

    Args:
        correlation: (K, F) correlation of the block with one period of each code that begins at sample ``lag``;
            negative lags are stored at ``lag + F``. Set to 0 around tracked lamps.
        known: (2, M) tracked lamps: row of the correlation of their code, -1 if absent; sample in [0, period) at which
            a period begins.
        guard: samples around that which are not searched.
        n_samples: of the block.
        period: samples per code period.
        sums: (int(period) + 3,) scratch.
        out: (K, 5) lag of the best phase in [0, period]; the sum there and at the lags before and behind it; sum of
            squares over the lags at which a whole period lies in the block.
    """
    size, lags = correlation.shape[1], sums.shape[0]
    for i in range(known.shape[1]):
        if known[0, i] >= 0.0:
            row = correlation[np.int64(known[0, i])]
            for p in range(-1, int(n_samples / period) + 1):
                middle = known[1, i] + p * period
                for at in range(math.floor(middle - guard + 0.5), math.floor(middle + guard + 0.5) + 1):
                    row[at % size] = np.float32(0.0)
    for c in range(correlation.shape[0]):
        row = correlation[c]
        sums[:] = np.float32(0.0)
        for p in range(-1, int(n_samples / period) + 2):
            offset = math.floor(p * period + 0.5) - 1
            low, high = max(0, -int(period) - offset), min(lags, n_samples - offset)
            wrapped = max(low, min(high, -offset))
            if wrapped > low:
                piece, target = row[offset + size + low : offset + size + wrapped], sums[low:wrapped]
                for k in range(target.shape[0]):
                    target[k] += abs(piece[k])
            if high > wrapped:
                piece, target = row[offset + wrapped : offset + high], sums[wrapped:high]
                for k in range(target.shape[0]):
                    target[k] += abs(piece[k])
        best = 1
        for k in range(2, lags - 1):
            if sums[k] > sums[best]:
                best = k
        out[c, 0], out[c, 1], out[c, 2], out[c, 3] = best - 1, sums[best], sums[best - 1], sums[best + 1]
        power, inside = np.float32(0.0), row[: max(n_samples - int(period), 1)]
        for k in range(inside.shape[0]):
            power += inside[k] * inside[k]
        out[c, 4] = power


@kernel("void(f4[:,::1], f4[::1], f8[:,::1], f8, f8[::1])")
def align(waves: F4, y: F4, lamps: F8, period: float, score: F8) -> None:
    """Joint fit of lamps at a common shift: sum of |correlation| for shifts in half samples, from ``-(S // 2)``.

    For so few lags an FFT would take longer.

    Args:
        waves: (L, W) one period of each lamp's code.
        y: (N,) the block.
        lamps: (2, L) sample at which a code period of each lamp should begin, within [0, period); weight.
        period: samples per code period.
        score: (S,) out, for each shift towards earlier samples.
    """
    n_samples, width, middle = y.shape[0], waves.shape[1], score.shape[0] // 2
    reach = middle // 2 + 1
    found = np.empty(2 * reach + 2, np.float32)
    score[:] = 0.0
    for i in range(waves.shape[0]):
        for p in range(-2, int(n_samples / period) + 2):
            begin = lamps[0, i] + p * period
            first = math.floor(begin) - reach
            if first + found.shape[0] <= -period or first >= n_samples:
                continue
            for k in range(found.shape[0]):
                low, high = max(0, -first - k), min(width, n_samples - first - k)
                total = np.float32(0.0)
                if high > low:
                    there, wave = y[first + k + low : first + k + high], waves[i, low:high]
                    for n in range(there.shape[0]):
                        total += there[n] * wave[n]
                found[k] = total
            for s in range(score.shape[0]):
                where = begin - 0.5 * (s - middle)
                if -period < where < n_samples:
                    low = math.floor(where)
                    share = where - low
                    value = (1.0 - share) * found[low - first] + share * found[low - first + 1]
                    score[s] += lamps[1, i] * abs(value)


@kernel("void(i8[::1], i8[::1], f8[:,::1], f8[:,::1], f8, f8[:,:,::1], i8[:,::1])")
def fold(slots: I8, period: I8, soft: F8, variance: F8, fade: float, rings: F8, last: I8) -> None:
    """Add soft bits to those of the same position in the data frame.

    Args:
        slots: (L,) rows of the rings.
        period: (L,) running number of the first code period touched.
        soft: (L, P) amplitude times sign of each period touched.
        variance: (L, P), inf where not touched.
        fade: weight of earlier repetitions of the frame.
        rings: (2, capacity, bits) sum of soft / variance, and of 1 / variance.
        last: (capacity, bits) running number of the period last added at each position.
    """
    bits = last.shape[1]
    for i in range(slots.shape[0]):
        row = slots[i]
        for p in range(soft.shape[1]):
            if variance[i, p] < np.inf:
                index = period[i] + p
                at = index % bits
                keep = 1.0 if last[row, at] == index else fade
                rings[0, row, at] = keep * rings[0, row, at] + soft[i, p] / variance[i, p]
                rings[1, row, at] = keep * rings[1, row, at] + 1.0 / variance[i, p]
                last[row, at] = index


@kernel("void(f8, f8[::1], f8[:,::1])")
def tones(frequency: float, times: F8, out: F8) -> None:
    """Cosines, then sines, of a frequency (cycles per sample) and its multiples; ``out``: (2 * count, N)."""
    count = out.shape[0] // 2
    for n in range(times.shape[0]):
        turn = 2.0 * math.pi * frequency * times[n]
        c, s, re, im = math.cos(turn), math.sin(turn), 1.0, 0.0
        for k in range(count):
            re, im = re * c - im * s, re * s + im * c
            out[k, n], out[count + k, n] = re, im

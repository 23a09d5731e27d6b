"""Kernels of the PWM lamps: trains of edges, amplitudes of harmonics, and the orthonormal rows of both."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from estimator.numerics.jit import kernel

F8 = npt.NDArray[np.float64]

TRAIN_ROWS = 8
RISE, RISE_SLOPE, RISE_BEND, FALL, FALL_SLOPE, FALL_BEND, RAMP, DRIFT = range(TRAIN_ROWS)
"""Rows of the trains: each with its first and second derivative; then the light of both times a ramp of -1 to 1, and
its derivative times that ramp.
"""
RANK = 1e-7
"""Relative energy below which a row adds nothing to the others."""


EVEN = 1e-9
"""Difference of the spacing of samples that is rounding."""


@kernel("UniTuple(f8, 2)(f8, f8, f8)", inner=True)
def decayed(rate: float, turn: float, age: float) -> tuple[float, float]:
    """Real and imaginary part of ``exp((rate + turn j) * age)``."""
    fade = math.exp(rate * age)
    if turn == 0.0:
        return fade, 0.0
    return fade * math.cos(turn * age), fade * math.sin(turn * age)


@kernel("void(f8[:,::1], f8[::1], f8[::1], f8[:,::1])")
def trains(modes: F8, pulses: F8, times: F8, out: F8) -> None:
    """Response of the receiver to endless trains of unit steps at phases 0.

    Args:
        modes: (4, K) real and imaginary part of each rate (per sample) and of each residue of the step response.
        pulses: frequency (cycles per sample), phases of rise and fall (cycles) at time 0.
        times: (N,) in samples, 0 in the middle.
        out: (8, N) out.
    """
    frequency, size, count = pulses[0], times.shape[0], modes.shape[1]
    share = np.empty((2, count))
    for m in range(count):  # residue / (1 - exp(rate / frequency))
        fade = math.exp(modes[0, m] / frequency)
        re, im = 1.0 - fade * math.cos(modes[1, m] / frequency), -fade * math.sin(modes[1, m] / frequency)
        power = re * re + im * im
        share[0, m] = (modes[2, m] * re + modes[3, m] * im) / power
        share[1, m] = (modes[3, m] * re - modes[2, m] * im) / power
    scale = 1.0 / max(abs(times[0]), abs(times[size - 1]))
    state, step, cycle = np.empty((2, 2, count)), np.empty((2, count)), np.empty(2)
    spacing = math.nan
    for n in range(size):
        if n > 0 and not abs(times[n] - times[n - 1] - spacing) < EVEN:
            spacing = times[n] - times[n - 1]
            for m in range(count):
                step[0, m], step[1, m] = decayed(modes[0, m], modes[1, m], spacing)
        for edge in range(2):
            phase = frequency * times[n] + pulses[1 + edge]
            begun = math.floor(phase)
            follows = n > 0 and begun == cycle[edge]  # the same cycle as the sample before: one step on
            cycle[edge] = begun
            value, slope, bend = 0.0, 0.0, 0.0
            for m in range(count):
                if follows:
                    before_re, before_im, c, s = state[edge, 0, m], state[edge, 1, m], step[0, m], step[1, m]
                else:
                    before_re, before_im = share[0, m], share[1, m]
                    c, s = decayed(modes[0, m], modes[1, m], (phase - begun) / frequency)
                re, im = before_re * c - before_im * s, before_re * s + before_im * c
                state[edge, 0, m], state[edge, 1, m] = re, im
                value += re
                first, other = re * modes[0, m] - im * modes[1, m], re * modes[1, m] + im * modes[0, m]
                slope += first
                bend += first * modes[0, m] - other * modes[1, m]
            out[3 * edge, n], out[3 * edge + 1, n], out[3 * edge + 2, n] = value, slope, bend
        ramp = times[n] * scale
        out[RAMP, n] = ramp * (out[RISE, n] - out[FALL, n])
        out[DRIFT, n] = ramp * (out[RISE_SLOPE, n] - out[FALL_SLOPE, n])


@kernel("void(f8, f8[::1], f8[::1], f8[:,::1])")
def harmonics(frequency: float, times: F8, row: F8, out: F8) -> None:
    """Real and imaginary part (2, count) of the amplitude of a frequency's multiples in a row."""
    out[:] = 0.0
    for n in range(times.shape[0]):
        turn = 2.0 * math.pi * frequency * times[n]
        c, s, re, im = math.cos(turn), math.sin(turn), 2.0 / times.shape[0] * row[n], 0.0
        for k in range(out.shape[1]):
            re, im = re * c + im * s, im * c - re * s
            out[0, k] += re
            out[1, k] += im


@kernel("i8(f8[:,::1], f8[:,::1])")
def triangular(gram: F8, out: F8) -> int:
    """Weights (count, M) that make rows of this Gram matrix (M, M) orthonormal: Cholesky with pivots.

    Rows whose part beyond the others has less than `RANK` of unit energy are left out; returns the count. The Gram
    matrix is overwritten.
    """
    size = gram.shape[0]
    count = 0
    out[:] = 0.0
    basis = np.zeros((size, size))  # what each step subtracts: rows expressed in the original ones
    for i in range(size):
        basis[i, i] = 1.0
    used = np.zeros(size, np.bool_)
    for _ in range(size):
        best = -1
        for i in range(size):
            if not used[i] and (best < 0 or gram[i, i] > gram[best, best]):
                best = i
        if gram[best, best] < RANK:
            break
        used[best] = True
        scale = 1.0 / math.sqrt(gram[best, best])
        for j in range(size):
            out[count, j] = basis[best, j] * scale
        for i in range(size):
            if not used[i]:
                overlap = gram[i, best] * scale * scale
                for j in range(size):
                    basis[i, j] -= overlap * basis[best, j]
                for j in range(size):
                    if not used[j]:
                        gram[i, j] -= overlap * gram[best, j]
        count += 1
    return count

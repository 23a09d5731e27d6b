"""Kernels of the waveform level: steps of coded light through lamp, low-pass and AC coupling, at exact instants.

The chain's step response is a sum of decaying exponentials, so that the past of all lamps together is one state per
exponential. That state goes on from block to block; nothing is computed twice.
"""

from __future__ import annotations

from math import cos, exp, fabs, floor, sin
from typing import Any, Final

import numpy as np

from estimator.numerics.jit import kernel

RATE, PHASE, CURRENT, SLOPE, DEPTH, LEVEL, SIGN, COLUMNS = range(8)
"""Columns of a lamp: half-chips per second, half-chips at time 0, mean current (A) at the reference time and its change
per second, modulation depth, level (A) it stands at, and whether that is bright (1), dark (-1) or not begun (0)."""

CODES: Final = "Tuple((u1[:,::1], u1[:,::1]))"
"""Chips and frame of each lamp, bits."""
FORGOTTEN: Final = -40.0
"""Exponent below which a step has left no trace."""


@kernel("f8(u1[::1], u1[::1], i8)")
def sign_of(chips: Any, frame: Any, half: Any) -> Any:
    """Bright or dark in one half-chip. Manchester: chip 0 is bright, then dark; data bit 1 exchanges them."""
    chip = half // 2
    odd = half + chips[chip % chips.shape[0]] + frame[chip // chips.shape[0] % frame.shape[0]]
    return 1.0 if odd % 2 == 0 else -1.0


@kernel("void(f8[:,::1], f8, f8, f8[:,::1])")
def kick(chain: Any, age: Any, jump: Any, drive: Any) -> None:
    """Add a step of ``jump``, ``age`` old, to what drives each exponential; ``drive`` is (modes, 2)."""
    for k in range(chain.shape[1]):
        fade = chain[0, k] * age
        if fade > FORGOTTEN:
            size = jump * exp(fade)
            turn = chain[1, k] * age
            if turn == 0.0:
                drive[k, 0] += size
            else:
                drive[k, 0] += size * cos(turn)
                drive[k, 1] += size * sin(turn)


@kernel(f"void(f8[::1], f8[::1], f8[:,::1], {CODES}, f8[:,::1], f8[:,:,::1])")
def steps(t: Any, since: Any, lamps: Any, codes: Any, chain: Any, drive: Any) -> None:
    """Collect the steps of all lamps before each sample.

    Args:
        t: (n,) sampling instants, ascending.
        since: instant up to which steps are in the state already, and the reference time of the currents.
        lamps: (L, 7), see :data:`RATE`; level and sign are brought up to date.
        codes: see :data:`CODES`.
        chain: (4, modes) real and imaginary parts of poles and residues.
        drive: (n, modes, 2) zeros, filled.
    """
    chips, frames = codes
    last = t.shape[0] - 1
    for n in range(lamps.shape[0]):
        lamp = lamps[n]
        if lamp[CURRENT] == 0.0 and lamp[SLOPE] == 0.0 and lamp[LEVEL] == 0.0:
            continue
        end = int(floor(t[last] * lamp[RATE] + lamp[PHASE]))  # noqa: RUF046 - compiled, floor gives a float
        at = 0
        first = int(floor(since[0] * lamp[RATE] + lamp[PHASE])) + 1  # noqa: RUF046 - as above
        for half in range(first, end + 1):
            sign = sign_of(chips[n], frames[n], half)
            if sign == lamp[SIGN]:
                continue  # as bright as before; what it has drifted comes with the next step
            when = (half - lamp[PHASE]) / lamp[RATE]
            level = (lamp[CURRENT] + lamp[SLOPE] * (when - since[1])) * (1.0 + sign * lamp[DEPTH])
            while at < last and t[at] < when:
                at += 1
            kick(chain, max(t[at] - when, 0.0), level - lamp[LEVEL], drive[at])
            lamp[LEVEL], lamp[SIGN] = level, sign


@kernel("void(f8[::1], f8, f8[:,::1], f8[:,::1], f8[:,:,::1], f8[::1])")
def ring(t: Any, since: Any, chain: Any, state: Any, drive: Any, out: Any) -> None:
    """Let the exponentials decay from sample to sample; ``state`` (modes, 2) goes from ``since`` to the last sample."""
    modes = chain.shape[1]
    before, gap = since, -1.0
    turn = np.zeros((modes, 2))
    for i in range(t.shape[0]):
        if fabs(t[i] - before - gap) > 1e-11:
            gap = t[i] - before
            for k in range(modes):
                size = exp(chain[0, k] * gap)
                turn[k, 0], turn[k, 1] = size * cos(chain[1, k] * gap), size * sin(chain[1, k] * gap)
        before = t[i]
        total = 0.0
        for k in range(modes):
            re = turn[k, 0] * state[k, 0] - turn[k, 1] * state[k, 1] + drive[i, k, 0]
            im = turn[k, 0] * state[k, 1] + turn[k, 1] * state[k, 0] + drive[i, k, 1]
            state[k, 0], state[k, 1] = re, im
            total += chain[2, k] * re - chain[3, k] * im
        out[i] = total


@kernel("void(f8[::1], f8[:,::1], f8[::1])")
def hum(t: Any, tones: Any, out: Any) -> None:
    """Add sinusoids: rows of angular frequency, amplitude of the cosine and of the sine."""
    for i in range(t.shape[0]):
        for k in range(tones.shape[0]):
            turn = tones[k, 0] * t[i]
            out[i] += tones[k, 1] * cos(turn) + tones[k, 2] * sin(turn)

"""Saturation of the receiver's first stage for part of a block: stretches in which the light does not change.

The stage saturates before the AC coupling. So its samples lie far from the rails: they decay smoothly, and only the
noise of the converter is in them. After each such stretch the coupling recovers exponentially.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import Profile
from estimator.cdma.anomalies.activity_kernel import activity
from estimator.cdma.sample_block import Fit
from estimator.numerics.arrays import Array

WINDOW: Final = 8
"""Samples whose activity is judged together: some two chips."""

STILL: Final = 1.5
"""Noise (ADC steps) of a still stretch at most: that of a converter."""

ACTIVITY: Final = 0.01
"""Share of the usual activity (upper quartile) below which a window is still."""

LIVELY: Final = 20.0
"""Activity of the usual window over that of a still one: chance makes single windows of weak light still."""

MARGIN: Final = 6
"""Samples beside a still window that may be partly saturated."""

MOST: Final = 0.6
"""Share of a block in still windows above which it is no block with signal."""

PARTS: Final = 40
"""Parts of a block whose amplitudes are compared: fractions of a cycle of the flicker."""

STEADY: Final = 0.02
"""Relative change of amplitudes, rms, that a drive or errors of the pulse shape may cause."""

EVIDENT: Final = 4.0
"""Energy explained by changing amplitudes, per part and over the noise, from which they change."""


def saturated(words: Array, mask: Array) -> npt.NDArray[np.bool_] | None:
    """(N,) which samples were taken while the first stage was saturated; None if there are none.

    ``mask``: 0 for samples at the rails of the converter, which are still as well.
    """
    windows = (len(words) - 2) // WINDOW
    seen = np.empty(windows)
    if activity(words, WINDOW, seen) >= STILL**2:
        return None
    usual = float(np.partition(seen, (3 * windows) // 4)[(3 * windows) // 4])
    still = seen < min(STILL**2, ACTIVITY * usual)
    if usual < LIVELY * STILL**2 or not still.any():
        return None
    railed = (mask[: windows * WINDOW].reshape(windows, WINDOW) == 0.0).any(axis=1)
    still = still & ~railed
    if not still.any() or still.mean() > MOST:
        return None
    out = np.zeros(len(words), np.bool_)
    for k in np.flatnonzero(still).tolist():
        out[max(k * WINDOW - MARGIN, 0) : (k + 1) * WINDOW + 2 + MARGIN] = True
    return out


def unsteadiness(y: Array, fit: Fit) -> float:
    """Relative change of all amplitudes over the parts of a block, rms, beyond a steady trend; 0 if insignificant.

    A stage that saturates at the peaks of the flicker passes less of all lamps there. ``y``: (N,) the block.
    """
    if fit.noise_var < 0.5 * STEADY**2 * float(np.vdot(fit.amplitude, fit.amplitude)):
        return 0.0  # a cheap estimate of the same
    signal = y - fit.residual - fit.nuisance
    if float(np.vdot(fit.residual, fit.residual)) < STEADY**2 * float(np.vdot(signal, signal)):
        return 0.0
    edges = np.linspace(0, len(y), PARTS + 1).astype(np.int64)[:-1]
    energy = np.maximum(np.add.reduceat(signal * signal, edges), 1e-12)
    overlap = np.add.reduceat(signal * fit.residual, edges)
    change, ramp = overlap / energy, np.linspace(-1.0, 1.0, PARTS)
    trend = float((energy * ramp * change).sum() / (energy * ramp * ramp).sum())
    change = change - trend * ramp
    explained = float((energy * change**2).sum())
    rest = max(float(np.vdot(fit.residual, fit.residual)) - explained, 1e-12) / len(y)
    relative = float(np.sqrt(explained / energy.sum()))
    return relative if relative > STEADY and explained > EVIDENT * PARTS * rest else 0.0


def recoveries(mask: Array, profile: Profile) -> Array:
    """(M, N) exponential recovery of the AC coupling after each masked stretch and at the begin of the block."""
    n, decay = len(mask), 2.0 * np.pi * profile.front_end.hpf_hz / profile.sample_rate
    begins = np.flatnonzero(np.diff(mask, prepend=0.0) > 0.0)
    ends = np.append(np.flatnonzero(np.diff(mask) < 0.0) + 1, n)
    times = np.arange(n, dtype=np.float64)
    rows = np.zeros((len(begins), n))
    for row, begin in zip(rows, begins.tolist(), strict=True):
        end = int(ends[np.searchsorted(ends, begin, side="right")])
        row[begin:end] = np.exp(-decay * (times[begin:end] - begin))
    return rows

"""Maximum-likelihood grid search for the position from a single light epoch, compiled."""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.light_filter.lambertian import COLUMNS, expect
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

COMMON_VARIANCE: Final = 0.25**2
"""Variance of the common ln gain: dirt on the receiver, another resistor, another supply."""

CAP: Final = 9.0
"""Limit of a link's squared deviation (three sigma): it may be covered, moved, or somewhere else."""


@kernel("f8(f8[::1], f8[::1], i8, f8, f8[::1])", inner=True)
def common_gain(r: Array, s2: Array, n: int, prior2: float, best: Array) -> float:
    """Common gain that best explains the residuals of all links, robustly.

    Args:
        r: (n,) ln(received / expected).
        s2: (n,) variances of those.
        n: number of links.
        prior2: variance of the common gain.
        best: (1,) out: the gain.

    Returns:
        Sum of squared deviations, each capped, and of the gain's own.
    """
    least = np.inf
    for c in range(n + 1):
        g = 0.0 if c == n else r[c]
        up, down = 0.0, 1.0 / prior2
        for i in range(n):  # weighted mean of the links that agree with this start value
            if (r[i] - g) ** 2 < CAP * s2[i]:
                up += r[i] / s2[i]
                down += 1.0 / s2[i]
        g = up / down
        cost = g * g / prior2
        for i in range(n):
            cost += min((r[i] - g) ** 2 / s2[i], CAP)
        if cost < least:
            least = cost
            best[0] = g
    return least


@kernel("void(f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8, f8[:, ::1])")
def search(lamps: Array, rx: Array, links: Array, poses: Array, floor: float, out: Array) -> None:
    """Cost of every pose.

    Args:
        lamps: (n, 7) of the links, rows of `lambertian.pack_lamps`.
        rx: (9,) receiver.
        links: (n, 2) ln RSS, and its variance including the errors of gain and model.
        poses: (G, 3).
        floor: diffuse floor.
        out: (G, 3) out: cost, common gain, number of links that fit.
    """
    n = lamps.shape[0]
    r, s2, J, said, best = np.empty(n), np.empty(n), np.empty(COLUMNS), np.empty(3), np.empty(1)
    for i in range(n):
        s2[i] = links[i, 1]
    for g in range(poses.shape[0]):
        for i in range(n):
            expect(lamps[i], rx, poses[g], floor, said, J)
            r[i] = links[i, 0] - np.log(max(said[0], 1e-30))
        out[g, 0] = common_gain(r, s2, n, COMMON_VARIANCE, best)
        out[g, 1] = best[0]
        fits = 0.0
        for i in range(n):
            fits += 1.0 if (r[i] - best[0]) ** 2 < CAP * s2[i] else 0.0
        out[g, 2] = fits

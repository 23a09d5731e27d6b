"""EKF measurement update for links (Eq. 5-7), compiled: linearisation, gain, covariance.

A link is compared as ln RSS: gains are then additive, and its error is a share of it whatever its strength.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.light_filter.lambertian import COLUMNS, LAMP_COLUMNS, RECEIVER_COLUMNS, expect
from estimator.light_filter.state_vector import (
    COMMON,
    ERROR,
    FIRST,
    FLOOR,
    LEAN_X,
    LEAN_Y,
    ORDER,
    OWN,
    TILT_X,
    TILT_Y,
    YAW,
    X,
    Y,
)
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

WIDTH: Final = 12
"""State elements that one link depends on: pose; common gain, diffuse floor, tilt, order; the four of its lamp."""

SLOT, LN, NOISE, SHIFT, SIGMA, SHIFT_X, SHIFT_Y, LINK_COLUMNS = range(8)
"""Columns of a link: slot, ln RSS, its variance, ln correction of the residual map, sigma of the model there (negative:
the general one), gradient of the correction (1/m).
"""

RESIDUAL, SPREAD, WHITE, DIRECT, COS_BETA, TOTAL, SLOPES = range(7)
"""Columns of the result of :func:`linearise`: ln(received / expected); its variance by the state alone; variance of the
noise; direct part over the total; cosine of the angle to the axis; expected RSS, A; then the WIDTH derivatives.
"""
OUT_COLUMNS: Final = SLOPES + WIDTH

BACK: Final = RECEIVER_COLUMNS
"""Index in a view: (x, y, yaw) of the pose at the epoch, relative to the state's pose."""
MODEL: Final = RECEIVER_COLUMNS + 3
"""Index in a view: sigmas of the model. In order: ln of any link, share of the diffuse part, ln per epoch, ln at the
edge of view.
"""
VIEW_COLUMNS: Final = MODEL + 4

LOG_2PI: Final = 1.8378770664093453
SURPRISE_CAP: Final = 16.0
"""Limit of a link's squared deviation in the likelihood of a hypothesis: one lamp covered by a shelf must not decide
the heading.
"""


@kernel("i8(f8, i8)", inner=True)
def element(slot: float, w: int) -> int:
    """State index of the ``w``-th of the WIDTH elements of a link in a slot."""
    if w < 3:
        return w
    if w < 8:
        return COMMON + w - 3
    return FIRST + OWN * int(slot) + w - 8


@kernel("void(f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def linearise(x: Array, P: Array, links: Array, lamps: Array, view: Array, out: Array) -> None:
    """Residual, variances and derivatives of links at a state; changes nothing else.

    Args:
        x: state.
        P: its covariance.
        links: (L, LINK_COLUMNS).
        lamps: (slots, 7), rows of `lambertian.pack_lamps`.
        view: (VIEW_COLUMNS,) receiver, pose at the epoch relative to the state's, sigmas of the model.
        out: (L, OUT_COLUMNS) out.
    """
    rx, pose, J, said = view[:RECEIVER_COLUMNS].copy(), np.empty(3), np.empty(COLUMNS), np.empty(3)
    lamp = np.empty(LAMP_COLUMNS)
    rx[7] += x[LEAN_X]
    rx[8] += x[LEAN_Y]
    rx[5] = max(rx[5] + x[ORDER], 0.0)
    c, s = np.cos(x[YAW]), np.sin(x[YAW])
    bx, by = c * view[BACK] - s * view[BACK + 1], s * view[BACK] + c * view[BACK + 1]
    pose[0], pose[1], pose[2] = x[X] + bx, x[Y] + by, x[YAW] + view[BACK + 2]
    floor = np.exp(x[FLOOR])
    fov2 = max(1.0 / max(rx[6] * rx[6], 1e-2) - 1.0, 1e-2)
    for i in range(links.shape[0]):
        slot = int(links[i, SLOT])
        own = FIRST + OWN * slot
        lamp[:] = lamps[slot]
        lamp[5] += x[own + TILT_X]
        lamp[6] += x[own + TILT_Y]
        expect(lamp, rx, pose, floor, said, J)
        total = max(said[0], 1e-30)
        direct = said[1] / total
        model = view[MODEL] if links[i, SIGMA] < 0.0 else links[i, SIGMA]
        tan2 = max(1.0 / max(said[2] * said[2], 1e-2) - 1.0, 0.0)
        edge = view[MODEL + 3] * (tan2 / fov2) ** 2
        scale = np.sqrt(model * model + ((1.0 - direct) * view[MODEL + 1]) ** 2 + edge * edge)
        gain = links[i, SHIFT] + x[COMMON] + x[own]
        out[i, RESIDUAL] = links[i, LN] - np.log(total) - gain - scale * x[own + ERROR]
        out[i, WHITE] = links[i, NOISE] + view[MODEL + 2] ** 2
        out[i, DIRECT], out[i, COS_BETA] = direct, said[2]
        out[i, TOTAL] = total * np.exp(gain)
        h = out[i, SLOPES:]
        h[0], h[1] = J[0] / total + links[i, SHIFT_X], J[1] / total + links[i, SHIFT_Y]
        h[2] = (J[2] - by * J[0] + bx * J[1]) / total
        h[3], h[4] = 1.0, J[4] * floor / total
        h[5], h[6] = J[10] / total, J[11] / total
        h[7], h[8], h[11] = J[9] / total, 1.0, scale
        h[9], h[10] = J[6] / total, J[7] / total
        spread = 0.0
        for v in range(WIDTH):
            for w in range(WIDTH):
                spread += h[v] * h[w] * P[element(slot, v), element(slot, w)]
        out[i, SPREAD] = spread


@kernel("void(f8[:, ::1], i8, f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])", inner=True)
def spread_out(P: Array, n: int, K: Array, b: Array, c: Array, out: Array) -> None:
    """``P <- P + sum of K c' - b K'`` over the links in use, row by row to stay in the cache."""
    for j in range(n):
        for i in range(out.shape[0]):
            if out[i, WHITE] < np.inf:
                u, v = K[i, j], b[i, j]
                for k in range(j, n):
                    P[j, k] += u * c[i, k] - v * K[i, k]
    for j in range(n):
        for k in range(j):
            P[j, k] = P[k, j]


@kernel("UniTuple(f8, 2)(f8[::1], f8[:, ::1], i8, f8[::1], f8[:, ::1], f8[:, ::1])")
def absorb(x: Array, P: Array, n: int, around: Array, links: Array, out: Array) -> tuple[float, float]:
    """Sequential Kalman update with links, covariance in Joseph's form.

    Args:
        x: state, changed in place.
        P: its covariance, changed in place; stays symmetric and positive.
        n: elements in use.
        around: linearisation point of the links; ``x`` itself at first, an earlier result when iterated.
        links: (L, LINK_COLUMNS).
        out: (L, OUT_COLUMNS) of :func:`linearise`; a link with infinite WHITE is not used.

    Returns:
        ln of the likelihood of these links together, each squared deviation capped; their joint NIS, uncapped.
    """
    likelihood, nis, count = 0.0, 0.0, links.shape[0]
    at, A = np.empty((count, WIDTH), np.int64), np.zeros((count, n))
    K, b, c = np.zeros((count, n)), np.zeros((count, n)), np.zeros((count, n))
    lin = around.copy()
    for i in range(count):
        for w in range(WIDTH):
            at[i, w] = element(links[i, SLOT], w)
            if out[i, WHITE] < np.inf:
                h, k = out[i, SLOPES + w], at[i, w]
                for j in range(n):
                    A[i, j] += h * P[k, j]
    for i in range(count):
        noise = out[i, WHITE]
        if not noise < np.inf:
            continue
        nu, spread = out[i, RESIDUAL], 0.0
        for w in range(WIDTH):
            k = at[i, w]
            step = x[k] - lin[k]
            if w == YAW:
                step = (step + np.pi) % (2.0 * np.pi) - np.pi
            nu -= out[i, SLOPES + w] * step
            spread += out[i, SLOPES + w] * A[i, k]
        S = max(spread, 0.0) + noise
        nis += nu * nu / S
        likelihood -= 0.5 * (min(nu * nu / S, SURPRISE_CAP) + np.log(S) + LOG_2PI)
        for j in range(n):
            K[i, j] = A[i, j] / S
            b[i, j] = A[i, j] - K[i, j] * spread
            c[i, j] = noise * K[i, j] - A[i, j]
            x[j] += K[i, j] * nu
        for m in range(i + 1, count):  # apply this update to the links still to come
            if out[m, WHITE] < np.inf:
                up = down = 0.0
                for w in range(WIDTH):
                    up += c[i, at[m, w]] * out[m, SLOPES + w]
                    down += K[i, at[m, w]] * out[m, SLOPES + w]
                for j in range(n):
                    A[m, j] += K[i, j] * up - b[i, j] * down
    spread_out(P, n, K, b, c, out)
    x[YAW] = (x[YAW] + np.pi) % (2.0 * np.pi) - np.pi
    return likelihood, nis

"""Eq. 5-7: links against the state of the `lights` filter, compiled: what they differ by, and taking them in.

A link is compared as ln amplitude: gains are then additive, and its error is a share of it whatever its strength.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.ekf import COMMON, FIRST, FLOOR, LEAN_X, LEAN_Y, YAW, X, Y
from estimator.kernel import kernel
from estimator.optics import COLUMNS, RECEIVER_COLUMNS, expect
from estimator.records import Array

WIDTH: Final = 9
"""Elements of the state that one link depends on: pose, common gain, floor, lean, own gain, own model error."""

SLOT, LN, NOISE, SHIFT, SIGMA, LINK_COLUMNS = range(6)
"""Columns of a link: slot, ln of the amplitude, variance of that, ln correction by a residual map, sigma of the model
there (negative: the general one)."""

RESIDUAL, SPREAD, WHITE, DIRECT, COS_BETA, TOTAL, SLOPES = range(7)
"""Columns of what :func:`linearise` says of a link: ln(received / expected); its variance by the state alone; variance
of the noise; direct part over the total; cosine of the angle to the axis; expected amplitude, A; then the WIDTH
derivatives."""
OUT_COLUMNS: Final = SLOPES + WIDTH

BACK: Final = RECEIVER_COLUMNS
"""In a view: from here (x, y, yaw) of the pose at the epoch, seen from the state's pose."""
MODEL: Final = RECEIVER_COLUMNS + 3
"""In a view: from here the sigmas of the model: ln, anywhere; share of the diffuse part; lean of a lamp, rad; ln, anew
at every epoch."""
VIEW_COLUMNS: Final = MODEL + 4

LOG_2PI: Final = 1.8378770664093453
SURPRISE_CAP: Final = 16.0
"""A link's squared deviation counts no more than that in the likelihood of a hypothesis: one lamp covered by a shelf
must not decide which way the robot looks."""


@kernel("i8(f8, i8)")
def element(slot: float, w: int) -> int:
    """Where in the state the ``w``-th of the WIDTH elements of a link in a slot stands."""
    if w < 3:
        return w
    if w < 7:
        return COMMON + w - 3
    return FIRST + 2 * int(slot) + w - 7


@kernel("void(f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def linearise(x: Array, P: Array, links: Array, lamps: Array, view: Array, out: Array) -> None:
    """Compare links with what the state expects of them, without changing anything.

    Args:
        x: state.
        P: its covariance.
        links: (L, LINK_COLUMNS).
        lamps: (slots, 7), rows of `optics.pack_lamps`.
        view: (VIEW_COLUMNS,) receiver, pose at the epoch seen from the state's, sigmas of the model.
        out: (L, OUT_COLUMNS), filled.
    """
    rx, pose, J, said = view[:RECEIVER_COLUMNS].copy(), np.empty(3), np.empty(COLUMNS), np.empty(3)
    rx[7] += x[LEAN_X]
    rx[8] += x[LEAN_Y]
    c, s = np.cos(x[YAW]), np.sin(x[YAW])
    bx, by = c * view[BACK] - s * view[BACK + 1], s * view[BACK] + c * view[BACK + 1]
    pose[0], pose[1], pose[2] = x[X] + bx, x[Y] + by, x[YAW] + view[BACK + 2]
    floor = np.exp(x[FLOOR])
    for i in range(links.shape[0]):
        slot = int(links[i, SLOT])
        expect(lamps[slot], rx, pose, floor, said, J)
        total = max(said[0], 1e-30)
        direct = said[1] / total
        own = FIRST + 2 * slot
        model = view[MODEL] if links[i, SIGMA] < 0.0 else links[i, SIGMA]
        tan2 = max(1.0 / max(said[2] * said[2], 1e-2) - 1.0, 0.0)
        scale = np.sqrt(
            model * model + ((1.0 - direct) * view[MODEL + 1]) ** 2 + (view[MODEL + 2] * lamps[slot, 4]) ** 2 * tan2
        )
        out[i, RESIDUAL] = links[i, LN] - np.log(total) - links[i, SHIFT] - x[COMMON] - x[own] - scale * x[own + 1]
        out[i, WHITE] = links[i, NOISE] + view[MODEL + 3] ** 2
        out[i, DIRECT], out[i, COS_BETA] = direct, said[2]
        out[i, TOTAL] = total * np.exp(x[COMMON] + x[own] + links[i, SHIFT])
        h = out[i, SLOPES:]
        h[0], h[1] = J[0] / total, J[1] / total
        h[2] = (J[2] - by * J[0] + bx * J[1]) / total
        h[3], h[4] = 1.0, J[4] * floor / total
        h[5], h[6] = J[10] / total, J[11] / total
        h[7], h[8] = 1.0, scale
        spread = 0.0
        for v in range(WIDTH):
            for w in range(WIDTH):
                spread += h[v] * h[w] * P[element(slot, v), element(slot, w)]
        out[i, SPREAD] = spread


@kernel("f8(f8[::1], f8[:, ::1], i8, f8[::1], f8[:, ::1], f8[:, ::1])")
def absorb(x: Array, P: Array, n: int, around: Array, links: Array, out: Array) -> float:
    """Take links in one after another: Kalman's gain, the covariance in Joseph's form.

    Args:
        x: state, changed in place.
        P: its covariance, changed in place; stays symmetric and positive.
        n: elements in use.
        around: the state at which the links were linearised; ``x`` itself at first, an earlier outcome when iterated.
        links: (L, LINK_COLUMNS).
        out: (L, OUT_COLUMNS) of :func:`linearise`; a link whose WHITE is infinite is left out.

    Returns:
        ln of the likelihood of these links together, each one's surprise capped.
    """
    likelihood = 0.0
    h, a, b, K = np.empty(WIDTH), np.empty(n), np.empty(n), np.empty(n)
    at = np.empty(WIDTH, np.int64)
    lin = around.copy()
    for i in range(links.shape[0]):
        noise = out[i, WHITE]
        if not noise < np.inf:
            continue
        nu = out[i, RESIDUAL]
        for w in range(WIDTH):
            at[w], h[w] = element(links[i, SLOT], w), out[i, SLOPES + w]
            step = x[at[w]] - lin[at[w]]
            if w == YAW:
                step = (step + np.pi) % (2.0 * np.pi) - np.pi
            nu -= h[w] * step
        spread = 0.0
        for j in range(n):
            a[j] = 0.0
            for w in range(WIDTH):
                a[j] += P[at[w], j] * h[w]
        for w in range(WIDTH):
            spread += h[w] * a[at[w]]
        S = max(spread, 0.0) + noise
        likelihood -= 0.5 * (min(nu * nu / S, SURPRISE_CAP) + np.log(S) + LOG_2PI)
        for j in range(n):
            K[j] = a[j] / S
            b[j] = a[j] - K[j] * spread
            x[j] += K[j] * nu
        for j in range(n):
            for k in range(j, n):
                P[j, k] += noise * K[j] * K[k] - K[j] * a[k] - b[j] * K[k]
                P[k, j] = P[j, k]
    x[YAW] = (x[YAW] + np.pi) % (2.0 * np.pi) - np.pi
    return likelihood

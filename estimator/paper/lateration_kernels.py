"""Compiled kernels of `lateration`: descent to a position, from RSS or from ranges."""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.cdma.correlation_kernels import invert
from estimator.light_filter.lambertian import COLUMNS, expect
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

STEPS: Final = 80
"""Most steps; a descent from a metre away needs 5 to 12, more only to the line of collinear lamps (quartic)."""
LONGEST_M: Final = 1.5
"""Longest step, m: the model is far from linear over more than that."""
SETTLED_M: Final = 1e-7
LATE: Final = 10
GAINED: Final = 1e-2
"""Share of the cost; a larger decrease in the last ``LATE`` steps means that there is no minimum yet."""
FAINTEST: Final = 1e-5
"""Smallest expected RSS relative to that directly below the lamp, so that logarithms stay finite."""


@kernel("f8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])")
def strength_step(lamps: Array, rx: Array, data: Array, prior: Array, theta: Array, normal: Array) -> float:
    """Cost at ``theta`` and the Gauss-Newton system there.

    Args:
        lamps: (n, 7) as of `estimator.light_filter.lambertian`.
        rx: (9,) as of `estimator.light_filter.lambertian`.
        data: (2, n) ln RSS and its weight, 1 / variance.
        prior: yaw, and for common gain and floor: mean gain, its weight, mean floor, its weight.
        theta: x, y of the receiver, common ln gain, floor.
        normal: (4, 5) is filled with the information matrix and, in the last column, minus the gradient.

    Returns:
        Sum of squared residuals over their variances.
    """
    pose = np.array((theta[0], theta[1], prior[0]))
    c, s = np.cos(prior[0]), np.sin(prior[0])
    pose[0] -= c * rx[0] - s * rx[1]
    pose[1] -= s * rx[0] + c * rx[1]
    out, jacobian, row = np.zeros(3), np.zeros(COLUMNS), np.zeros(4)
    normal[:] = 0.0
    gain, floor = theta[2] - prior[1], theta[3] - prior[3]
    cost = gain * gain * prior[2] + floor * floor * prior[4]
    normal[2, 2], normal[2, 4] = prior[2], -gain * prior[2]
    normal[3, 3], normal[3, 4] = prior[4], -floor * prior[4]
    for i in range(lamps.shape[0]):
        amplitude = expect(lamps[i], rx, pose, theta[3], out, jacobian)
        least = FAINTEST * jacobian[4]
        row[2] = 1.0
        if amplitude > least:
            row[0], row[1], row[3] = jacobian[0] / amplitude, jacobian[1] / amplitude, jacobian[4] / amplitude
        else:
            amplitude = least
            row[0], row[1], row[3] = 0.0, 0.0, 0.0
        left = data[0, i] - np.log(amplitude) - theta[2]
        cost += left * left * data[1, i]
        for j in range(4):
            for k in range(4):
                normal[j, k] += row[j] * row[k] * data[1, i]
            normal[j, 4] += row[j] * left * data[1, i]
    return float(cost)


@kernel("f8(f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1])", inner=True)
def range_step(lamps: Array, data: Array, theta: Array, normal: Array) -> float:
    """Cost of Eq. 4 at ``theta`` (x, y), and the Gauss-Newton system there.

    ``lamps`` (n, 7); ``data`` (2, n) squared horizontal ranges of Eq. 3 and weights; ``normal`` (2, 3) is filled.
    """
    normal[:] = 0.0
    cost = 0.0
    for i in range(lamps.shape[0]):
        x, y = theta[0] - lamps[i, 0], theta[1] - lamps[i, 1]
        left = data[0, i] - x * x - y * y
        w = data[1, i]
        cost += left * left * w
        normal[0, 0] += 4.0 * x * x * w
        normal[0, 1] += 4.0 * x * y * w
        normal[1, 1] += 4.0 * y * y * w
        normal[0, 2] += 2.0 * x * left * w
        normal[1, 2] += 2.0 * y * left * w
    normal[1, 0] = normal[0, 1]
    return cost


@kernel("b1(f8[:, ::1], f8, f8[::1])", inner=True)
def damped(normal: Array, damping: float, step: Array) -> bool:
    """Write Levenberg's step, limited to `LONGEST_M` in the plane; returns whether it is finite."""
    n = normal.shape[0]
    a = np.empty((n, n))
    for j in range(n):
        for k in range(n):
            a[j, k] = normal[j, k]
        scale = max(normal[0, 0], normal[1, 1]) if j < 2 else normal[j, j]  # x and y have arbitrary directions
        a[j, j] += damping * scale + 1e-12
    invert(a)
    for j in range(n):
        step[j] = 0.0
        for k in range(n):
            step[j] += a[j, k] * normal[k, n]
    length = np.sqrt(step[0] * step[0] + step[1] * step[1])
    if length > LONGEST_M:
        step *= LONGEST_M / length
    return bool(np.isfinite(length))


@kernel("f8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])")
def by_strength(lamps: Array, rx: Array, data: Array, prior: Array, theta: Array, normal: Array) -> float:
    """Descend from ``theta`` (changed in place) by `strength_step`; returns the cost, inf if it did not converge."""
    cost = strength_step(lamps, rx, data, prior, theta, normal)
    damping, step, trial, system, late = 1e-3, np.zeros(4), np.zeros(4), np.zeros((4, 5)), cost
    for k in range(STEPS):
        if k == STEPS - LATE:
            late = cost
        if not damped(normal, damping, step):
            return np.inf
        trial[:] = theta + step
        trial[3] = max(trial[3], 0.0)  # RSS is not negative
        moved = np.hypot(step[0], step[1]) + abs(step[2])
        new = strength_step(lamps, rx, data, prior, trial, system)
        if new <= cost:
            theta[:], normal[:], cost, damping = trial, system, new, max(0.2 * damping, 1e-9)
        else:
            damping = 10.0 * max(damping, 1e-4)
        if moved < SETTLED_M:
            return float(cost)
    return float(cost) if late - cost < GAINED * cost else np.inf


@kernel("f8(f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def by_range(lamps: Array, data: Array, theta: Array, normal: Array) -> float:
    """Descend from ``theta`` (changed in place) by `range_step`; returns the cost, inf if it did not converge."""
    cost = range_step(lamps, data, theta, normal)
    damping, step, trial, system, late = 1e-3, np.zeros(2), np.zeros(2), np.zeros((2, 3)), cost
    for k in range(STEPS):
        if k == STEPS - LATE:
            late = cost
        if not damped(normal, damping, step):
            return np.inf
        trial[:] = theta + step
        moved = np.hypot(step[0], step[1])
        new = range_step(lamps, data, trial, system)
        if new <= cost:
            theta[:], normal[:], cost, damping = trial, system, new, max(0.2 * damping, 1e-9)
        else:
            damping = 10.0 * max(damping, 1e-4)
        if moved < SETTLED_M:
            return float(cost)
    return float(cost) if late - cost < GAINED * cost else np.inf

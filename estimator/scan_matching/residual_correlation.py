"""Effective sample size of a scan: beams per independent measurement, from the AR(1) correlation of residuals.

The statistics of a match count every beam as independent. Real ranges are not: colour, incidence and unevenness of a
surface shift neighbouring beams together. The residuals of a scan, in beam order, are to good approximation a
first-order autoregression with coefficient ``rho``. Their mean carries ``(1 - rho) / (1 + rho)`` of the information of
independent beams (URG-04LX a fifth, UTM-30LX an eighth, SICK LMS a third). Simulated noise is independent and loses
nothing.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.scan_matching.distance_axis import Axis
from estimator.scan_matching.nearest_neighbour import nearest

BESIDE_M = 0.2
"""Largest distance (m) of two consecutive points on one surface."""

MOST = 0.9
"""Largest correlation in use, 19 beams per measurement; a larger one means that the map does not fit."""


@kernel("void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8, f8[::1])")
def neighbours_agree(
    points: Array, reference: tuple[Array, Ints, Array, Array], T: Array, gate: float, sums: Array
) -> None:
    """Write sums over neighbouring points: product of the two residuals, mean of their squares, number of pairs.

    ``points``: (n, 4) in the base frame. ``reference``: rows, start, rays of the axis, and lines. ``T``: matched pose
    relative to the axis centre. ``gate``: largest distance of a partner, m. ``sums``: (3,).
    """
    rows, start, rays, lines = reference
    c, s = np.cos(T[2]), np.sin(T[2])
    sums[:] = 0.0
    before, known = 0.0, False
    last_x = last_y = 0.0
    for i in range(len(points)):
        x = c * points[i, 0] - s * points[i, 1] + T[0]
        y = s * points[i, 0] + c * points[i, 1] + T[1]
        row, _, _ = nearest(rows, start, rays, x, y, gate * gate)
        if row < 0:
            known = False
            continue
        e = lines[row, 0] * (x - rows[row, 0]) + lines[row, 1] * (y - rows[row, 1])
        if known and (x - last_x) ** 2 + (y - last_y) ** 2 < BESIDE_M * BESIDE_M:
            sums[0] += e * before
            sums[1] += 0.5 * (e * e + before * before)
            sums[2] += 1.0
        before, known, last_x, last_y = e, True, x, y


def agreement(points: Array, axis: Axis, lines: Array, T: Array, gate: float) -> Array:
    """:func:`neighbours_agree` for a pose in the odom frame; returns the sums (3,)."""
    sums = np.zeros(3)
    relative = T - np.array((axis.centre[0], axis.centre[1], 0.0))
    neighbours_agree(points, (axis.rows, axis.start, axis.rays, lines), relative, gate, sums)
    return sums


def beams_each(product: float, square: float) -> float:
    """Beams per independent measurement, 1 without correlation or without data."""
    rho = min(max(product / square, 0.0), MOST) if square > 0.0 else 0.0
    return (1.0 + rho) / (1.0 - rho)

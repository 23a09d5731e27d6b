"""Interpolates the residual map at a position: ln correction, sigma and gradient by lamp."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Receiver
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1], f8, f8, f8[::1])")
def look_up(mean: Array, sigma: Array, grid: Array, x: float, y: float, out: Array) -> None:
    """Residual of one lamp with the photodiode at (x, y), by bilinear interpolation.

    Args:
        mean: (ny, nx) of the lamp.
        sigma: (ny, nx) of the lamp.
        grid: (4,) of the lamp.
        x: m.
        y: m.
        out: (4,) out: mean and sigma (ln), gradient of the mean (1/m). Off the grid: mean 0, and the sigma of positions
            where nothing was learned.
    """
    u, v = (x - grid[0]) / grid[2], (y - grid[1]) / grid[2]
    ny, nx = mean.shape
    if not (0.0 <= u < nx - 1 and 0.0 <= v < ny - 1):
        out[0], out[1], out[2], out[3] = 0.0, grid[3], 0.0, 0.0
        return
    i, j = int(u), int(v)
    a, b = u - i, v - j
    m00, m01, m10, m11 = mean[j, i], mean[j, i + 1], mean[j + 1, i], mean[j + 1, i + 1]
    low, high = (1.0 - a) * m00 + a * m01, (1.0 - a) * m10 + a * m11
    s_low = (1.0 - a) * sigma[j, i] + a * sigma[j, i + 1]
    s_high = (1.0 - a) * sigma[j + 1, i] + a * sigma[j + 1, i + 1]
    out[0], out[1] = (1.0 - b) * low + b * high, (1.0 - b) * s_low + b * s_high
    out[2], out[3] = ((1.0 - b) * (m01 - m00) + b * (m11 - m10)) / grid[2], (high - low) / grid[2]


def expected_ln(residuals: ResidualMap, lamp_index: int, x: float, y: float) -> tuple[float, float, Array]:
    """Value to be added to ln of a lamp's expected RSS with the photodiode at (x, y) in the survey's frame.

    Returns:
        Mean and one sigma of ln RSS, and the gradient (2,) of the mean in 1/m; off the map as in :func:`look_up`.
    """
    out = np.zeros(4)
    k = lamp_index
    look_up(residuals.mean[k], residuals.sigma[k], residuals.grid[k], x, y, out)
    return float(out[0]), float(out[1]), out[2:].copy()


class ResidualCorrections:
    """Corrections of the light filter from a residual map.

    Args:
        residuals: learned with the survey of the filter. receiver: for its lever arm.
    """

    def __init__(self, residuals: ResidualMap, receiver: Receiver) -> None:
        """Index the lamps of the map."""
        self._map, self._arm = residuals, np.array((receiver.x, receiver.y, 0.0))
        self._index = {lamp_id: k for k, lamp_id in enumerate(residuals.lamp_ids)}

    def at(self, lamp_ids: Sequence[int], T_map_base: Array) -> Array:
        """See `filter_state.Corrections`."""
        x, y, _ = se2.compose(T_map_base, self._arm).tolist()
        out = np.tile((0.0, -1.0, 0.0, 0.0), (len(lamp_ids), 1))
        for i, lamp_id in enumerate(lamp_ids):
            k = self._index.get(lamp_id)
            if k is None:
                continue
            look_up(self._map.mean[k], self._map.sigma[k], self._map.grid[k], x, y, out[i])
            out[i, 1] = np.hypot(out[i, 1], self._map.noise)
        return out

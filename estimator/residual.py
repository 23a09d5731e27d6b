"""Residual map: by how much each lamp is received differently from Eq. 1, place by place, learned on a teach drive.

Walls, furniture and the lamp's own pattern make errors of several per cent that stay where they are. They are learned
as ln(received / expected) over the floor, per lamp (`estimator.residual_gp`), and kept on a grid around the lamp, so
that looking one up is a handful of multiplications. Places are the photodiode's, in the survey's frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.calibrate_problem import RIM_RAD
from estimator.calibrate_rows import Rows, model
from estimator.kernel import kernel
from estimator.lamps import Survey
from estimator.optics import pack_lamps, pack_receiver
from estimator.records import Array
from estimator.residual_gp import Hyper, choose, fit

CELL_M: Final = 0.25
MARGIN_M: Final = 1.0
FEWEST: Final = 8
SEARCHED: Final = 100
SEARCHED_LAMPS: Final = 8
"""Places of a lamp, and lamps, that take part in the choice of hyperparameters."""
MOST: Final = 700
FAINT_PART: Final = 0.3
"""Where less of a lamp than this comes straight, its residual says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMap:
    """Grids of ln(received / expected), one per lamp; bilinear between their nodes, nothing known outside.

    Attributes:
        lamp_ids: (K,) in the order of the grids.
        grid: (K, 4) x and y of node [0, 0], the cell (m), and one sigma of ln where nothing was learned.
        mean, sigma: (K, ny, nx) ln, and one sigma of it.
        noise: one sigma of what the map could not explain where it was learned.
    """

    lamp_ids: tuple[int, ...]
    grid: Array
    mean: Array
    sigma: Array
    noise: float

    def index(self, lamp_id: int) -> int | None:
        """Which grid is a lamp's, None if it has none."""
        return self.lamp_ids.index(lamp_id) if lamp_id in self.lamp_ids else None


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1], f8, f8, f8[::1])")
def look_up(mean: Array, sigma: Array, grid: Array, x: float, y: float, out: Array) -> None:
    """Residual of one lamp with the photodiode at (x, y).

    Args:
        mean: (ny, nx) of the lamp.
        sigma: (ny, nx) of the lamp.
        grid: (4,) of the lamp.
        x: m.
        y: m.
        out: (4,) is filled with mean and sigma (ln) and the mean's gradient (1/m); off the grid 0 and what the grid
            says of places where nothing was learned.
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
    """What to add to ln of a lamp's expected strength with the photodiode at (x, y) in the survey's frame.

    Returns:
        Mean and one sigma of ln, and the mean's gradient (2,) in 1/m; off the map as :func:`look_up` says.
    """
    out = np.zeros(4)
    k = lamp_index
    look_up(residuals.mean[k], residuals.sigma[k], residuals.grid[k], x, y, out)
    return float(out[0]), float(out[1]), out[2:].copy()


def learn(survey: Survey, rows: Rows, hyper: Hyper | None = None, cell: float = CELL_M) -> ResidualMap:
    """Learn the map from a teach drive.

    Args:
        survey: calibrated; the map is only valid with it.
        rows: strengths with poses in the survey's frame.
        hyper: of the process; chosen by leave-one-out where None.
        cell: of the grids, m.

    Raises:
        ValueError: no lamp has eight places in plain view.
    """
    parts = [_gathered(part, cell) for part in residuals_of(survey, rows)]
    some = [part for part in parts if len(part[1]) >= FEWEST]
    if not some:
        raise ValueError(f"no lamp was seen plainly from {FEWEST} places: drive under the lamps")
    hyper = hyper or choose([_fewer(part, SEARCHED) for part in some[:: -(-len(some) // SEARCHED_LAMPS)]])
    reach = max(float(np.abs(part[0] - _middle(part[0])).max()) for part in some) + MARGIN_M
    nodes = 2 * int(np.ceil(reach / cell)) + 1
    K = len(survey.lamps)
    grid = np.tile((0.0, 0.0, cell, hyper.amplitude), (K, 1))
    mean, sigma = np.zeros((K, nodes, nodes)), np.full((K, nodes, nodes), hyper.amplitude)
    for k, part in enumerate(parts):
        if len(part[1]) < FEWEST:
            continue
        grid[k, :2] = _middle(part[0]) - 0.5 * (nodes - 1) * cell
        x, y = (grid[k, axis] + cell * np.arange(nodes) for axis in (0, 1))
        places = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
        found = fit(hyper, *_fewer(part, MOST)).at(places)
        mean[k], sigma[k] = (values.reshape(nodes, nodes) for values in found)
    return ResidualMap(tuple(lamp.lamp_id for lamp in survey.lamps), grid, mean, sigma, hyper.noise)


Part = tuple[Array, Array, Array]
"""Places (n, 2) of the photodiode, residuals (n,) of ln strength, their variance (n,) from the receiver's noise."""


def residuals_of(survey: Survey, rows: Rows) -> list[Part]:
    """What the survey leaves unexplained, by lamp, where it is in plain view."""
    lamps, receiver = pack_lamps(survey.lamps, survey.depth), pack_receiver(survey.receiver)
    out, _ = model(lamps, receiver, rows.pose, rows.lamp, survey.floor)
    c, s = np.cos(rows.pose[:, 2]), np.sin(rows.pose[:, 2])
    x, y = survey.receiver.x, survey.receiver.y
    places = rows.pose[:, :2] + np.column_stack((c * x - s * y, s * x + c * y))
    seen = (out[:, 1] > FAINT_PART * out[:, 0]) & (out[:, 2] > np.cos(survey.receiver.half_fov_rad - RIM_RAD))
    mine = [np.flatnonzero(seen & (rows.lamp == k)) for k in range(len(survey.lamps))]
    return [(places[at], np.log(rows.amplitude[at] / out[at, 0]), rows.sigma[at] ** 2) for at in mine]


def _gathered(part: Part, cell: float) -> Part:
    """One value per cell, the median of it: a robot that stands still is no reason to believe a place more."""
    places, values, extra = part
    if not len(values):
        return part
    keys = np.floor(places / cell).astype(np.int64)
    order = np.lexsort((values, keys[:, 0], keys[:, 1]))
    begins = np.flatnonzero(np.r_[True, (keys[order][1:] != keys[order][:-1]).any(axis=1)])
    counts = np.diff(np.r_[begins, len(order)])
    middle = order[begins + (counts - 1) // 2]
    return places[middle], values[middle], extra[middle]


def _fewer(part: Part, most: int) -> Part:
    """At most so many places, evenly taken from all."""
    n = len(part[1])
    at = np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))
    places, values, extra = (column[at] for column in part)
    return places, values, extra


def _middle(places: Array) -> Array:
    middle: Array = 0.5 * (places.min(axis=0) + places.max(axis=0))
    return middle

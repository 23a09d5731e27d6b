"""Fits the residual map from a teach drive: RSS that the survey leaves unexplained, over the ground, by lamp."""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.calibration.gaussian_process import Hyper, choose, fit
from estimator.calibration.observations import Rows, model
from estimator.calibration.parameters import RIM_RAD
from estimator.light_filter.lambertian import pack_lamps, pack_receiver
from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Survey
from estimator.numerics.arrays import Array

CELL_M: Final = 0.25
"""Cell of the grids, m."""
MARGIN_M: Final = 1.0
"""Margin of the grids around the observations, m."""
FEWEST: Final = 8
"""Positions in plain view without which a lamp gets no residual map."""
SEARCHED: Final = 100
SEARCHED_LAMPS: Final = 8
"""Limits of the choice of hyperparameters: `SEARCHED` positions per lamp, and this many lamps."""
MOST: Final = 700
"""Most positions of a lamp that the process is conditioned on."""
FAINT_PART: Final = 0.3
"""Smallest direct share of the RSS at which the residual of a lamp is meaningful."""


def learn(survey: Survey, rows: Rows, hyper: Hyper | None = None, cell: float = CELL_M) -> ResidualMap:
    """Fit the residual map to a teach drive.

    Args:
        survey: calibrated; the map is only valid with it.
        rows: RSS with poses in the survey's frame.
        hyper: hyperparameters of the process; None: chosen by leave-one-out.
        cell: cell of the grids, m.

    Raises:
        ValueError: no lamp has eight positions in plain view.
    """
    parts = [_gathered(part, cell) for part in residuals_of(survey, rows)]
    some = [part for part in parts if len(part[1]) >= FEWEST]
    if not some:
        raise ValueError(f"no lamp was received well from {FEWEST} positions; drive under the lamps")
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
"""Positions (n, 2) of the photodiode, residuals (n,) of ln RSS, their variance (n,) from the receiver's noise."""


def residuals_of(survey: Survey, rows: Rows) -> list[Part]:
    """Residuals ln(received / expected) by lamp, where the lamp is in plain view."""
    lamps, receiver = pack_lamps(survey.lamps, survey.depth), pack_receiver(survey.receiver)
    out, _ = model(lamps, receiver, rows.pose, rows.lamp, survey.floor)
    c, s = np.cos(rows.pose[:, 2]), np.sin(rows.pose[:, 2])
    x, y = survey.receiver.x, survey.receiver.y
    places = rows.pose[:, :2] + np.column_stack((c * x - s * y, s * x + c * y))
    seen = (out[:, 1] > FAINT_PART * out[:, 0]) & (out[:, 2] > np.cos(survey.receiver.half_fov_rad - RIM_RAD))
    mine = [np.flatnonzero(seen & (rows.lamp == k)) for k in range(len(survey.lamps))]
    return [(places[at], np.log(rows.amplitude[at] / out[at, 0]), rows.sigma[at] ** 2) for at in mine]


def _gathered(part: Part, cell: float) -> Part:
    """One value per cell, the median: a robot at rest must not raise the weight of a position."""
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
    """At most ``most`` positions, evenly selected."""
    n = len(part[1])
    at = np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))
    places, values, extra = (column[at] for column in part)
    return places, values, extra


def _middle(places: Array) -> Array:
    """Centre of the bounding box of positions (n, 2)."""
    middle: Array = 0.5 * (places.min(axis=0) + places.max(axis=0))
    return middle

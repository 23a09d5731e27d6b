"""Residual map: deviation of each lamp's RSS from Eq. 1 over the ground, learned on a teach drive.

Walls, furniture and the lamp's own pattern make errors of several per cent that are constant in position. They are
learned as ln(received / expected) over the ground, per lamp (`estimator.calibration.residual_map_fit`). A grid around
the lamp stores them, so that a look-up is a handful of multiplications (`estimator.light_filter.residual_lookup`).
Positions are the photodiode's, in the survey's frame. This module is part of stored states and has no kernel, so that
writing states loads none.
"""

from __future__ import annotations

from dataclasses import dataclass

from estimator.numerics.arrays import Array


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMap:
    """Grids of ln(received / expected), one per lamp; bilinear between their nodes, nothing known outside.

    Attributes:
        lamp_ids: (K,) in the order of the grids.
        grid: (K, 4) x and y of node [0, 0], the cell (m), and one sigma of ln where nothing was learned.
        mean, sigma: (K, ny, nx) ln, and one sigma of it.
        noise: one sigma of ln that the map did not explain where it was learned.
    """

    lamp_ids: tuple[int, ...]
    grid: Array
    mean: Array
    sigma: Array
    noise: float

    def index(self, lamp_id: int) -> int | None:
        """Index of a lamp's grid, None if it has none."""
        return self.lamp_ids.index(lamp_id) if lamp_id in self.lamp_ids else None

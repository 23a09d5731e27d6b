"""Residual map: by how much each lamp is received differently from Eq. 1, place by place, learned on a teach drive.

Walls, furniture and the lamp's own pattern make errors of several per cent that stay where they are. They are learned
as ln(received / expected) over the floor, per lamp (`estimator.calibration.residual_map_fit`), and kept on a grid
around the lamp, so that looking one up is a handful of multiplications (`estimator.light_filter.residual_lookup`).
Places are the photodiode's, in the survey's frame. What a state may hold is here, without a kernel: who writes states
loads none for it.
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

"""Occupancy grid: log-odds of every cell, by casting each beam through it.

Beams have three values: a hit ends on a surface, a free beam clears its whole length, and any other changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.measurements import Beam, Beams
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

Placed = tuple[Array, Beams]
"""T_map_lidar and beams of a scan."""

LIMIT = 50_000_000
"""Most cells of a grid: 200 MB."""

HIT_LOGIT = 0.85
FREE_LOGIT = -0.4
CLAMP = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A map as cells.

    Attributes:
        origin: (x, y) of the lower left corner of cell [0, 0], metres in the map frame.
        resolution: metres per cell.
        log_odds: float32 (rows, columns); row 0 has the smallest y; 0 is unknown, positive is occupied.
    """

    origin: Array
    resolution: float
    log_odds: npt.NDArray[np.float32]

    @property
    def probability(self) -> npt.NDArray[np.float32]:
        """Probability that each cell is occupied; 0.5 where it is unknown."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.log_odds)), dtype=np.float32)


@kernel("void(f4[:, ::1], f8[::1], f8[::1], Tuple((f8[::1], f8[::1], u1[::1])))", aside=True)
def cast_beams(
    cells: npt.NDArray[np.float32],
    frame: Array,
    T_map_lidar: Array,
    beams: tuple[Array, Array, npt.NDArray[np.uint8]],
) -> None:
    """Add one scan to ``cells``, walking each beam cell by cell; ``frame`` is the grid's (x, y, resolution)."""
    bearing, distance, kind = beams
    rows, columns = cells.shape
    ox = (T_map_lidar[0] - frame[0]) / frame[2]
    oy = (T_map_lidar[1] - frame[1]) / frame[2]
    for i in range(len(bearing)):
        reach = distance[i] / frame[2]
        if kind[i] == 0 or not (0.0 < reach < 1e6):
            continue
        angle = bearing[i] + T_map_lidar[2]
        dx, dy = np.cos(angle), np.sin(angle)
        column, row = int(np.floor(ox)), int(np.floor(oy))
        last_column, last_row = int(np.floor(ox + reach * dx)), int(np.floor(oy + reach * dy))
        step_x = 1 if dx > 0.0 else -1
        step_y = 1 if dy > 0.0 else -1
        next_x = (column + (dx > 0.0) - ox) / dx if dx != 0.0 else np.inf
        next_y = (row + (dy > 0.0) - oy) / dy if dy != 0.0 else np.inf
        for _ in range(abs(last_column - column) + abs(last_row - row)):
            if 0 <= row < rows and 0 <= column < columns:
                cells[row, column] = max(-CLAMP, cells[row, column] + FREE_LOGIT)
            if next_x < next_y:
                column += step_x
                next_x += abs(1.0 / dx)
            else:
                row += step_y
                next_y += abs(1.0 / dy)
        if 0 <= last_row < rows and 0 <= last_column < columns:
            change = HIT_LOGIT if kind[i] == 1 else FREE_LOGIT
            cells[last_row, last_column] = min(CLAMP, max(-CLAMP, cells[last_row, last_column] + change))


def extent(scans: Sequence[Placed], margin: float) -> tuple[Array, Array]:
    """Lower left and upper right corner that contain every lidar and every surface point."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for T, (bearing, reach, kind) in scans:
        hit = (kind == Beam.HIT) & np.isfinite(reach) & np.isfinite(bearing)
        angle = bearing[hit] + T[2]
        for axis, ends in enumerate((reach[hit] * np.cos(angle), reach[hit] * np.sin(angle))):
            low[axis] = min(low[axis], T[axis] + ends.min(initial=0.0))
            high[axis] = max(high[axis], T[axis] + ends.max(initial=0.0))
    return low - margin, high + margin


def blank(rows: int, columns: int, resolution: float) -> npt.NDArray[np.float32]:
    """Unknown cells of this size.

    Raises:
        ValueError: more than :data:`LIMIT`.
    """
    if rows * columns > LIMIT:
        raise ValueError(
            f"a map of {columns} x {rows} cells is too large; choose a resolution coarser than {resolution} m"
        )
    return np.zeros((rows, columns), np.float32)


def render(scans: Sequence[Placed], resolution: float) -> Grid:
    """The grid of these scans, on multiples of the resolution; the GIL is free while a scan is cast.

    Raises:
        ValueError: the resolution is not positive, or the grid would have more than :data:`LIMIT` cells.
    """
    if not resolution > 0.0:
        raise ValueError(f"map resolution is {resolution} m per cell; it must be positive")
    if not scans:
        return Grid(np.zeros(2), resolution, np.zeros((0, 0), np.float32))
    low, high = extent(scans, 4.0 * resolution)
    origin = np.floor(low / resolution) * resolution
    columns, rows = (np.ceil((high - origin) / resolution)).astype(np.int64).tolist()
    cells = blank(rows, columns, resolution)
    frame = np.array((origin[0], origin[1], resolution))
    for T_map_lidar, beams in scans:
        cast_beams(cells, frame, T_map_lidar, beams)
    return Grid(origin, resolution, cells)

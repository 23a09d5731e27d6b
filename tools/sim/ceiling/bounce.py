"""Light that comes by way of the walls: patches, one or two reflections, kept on a grid of places for each lamp.

A wall is cut into columns, a column into patches. What a lamp sheds on each, what a patch gives back (Lambert's law),
and who sees whom past other walls and columns is worked out once for a lamp, when it is first asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.building.world import CIRCLE, SEGMENT, SimWorld, material_table
from tools.sim.ceiling.kernels import COLUMN_COLUMNS, exchange, gather, light_up, see_columns
from tools.sim.ceiling.lamps import Zone

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

REFERENCE_ALBEDO: Final = 0.75
"""Of a painted wall in infrared; `rho` is its reflectance for the lamps' light, other surfaces are in proportion."""

SMALLEST_M: Final = 0.12
"""Posts and reveals narrower than this give nothing back."""


@dataclass(frozen=True, slots=True)
class Finish:
    """How walls reflect. rho: of a painted wall. bounces: 1 or 2. eye_m: height of the photodiode. fine: of the grid.

    ``fine`` is the pitch as a share of the height of the ceiling above the photodiode.
    """

    rho: float
    bounces: int
    eye_m: float
    ceiling_m: float
    fine: float = 0.1

    @property
    def pitch(self) -> float:
        """Of the grid of places."""
        return self.fine * (self.ceiling_m - self.eye_m)


class Walls:
    """The walls of one zone as patches, and places on a grid in it; the zone's lamps share it."""

    def __init__(self, world: SimWorld, zone: Zone, finish: Finish) -> None:
        self.zone, self.finish = zone, finish
        x_min, y_min, x_max, y_max = zone
        nx, ny = (max(int(np.ceil((b - a) / finish.pitch)), 1) for a, b in ((x_min, x_max), (y_min, y_max)))
        edge = 0.03  # the outermost places lie just inside the walls
        self.x = np.linspace(x_min + edge, x_max - edge, nx + 1)
        self.y = np.linspace(y_min + edge, y_max - edge, ny + 1)
        self.columns, self.heights, self.patch_m = _patches(world, zone, finish)
        self._blinds = _standing(world, zone)
        gx, gy = np.meshgrid(self.x, self.y, indexing="ij")
        places = np.column_stack([gx.ravel(), gy.ravel()])
        self._places = np.column_stack([places, np.full(len(places), finish.eye_m), np.full(len(places), self.patch_m)])
        self._seen = self._view(places)
        self._between = self._view(self.columns[:, :2] + 0.02 * self.columns[:, 2:4]) if finish.bounces > 1 else None

    def _view(self, points: Array) -> Float32:
        seen = np.zeros((len(points), len(self.columns)), dtype=np.float32)
        see_columns(np.ascontiguousarray(points), self.columns, self._blinds, seen)
        return seen

    def grid(self, lamp: Array, emission: Array, acceptance: Array) -> Array:
        """(x, y) weighted irradiance at all places by way of the walls, for a lamp of 1 W."""
        exitance = np.zeros((len(self.columns), len(self.heights)))
        light_up(lamp, emission, self._view(lamp[None, :2])[0], self.columns, self.heights, exitance)
        if self._between is not None:
            more = np.zeros_like(exitance)
            exchange((self.columns, self.heights, exitance), self._between, self.patch_m, more)
            exitance += more
        out = np.zeros(len(self._places))
        gather(self._places, (self.columns, self.heights, exitance), self._seen, acceptance, out)
        return out.reshape(len(self.x), len(self.y))


def interpolate(x: Array, y: Array, grid: Array, at: Array) -> Array:
    """Bilinear in a grid of evenly spaced places, (n, 2) points clipped to it."""
    u = np.clip((at[:, 0] - x[0]) / (x[-1] - x[0]), 0.0, 1.0) * (len(x) - 1)
    v = np.clip((at[:, 1] - y[0]) / (y[-1] - y[0]), 0.0, 1.0) * (len(y) - 1)
    i, j = np.minimum(u.astype(int), len(x) - 2), np.minimum(v.astype(int), len(y) - 2)
    u, v = u - i, v - j
    near = (1.0 - v) * grid[i, j] + v * grid[i, j + 1]
    far = (1.0 - v) * grid[i + 1, j] + v * grid[i + 1, j + 1]
    return np.asarray((1.0 - u) * near + u * far)


def inside(shapes: Array, zone: Zone, margin: float) -> npt.NDArray[np.bool_]:
    """Which shapes touch a zone."""
    x_min, y_min, x_max, y_max = zone
    round_ = shapes[:, 0] == CIRCLE
    reach = np.where(round_, shapes[:, 3], 0.0) + margin
    bx, by = np.where(round_, shapes[:, 1], shapes[:, 3]), np.where(round_, shapes[:, 2], shapes[:, 4])
    x = np.minimum(shapes[:, 1], bx) - reach, np.maximum(shapes[:, 1], bx) + reach
    y = np.minimum(shapes[:, 2], by) - reach, np.maximum(shapes[:, 2], by) + reach
    return np.asarray((x[0] <= x_max) & (x[1] >= x_min) & (y[0] <= y_max) & (y[1] >= y_min))


def _standing(world: SimWorld, zone: Zone) -> Array:
    """Obstacle rows of what reaches the ceiling in and around a zone; panes let light through."""
    tall = np.isinf(world.tops) & inside(world.shapes, zone, 0.05)
    return obstacle_rows(world.shapes[tall], world.tops[tall])


def obstacle_rows(shapes: Array, tops: Array) -> Array:
    """Shapes as rows for the kernels, see :mod:`tools.sim.ceiling.kernels`."""
    clear = material_table()[shapes[:, 5].astype(int), 2] * 0.85
    return np.column_stack([shapes[:, :5], np.zeros(len(shapes)), tops, clear])


def _patches(world: SimWorld, zone: Zone, finish: Finish) -> tuple[Array, Array, float]:
    """Columns of the zone's walls, heights of the patches' middles, and a patch's height."""
    x_min, y_min, x_max, y_max = zone
    shapes, tops = world.shapes, world.tops
    chosen = (shapes[:, 0] == SEGMENT) & (tops > 1.2) & inside(shapes, zone, 0.05)
    albedo = material_table()[:, 0]
    size = 1.3 * finish.pitch
    rows = []
    for (_, ax, ay, bx, by, material), top in zip(shapes[chosen], tops[chosen], strict=True):
        length = float(np.hypot(bx - ax, by - ay))
        rho = finish.rho * albedo[int(material)] / REFERENCE_ALBEDO
        if rho < 0.01 or length < SMALLEST_M:
            continue
        count = int(np.ceil(length / size))
        part = (np.arange(count) + 0.5) / count
        x, y = ax + part * (bx - ax), ay + part * (by - ay)
        normal = np.array([ay - by, bx - ax]) / length
        for side in (1.0, -1.0):
            nx, ny = side * normal
            fronts = (x + 0.02 * nx >= x_min) & (x + 0.02 * nx <= x_max)
            fronts &= (y + 0.02 * ny >= y_min) & (y + 0.02 * ny <= y_max)
            rows += [
                (px, py, nx, ny, length / count, rho, top, 0.0) for px, py in zip(x[fronts], y[fronts], strict=True)
            ]
    levels = max(int(np.ceil(finish.ceiling_m / size)), 1)
    patch = float(finish.ceiling_m / levels)
    heights: Array = (np.arange(levels, dtype=np.float64) + 0.5) * patch
    columns = np.array(rows, dtype=np.float64).reshape(-1, COLUMN_COLUMNS)
    return np.ascontiguousarray(columns), heights, patch

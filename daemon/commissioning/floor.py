"""Floor plan for lamp planning: walls, robot positions, and possible lamp positions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from daemon.commissioning.reach import ANYWHERE, Drive, Frame, NoRoom, Reached, Robot, reached
from daemon.maps.map_server import BadMapServer, Trinary, load

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

CELL_M: Final = 0.1
"""Cell of the plan, m; finer images are made coarser."""
FURNITURE_M: Final = 1.5
"""Longest isolated object, m, that does not reach the ceiling: light passes over it."""
MOST_PLACES: Final = 5000
FINEST_M: Final = 0.25


class NoHall(Exception):
    """The plan cannot be used; the text gives cause and remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Hall:
    """Floor plan with rows from below, in its own frame; ``origin`` is the pose of its corner in the map frame.

    Attributes:
        origin: (x, y, yaw), m and rad. cell: m. solid: stops the lidar. tall: stops light, too.
        places: (n, 2) m in the plan's frame, positions of a robot on a grid of ``step`` m. spots: (m, 2) m, possible
            lamp positions. reached: floor that the robot reaches. pictured: whether the plan is an image without beams.
    """

    origin: tuple[float, float, float]
    cell: float
    solid: Mask
    tall: Mask
    places: Array
    step: float
    spots: Array
    reached: Reached
    pictured: bool = True

    def in_map(self, xy: Array) -> Array:
        """Transforms points (n, 2), m, from the plan's frame to the map frame."""
        return Frame(self.origin, self.cell).in_map(xy)

    def in_plan(self, xy: Array) -> Array:
        """Transforms points (n, 2), m, from the map frame to the plan's frame."""
        return Frame(self.origin, self.cell).in_plan(xy)


def read_hall(path: Path, spacing: float, robot: Robot = ANYWHERE) -> Hall:
    """Returns the plan in an image of map_server or in a map file.

    ``path``: YAML file, the image beside it, or a map file. ``spacing``: between possible lamp positions, m.
    ``robot``: who must reach the floor.

    Raises:
        NoHall: the plan cannot be used.
    """
    if path.suffix == ".lumimap":
        cells, resolution, origin, drive = _of_map(path)
        return hall_of(cells, resolution, origin, spacing, robot, drive)
    if path.is_dir():
        raise NoHall(f"{path}: this is a folder; name the image in it, its YAML file, or a map file, *.lumimap")
    if not path.exists():
        raise NoHall(f"{path}: no such file; name a map_server image, its YAML file, or a map file, *.lumimap")
    yaml = path if path.suffix in (".yaml", ".yml") else path.with_suffix(".yaml")
    if not yaml.exists():
        raise NoHall(f"{path}: {yaml.name} with the size of a pixel is missing; put it beside the image")
    try:
        described, cells = load(yaml)
    except BadMapServer as error:
        raise NoHall(str(error)) from error
    return hall_of(cells, described.resolution, described.origin, spacing, robot)


def _of_map(path: Path) -> tuple[Trinary, float, tuple[float, float, float], Drive]:
    from daemon.maps.container import BadMap
    from daemon.maps.edit import opened
    from daemon.maps.grid_files import greys
    from daemon.maps.image import image_from
    from daemon.maps.image_geometry import echoes_of, grid_of, placed

    try:
        image = image_from(opened(path))
        grid = grid_of(image)
    except (BadMap, OSError) as error:
        raise NoHall(str(error)) from error
    frames = placed(image)
    drive = Drive(np.array([T[:2] for _, T in frames]).reshape(-1, 2), [echoes_of(frame, T) for frame, T in frames])
    grey = greys(grid)[::-1]
    cells = np.where(grey == 0, 1, np.where(grey == 254, 0, -1)).astype(np.int8)
    return cells, grid.resolution, (float(grid.origin[0]), float(grid.origin[1]), 0.0), drive


def hall_of(
    cells: Trinary,
    resolution: float,
    origin: tuple[float, float, float],
    spacing: float,
    robot: Robot = ANYWHERE,
    drive: Drive | None = None,
) -> Hall:
    """Returns the plan of a grid of cells (1 occupied, 0 free, -1 unknown; rows from below).

    ``drive``: what a map file holds of its drives; None for an image.

    Raises:
        NoHall: it has no place for a robot.
    """
    solid, free, cell = _coarser(cells, resolution)
    try:
        found = reached(free, Frame(origin, cell), robot, drive)
    except NoRoom as error:
        raise NoHall(str(error)) from error
    room = found.room
    area = float(room.sum()) * cell**2
    step = cell * max(round(FINEST_M / cell), math.ceil(math.sqrt(area / MOST_PLACES) / cell), 1)
    above = free & (ndimage.distance_transform_edt(~room) * cell <= 0.5 * robot.width + 2.0 * cell)
    spots = _on_grid(above, cell, max(spacing, cell))
    return Hall(origin, cell, solid, _tall(solid, cell), _on_grid(room, cell, step), step, spots, found, drive is None)


def _coarser(cells: Trinary, resolution: float) -> tuple[Mask, Mask, float]:
    """Returns solid and free masks at about :data:`CELL_M`, and the cell size, m.

    A block is solid if any cell in it is. It is free if at least half of its cells are known to be free.
    """
    k = max(1, round(CELL_M / resolution))
    rows, columns = -(-cells.shape[0] // k), -(-cells.shape[1] // k)
    padded = np.full((rows * k, columns * k), -1, np.int8)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    blocks = padded.reshape(rows, k, columns, k)
    solid = (blocks == 1).any(axis=(1, 3))
    free = ((blocks == 0).mean(axis=(1, 3)) >= 0.5) & ~solid
    return solid, free, resolution * k


def _tall(solid: Mask, cell: float) -> Mask:
    """Returns the solid mask without small isolated objects, which are no walls."""
    labels, _ = ndimage.label(solid, structure=np.ones((3, 3)))
    tall = solid.copy()
    for number, where in enumerate(ndimage.find_objects(labels), 1):
        if max(part.stop - part.start for part in where) * cell <= FURNITURE_M:
            tall[where] &= labels[where] != number
    return tall


def _on_grid(mask: Mask, cell: float, step: float) -> Array:
    """Returns centres of mask cells on a grid of ``step`` m; a mask that the grid misses gives its first cell."""
    k = max(1, round(step / cell))
    chosen = np.zeros_like(mask)
    chosen[k // 2 :: k, k // 2 :: k] = mask[k // 2 :: k, k // 2 :: k]
    row, column = np.nonzero(chosen)
    if not len(row):
        row, column = (part[:1] for part in np.nonzero(mask))
    return np.column_stack(((column + 0.5) * cell, (row + 0.5) * cell))


def clear(blocked: Mask, cell: float, start: Array, ends: Array) -> Mask:
    """Returns (n,) whether the straight line from ``start`` (2,) to each of ``ends`` (n, 2) crosses no blocked cell.

    M.
    """
    if not len(ends):
        return np.zeros(0, np.bool_)
    longest = float(np.hypot(*(ends - start).T).max())
    t = np.linspace(0.0, 1.0, max(2, math.ceil(1.5 * longest / cell)))
    column = ((start[0] + np.outer(t, ends[:, 0] - start[0])) / cell).astype(np.int64)
    row = ((start[1] + np.outer(t, ends[:, 1] - start[1])) / cell).astype(np.int64)
    inside = (row >= 0) & (row < blocked.shape[0]) & (column >= 0) & (column < blocked.shape[1])
    hit = inside & blocked[np.clip(row, 0, blocked.shape[0] - 1), np.clip(column, 0, blocked.shape[1] - 1)]
    return np.asarray(~hit.any(axis=0))

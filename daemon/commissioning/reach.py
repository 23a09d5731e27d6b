"""Floor that a robot of a given width reaches from where it starts, or from where it has driven.

Glass is transparent for most beams of a lidar, so a map shows free floor behind it. Beams that meet the glass at right
angles return from it. A cell in which beams of several scans ended is therefore an obstacle here, even if most beams
passed through it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

WIDTH_M: Final = 0.6
"""Width of a robot, m, where none is given."""
NEAREST_M: Final = 0.5
"""A start or a position on the path counts as the nearest place that is no farther away, m."""
ECHOES: Final = 2
"""Scans with a beam that ended in a cell, from which on the cell counts as an obstacle."""
LEAST_AREA_M2: Final = 1.0
"""Smaller free areas, m^2, are flaws of the image."""


class Robot(NamedTuple):
    """Who must reach the floor: its width, m, and its start (x, y) in the map frame, m; None: anywhere."""

    width: float = WIDTH_M
    start: tuple[float, float] | None = None


ANYWHERE: Final = Robot()
"""A robot of the usual width that may start on any floor."""


class Drive(NamedTuple):
    """What a map file holds of its drives, in the map frame: positions (n, 2), and where each scan's beams ended, m."""

    path: Array
    echoes: Sequence[Array]


class Reached(NamedTuple):
    """Result.

    Attributes:
        room: (rows, columns) where the robot's centre can be; left_out: where it could be, but does not get to.
        width: m. since: from where it must get there, as text; empty: from anywhere.
        apart_m2: floor that is left out because it is not connected. behind_m2: floor that is left out because glass
            separates it. regions: number of regions that are not connected with each other.
    """

    room: Mask
    left_out: Mask
    width: float
    since: str = ""
    apart_m2: float = 0.0
    behind_m2: float = 0.0
    regions: int = 1

    def lines(self, pictured: bool) -> list[str]:
        """What a person must know of the floor that is left out; ``pictured``: the plan is an image without beams."""
        said = []
        if self.apart_m2 >= LEAST_AREA_M2:
            said.append(
                f"excluded: {self.apart_m2:.0f} m2 that a robot {self.width:.2f} m wide cannot reach from {self.since}"
            )
        if self.behind_m2 >= LEAST_AREA_M2:
            said.append(f"excluded: {self.behind_m2:.0f} m2 that the lidar measured only through glass")
        if not self.since and self.regions > 1:
            said.append(f"{self.regions} areas are not connected; give --start X Y to exclude what cannot be reached")
        if pictured and self.since:
            said.append("an image does not show glass; draw glass as a wall, or plan with a map file, *.lumimap")
        return said


class Frame(NamedTuple):
    """Grid of the plan: pose of its corner in the map frame (x, y, yaw), and its cell, m."""

    origin: tuple[float, float, float]
    cell: float

    def in_plan(self, xy: Array) -> Array:
        """Transforms points (n, 2), m, from the map frame to the plan's frame."""
        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = xy[:, 0] - x, xy[:, 1] - y
        return np.column_stack((c * dx + s * dy, c * dy - s * dx))

    def in_map(self, xy: Array) -> Array:
        """Transforms points (n, 2), m, from the plan's frame to the map frame."""
        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        return np.column_stack((x + c * xy[:, 0] - s * xy[:, 1], y + s * xy[:, 0] + c * xy[:, 1]))


class NoRoom(ValueError):
    """There is no place for the robot, or its start is none; the text gives cause and remedy."""


def reached(free: Mask, frame: Frame, robot: Robot, drive: Drive | None = None) -> Reached:
    """Returns the floor that the robot reaches.

    ``free``: cells of the plan, rows from below. ``drive``: None for a plan that is only an image.

    Raises:
        NoRoom: there is none.
    """
    open_room, regions = _regions(free, frame.cell, robot.width)
    if not regions.any():
        raise NoRoom("the plan has no free position for a robot; check the image and its `negate`")
    count = len(np.unique(regions[open_room]))
    since, seeds = _seeds(robot, drive)
    nothing = np.zeros_like(open_room)
    if seeds is None:
        return Reached(open_room, nothing, robot.width, regions=count)
    connected = _connected(regions, frame, seeds, required=robot.start is not None)
    if not connected.any():
        return Reached(open_room, nothing, robot.width, regions=count)
    inside = connected
    if drive is not None and drive.echoes:
        inside = _before_glass(free, connected, frame, robot.width, seeds, drive.echoes)
    area = frame.cell**2
    apart, behind = open_room & ~connected, connected & ~_widened(inside, frame.cell, robot.width)
    return Reached(
        inside, apart | behind, robot.width, since, float(apart.sum()) * area, float(behind.sum()) * area, count
    )


def _before_glass(
    free: Mask, connected: Mask, frame: Frame, width: float, seeds: Array, echoes: Sequence[Array]
) -> Mask:
    """Returns the part of ``connected`` that no glass separates from the seeds.

    People who walk past leave echoes too. Only echoes at the border of what is left out are obstacles.
    """
    glass = _glass(free.shape, frame, echoes)
    strict = _connected(_regions(free & ~glass, frame.cell, width)[1], frame, seeds)
    if not strict.any():
        return connected
    behind = connected & ~_widened(strict, frame.cell, width)
    if not behind.any():
        return connected
    border = glass & (ndimage.distance_transform_edt(~behind) * frame.cell <= 2.0 * width)
    loose = _connected(_regions(free & ~border, frame.cell, width)[1], frame, seeds)
    leaked = (loose & behind).sum() > 0.5 * behind.sum()
    return strict if leaked else loose


def _regions(free: Mask, cell: float, width: float) -> tuple[Mask, npt.NDArray[np.int32]]:
    """Returns where the robot's centre can be, and the number of the region of each such cell; 0 elsewhere."""
    labels, _ = ndimage.label(ndimage.distance_transform_edt(free) * cell > 0.5 * width)
    large = np.bincount(labels.ravel()) * cell**2 >= LEAST_AREA_M2
    large[0] = False
    room = large[labels]
    return room, np.where(room, labels, 0).astype(np.int32)


def _widened(room: Mask, cell: float, width: float) -> Mask:
    """Returns the cells that a robot with its centre in ``room`` covers, and one cell more."""
    return np.asarray(ndimage.distance_transform_edt(~room) * cell <= width + cell)


def _seeds(robot: Robot, drive: Drive | None) -> tuple[str, Array | None]:
    if robot.start is not None:
        x, y = robot.start
        return f"({x:g}, {y:g})", np.array([robot.start])
    if drive is not None and len(drive.path):
        return "its recorded path", drive.path
    return "", None


def _connected(regions: npt.NDArray[np.int32], frame: Frame, seeds: Array, required: bool = False) -> Mask:
    """Returns the regions in which a seed lies, (n, 2) m in the map frame, or from which it is near."""
    away, nearest = ndimage.distance_transform_edt(regions == 0, return_indices=True)
    column, row = np.floor(frame.in_plan(seeds) / frame.cell).astype(np.int64).T
    rows, columns = regions.shape
    at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
    off = frame.cell * np.hypot(away[at], np.hypot(row - at[0], column - at[1]))
    here = nearest[0][at], nearest[1][at]
    if required and off.min() > NEAREST_M:
        x, y = frame.in_map(frame.cell * (np.array([[here[1][0], here[0][0]]]) + 0.5))[0]
        raise NoRoom(
            f"--start {seeds[0, 0]:g} {seeds[0, 1]:g}: the robot does not fit there; the nearest possible "
            f"position is {x:.2f} {y:.2f}, in the map frame"
        )
    found = np.unique(regions[here][off <= NEAREST_M])
    return np.isin(regions, found[found > 0])


def _glass(shape: tuple[int, ...], frame: Frame, echoes: Sequence[Array]) -> Mask:
    """Returns cells in which beams of :data:`ECHOES` scans or more ended."""
    rows, columns = shape
    count = np.zeros(rows * columns, np.int64)
    for ends in echoes:
        column, row = np.floor(frame.in_plan(ends) / frame.cell).astype(np.int64).T
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        count[np.unique(row[inside] * columns + column[inside])] += 1
    return np.asarray(count.reshape(rows, columns) >= ECHOES)

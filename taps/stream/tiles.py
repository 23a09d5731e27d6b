"""Assembles the map from the tiles of the stream."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps import map_server
from daemon.maps.tiles import RESOLUTION_M
from daemon.publish.stream.messages import MapTiles

LogOdds = npt.NDArray[np.float32]
EMPTY_MAP: Final = np.zeros((1, 1), np.float32)
"""One unknown cell: replaces the map after RESET, since some readers cannot handle an empty grid."""
WALL, FREE, UNSEEN = 100, 0, -1
"""Cell values of ROS's OccupancyGrid."""


class TileMap:
    """The tiles of one map.

    Attributes:
        resolution: m per cell. map_id: of the map.
    """

    def __init__(self) -> None:
        self.resolution, self.map_id = RESOLUTION_M, 0
        self._changed = False
        self._tiles: dict[tuple[int, int], LogOdds] = {}

    @property
    def changed(self) -> bool:
        """Whether the map has changed since :meth:`whole`, also to an empty one."""
        return self._changed

    def update(self, frame: MapTiles) -> None:
        """Replace some tiles.

        Raises:
            NotTheStream: they cannot be decoded.
        """
        for column, row, packed in frame.tiles:
            cells = frame.cells(packed)
            if cells.any():
                self._tiles[column, row] = np.float32(frame.unit) * cells
            else:
                self._tiles.pop((column, row), None)
        self.resolution, self.map_id, self._changed = frame.resolution, frame.map_id, not frame.more

    def whole(self) -> tuple[tuple[float, float], LogOdds]:
        """Lower left corner (m) and log-odds (rows, columns), rows from below, 0 unknown; an empty map is one cell."""
        self._changed = False
        if not self._tiles:
            return (0.0, 0.0), EMPTY_MAP
        columns, rows = zip(*self._tiles, strict=True)
        left, below, side = min(columns), min(rows), len(next(iter(self._tiles.values())))
        whole = np.zeros(((max(rows) - below + 1) * side, (max(columns) - left + 1) * side), np.float32)
        for (column, row), cells in self._tiles.items():
            at_row, at_column = (row - below) * side, (column - left) * side
            whole[at_row : at_row + side, at_column : at_column + side] = cells
        return (left * side * self.resolution, below * side * self.resolution), whole


def trinary(log_odds: LogOdds) -> npt.NDArray[np.int8]:
    """:data:`WALL`, :data:`FREE` or :data:`UNSEEN`, by map_server's thresholds."""
    cells = np.full(log_odds.shape, UNSEEN, np.int8)
    cells[log_odds > math.log(map_server.OCCUPIED / (1.0 - map_server.OCCUPIED))] = WALL
    cells[log_odds < math.log(map_server.FREE / (1.0 - map_server.FREE))] = FREE
    return cells

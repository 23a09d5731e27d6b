"""Occupancy patches of submaps, rendered once each, and tiles: the combined occupancy of all patches.

A patch lies on the map's own grid at the pose of the submap when it is rendered. It is copied cell by cell while the
submap stays there. After a move, each cell of a tile reads the nearest cell of the patch.

Newer patches have priority (:func:`lay_under`). A cell sums the log-odds of the patches from the newest back, each
limited to :data:`WORD`. The sum ends when their magnitudes reach :data:`ENOUGH`. Older patches do not count. So the map
forgets: a table that was moved disappears when two newer submaps have seen through its old position.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.mapping import occupancy_grid
from estimator.mapping.keyframe import Keyframe
from estimator.measurements import Beam, Beams
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

Tile = tuple[int, int]
"""Column and row of a tile; its first cell is that multiple of :data:`SIDE` cells from the map's origin."""

Cells = npt.NDArray[np.int8]
"""(rows, columns), log-odds in :data:`UNIT`; 0 is unknown, positive is occupied."""

Shorts = npt.NDArray[np.int16]

Seen = tuple[Array, Keyframe]
"""A keyframe with its T_submap_lidar: the lidar in the frame of its submap."""

SIDE: Final = 128
UNIT: Final = 0.1
WORD, ENOUGH = 50, 80
"""Largest log-odds of one patch in a cell, and of a cell in all, in :data:`UNIT`."""

REACH_M: Final = 30.0
"""Length of the beams, m; beyond, cells between two of them would get no data."""

LEVEL: Final = 1


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Cells of one submap.

    Attributes:
        T_map_submap: pose of the submap at the rendering.
        corner: column and row, on the map's grid, of cell [0, 0].
        shape: rows, columns.
        reach_m: from the submap's origin to the farthest corner.
        weight: sum of the magnitudes of its cells.
        packed: the cells, compressed.
    """

    T_map_submap: Array
    corner: tuple[int, int]
    shape: tuple[int, int]
    reach_m: float
    weight: int
    packed: bytes

    def cells(self) -> Cells:
        """The cells, unpacked."""
        return np.frombuffer(bytearray(zlib.decompress(self.packed)), np.int8).reshape(self.shape)

    def moved(self, T_map_submap: Array) -> Array:
        """Motion of the submap since (from the map frame then to the map frame now)."""
        return se2.compose(T_map_submap, se2.inverse(self.T_map_submap))

    def corners(self, T_map_submap: Array, resolution: float) -> Array:
        """(4, 2) corners, m, with the submap at this pose."""
        column, row = self.corner
        rows, columns = self.shape
        x, y = (column, column + columns), (row, row + rows)
        still = np.array([(u, v) for u in x for v in y]) * resolution
        if np.array_equal(T_map_submap, self.T_map_submap):
            return still
        return se2.apply(self.moved(T_map_submap), still)

    def touches(self, T_map_submap: Array, resolution: float) -> frozenset[Tile]:
        """Tiles that it may overlap, with the submap at this pose."""
        at = self.corners(T_map_submap, resolution) / (SIDE * resolution)
        (x0, y0), (x1, y1) = np.floor(at.min(axis=0) + 1e-9).tolist(), np.floor(at.max(axis=0) - 1e-9).tolist()
        return frozenset((i, j) for i in range(int(x0), int(x1) + 1) for j in range(int(y0), int(y1) + 1))


def render(frames: Sequence[Seen], T_map_submap: Array, resolution: float) -> Patch:
    """The patch of a submap's keyframes; compiled loops of a scan each, without the GIL."""
    drawn = occupancy_grid.render(
        [(se2.compose(T_map_submap, T), shortened(frame.beams())) for T, frame in frames], resolution
    )
    cells = np.clip(np.rint(drawn.log_odds / UNIT), -WORD, WORD).astype(np.int8)
    column, row = np.rint(drawn.origin / resolution).astype(np.int64).tolist()
    rows, columns = cells.shape
    far = np.abs(np.array([(column, row), (column + columns, row + rows)]) * resolution - T_map_submap[:2]).max(axis=0)
    weight = int(np.abs(cells.astype(np.int64)).sum())
    packed = zlib.compress(cells.tobytes(), LEVEL)
    return Patch(T_map_submap, (column, row), (rows, columns), float(np.hypot(*far)), weight, packed)


def shortened(beams: Beams) -> Beams:
    """The beams up to :data:`REACH_M`; a longer one is free until there."""
    bearing, distance, kind = beams
    far = (kind == Beam.HIT) & (distance > REACH_M)
    if not far.any():
        return beams
    return bearing, np.where(far, REACH_M, distance), np.where(far, np.uint8(Beam.FREE), kind).astype(np.uint8)


@kernel("i8(i2[:, ::1], i2[:, ::1], i1[:, ::1], f8[::1])", aside=True)
def lay_under(said: Shorts, heard: Shorts, cells: Cells, how: Array) -> int:
    """Add an older patch to a tile, as far as its cells are not full; returns the sum of the magnitudes added.

    ``said``, ``heard``: sums of the values that count, and of their magnitudes. ``how``: column and row in the patch of
    the centre of the tile's cell [0, 0]; their change per column, then per row of the tile.
    """
    rows, columns = said.shape
    high, wide = cells.shape
    used = 0
    for j in range(rows):
        for i in range(columns):
            left = ENOUGH - int(heard[j, i])
            if left <= 0:
                continue
            u = int(np.floor(how[0] + i * how[2] + j * how[4]))
            v = int(np.floor(how[1] + i * how[3] + j * how[5]))
            if u < 0 or v < 0 or u >= wide or v >= high:
                continue
            word = int(cells[v, u])
            size = min(abs(word), left)
            said[j, i] += size if word > 0 else -size
            heard[j, i] += size
            used += size
    return used


def affine(patch: Patch, T_map_submap: Array, tile: Tile, resolution: float) -> Array:
    """The ``how`` of :func:`lay_under`: cells of the tile to cells of the patch."""
    x, y = tile[0] * SIDE + 0.5, tile[1] * SIDE + 0.5
    if np.array_equal(T_map_submap, patch.T_map_submap):
        return np.array((x - patch.corner[0], y - patch.corner[1], 1.0, 0.0, 0.0, 1.0))
    back = se2.inverse(patch.moved(T_map_submap))
    c, s = math.cos(back[2]), math.sin(back[2])
    u = c * x - s * y + back[0] / resolution - patch.corner[0]
    v = s * x + c * y + back[1] / resolution - patch.corner[1]
    return np.array((u, v, c, s, -s, c))


def compose(
    tiles: Sequence[Tile], newest_first: Iterable[tuple[int, Patch, Array, frozenset[Tile]]], resolution: float
) -> tuple[dict[Tile, Cells], dict[tuple[int, Tile], int]]:
    """Combined cells of these tiles from patches (key, patch, T_map_submap, tiles), and how much of each counts."""
    said = {tile: np.zeros((SIDE, SIDE), np.int16) for tile in tiles}
    heard = {tile: np.zeros((SIDE, SIDE), np.int16) for tile in tiles}
    used = {}
    for key, patch, T, touched in newest_first:
        here = touched.intersection(tiles)
        if not here:
            continue
        cells = patch.cells()
        for tile in here:
            how = affine(patch, T, tile, resolution)
            used[key, tile] = lay_under(said[tile], heard[tile], cells, how)
    return {tile: words.astype(np.int8) for tile, words in said.items()}, used

"""Import of an occupancy map as submaps for localisation: surfaces with their directions, and free space.

Walls become line elements: a line is fitted to the faces of occupied cells with the same orientation. This gives a
position to a fraction of a cell. Free space is what a robot would have seen: simulated scans of :data:`BEAMS` beams
from positions all over the free area. Each square of :data:`PIECE_M` becomes a submap of what is visible from within
it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Keyframe, Settled, Submap
from estimator.mapping.map_snapshot import Identity, MapImage, Piece
from estimator.measurements import Beam
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel
from estimator.scan_matching.local_map import NX, NY, SEEN, SLOPE, UNPROVED, WEIGHT, WIDTH, X, Y

Cells = npt.NDArray[np.int8]
"""(rows, columns), row 0 has the smallest y: :data:`OCCUPIED`, :data:`FREE`, or :data:`UNKNOWN`."""

OCCUPIED, FREE, UNKNOWN = 1, 0, -1
PIECE_M, EYE_M = 3.0, 1.5
"""Side (m) of the squares that become a submap, and of the squares with one simulated scan each."""
CLEAR_M: Final = 0.2
"""Smallest clearance of a simulated scan's position, m."""
BEAMS: Final = 720
FAR_M: Final = 30.0
REACH_M: Final = 0.2
"""Distance (m) of the faces in one line, at least three cells."""
FEW: Final = 4
"""Fewest faces of a line; a surface of fewer than twice as many has little weight until it is seen."""
JOINT: Final = np.diag((0.005**2, 0.005**2, math.radians(0.05) ** 2))
"""Covariance of neighbouring submaps: the map's cells have no deformation."""
SIDES: Final = ((0, 1), (0, -1), (1, 0), (-1, 0))
"""Row and column steps towards the free cell in front of a face."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Cells and the surfaces fitted to them.

    Attributes:
        cells: see `Cells`.
        resolution: m per cell.
        lines: (n, 5) x, y, normal x, y and variance of the direction, in the frame of the cells.
        count: number of faces in each.
        line_of: (4, rows, columns) row of ``lines`` for each side of each cell, -1 where there is none.
    """

    cells: Cells
    resolution: float
    lines: Array
    count: npt.NDArray[np.int64]
    line_of: npt.NDArray[np.int64]


def plan_of(cells: Cells, resolution: float) -> Plan:
    """Fit lines to the faces of occupied cells, one side at a time."""
    rows, columns = cells.shape
    line_of = np.full((4, rows, columns), -1, np.int64)
    found, counts, total = [], [], 0
    for side, (down, right) in enumerate(SIDES):
        free = np.zeros(cells.shape, np.bool_)
        ahead = cells[max(0, down) : rows + min(0, down), max(0, right) : columns + min(0, right)] == FREE
        free[max(0, -down) : rows + min(0, -down), max(0, -right) : columns + min(0, -right)] = ahead
        lines, count, at = fitted((cells == OCCUPIED) & free, np.array((right, down), dtype=np.float64), resolution)
        line_of[side, at[:, 0], at[:, 1]] = total + np.arange(len(lines))
        found.append(lines)
        counts.append(count)
        total += len(lines)
    return Plan(cells, resolution, np.vstack(found), np.concatenate(counts), line_of)


def fitted(
    face: npt.NDArray[np.bool_], towards: Array, resolution: float
) -> tuple[Array, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Lines through the faces of one side around each of them, with their counts of faces and (row, column)."""
    at = np.argwhere(face)
    reach = max(3, round(REACH_M / resolution))
    padded = np.pad(face, reach)
    sums = np.zeros((len(at), 6))
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            there = padded[at[:, 0] + reach + down, at[:, 1] + reach + right]
            sums += there[:, None] * np.array((1.0, right, down, right * right, right * down, down * down))
    n = np.maximum(1.0, sums[:, 0])
    mx, my = sums[:, 1] / n, sums[:, 2] / n
    xx, xy, yy = sums[:, 3] / n - mx * mx, sums[:, 4] / n - mx * my, sums[:, 5] / n - my * my
    root = np.hypot(0.5 * (xx - yy), xy)
    along, across = 0.5 * (xx + yy) + root, np.maximum(0.5 * (xx + yy) - root, 1.0 / 12.0)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normal = np.column_stack((-np.sin(angle), np.cos(angle)))
    normal *= np.where(normal @ towards < 0.0, -1.0, 1.0)[:, None]
    good = (n >= FEW) & (across < 0.1 * along) & (normal @ towards > 0.3)
    offset = normal[:, 0] * mx + normal[:, 1] * my
    middle = (at[:, ::-1] + 0.5 + offset[:, None] * normal) * resolution
    slope = across / (n * np.maximum(along, 1e-9))
    return np.column_stack((middle, normal, slope))[good], n[good].astype(np.int64), at[good]


@kernel("void(i8[:, :, ::1], i8, i8, i8, u1[::1])", inner=True)
def mark(line_of: npt.NDArray[np.int64], side: int, row: int, column: int, seen: npt.NDArray[np.uint8]) -> None:
    """Mark the lines of a cell and of its neighbours as seen: beams a few metres away pass between cells."""
    _, rows, columns = line_of.shape
    for a in range(max(0, row - 1), min(rows, row + 2)):
        for b in range(max(0, column - 1), min(columns, column + 2)):
            if line_of[side, a, b] >= 0:
                seen[line_of[side, a, b]] = 1


@kernel(
    "void(i1[:, ::1], f8[::1], Tuple((i8[:, :, ::1], f8[:, ::1])), Tuple((f8[::1], f8[::1], u1[::1])), u1[::1])",
    aside=True,
)
def look(
    cells: Cells,
    eye: Array,
    surfaces: tuple[npt.NDArray[np.int64], Array],
    scan: tuple[Array, Array, npt.NDArray[np.uint8]],
    seen: npt.NDArray[np.uint8],
) -> None:
    """Simulate a lidar scan of the cells from ``eye`` (x, y, resolution): fills in ``scan``, and marks the lines hit.

    A beam ends on the line fitted to the side of the cell that it enters. Where there is none, it ends at the centre of
    the cell. ``surfaces``: ``line_of`` and ``lines`` of a `Plan`. ``seen``: one entry per line.
    """
    line_of, lines = surfaces
    bearing, distance, kind = scan
    rows, columns = cells.shape
    resolution = eye[2]
    ox, oy = eye[0] / resolution, eye[1] / resolution
    for i in range(len(bearing)):
        dx, dy = np.cos(bearing[i]), np.sin(bearing[i])
        side_x, side_y = (1 if dx > 0.0 else 0), (3 if dy > 0.0 else 2)
        column, row = int(np.floor(ox)), int(np.floor(oy))
        next_x = (column + (dx > 0.0) - ox) / dx if dx != 0.0 else np.inf
        next_y = (row + (dy > 0.0) - oy) / dy if dy != 0.0 else np.inf
        kind[i], distance[i] = 2, FAR_M
        while True:
            if next_x < next_y:
                gone, side, other = next_x * resolution, side_x, side_y
                column += 1 if dx > 0.0 else -1
                next_x += abs(1.0 / dx)
            else:
                gone, side, other = next_y * resolution, side_y, side_x
                row += 1 if dy > 0.0 else -1
                next_y += abs(1.0 / dy)
            if gone >= FAR_M:
                break
            if row < 0 or column < 0 or row >= rows or column >= columns or cells[row, column] == UNKNOWN:
                distance[i] = gone
                break
            if cells[row, column] != OCCUPIED:
                continue
            kind[i], distance[i] = 1, gone + 0.5 * resolution
            best = line_of[side, row, column] if line_of[side, row, column] >= 0 else line_of[other, row, column]
            if best >= 0:
                facing = dx * lines[best, 2] + dy * lines[best, 3]
                away = (lines[best, 0] - eye[0]) * lines[best, 2] + (lines[best, 1] - eye[1]) * lines[best, 3]
                if facing < -0.05 and abs(away / facing - gone) < 3.0 * resolution:
                    distance[i] = away / facing
                mark(line_of, side, row, column, seen)
                mark(line_of, other, row, column, seen)
            break


def eyes_of(plan: Plan) -> dict[tuple[int, int], list[Array]]:
    """Positions of the simulated scans, (x, y) in the frame of the cells, by their square of :data:`PIECE_M`."""
    room = max(1, math.ceil(CLEAR_M / plan.resolution))
    taken = np.pad(plan.cells != FREE, room + 1, constant_values=True).astype(np.int64).cumsum(0).cumsum(1)
    rows, columns = plan.cells.shape
    side = 2 * room + 1
    j, i = np.arange(rows)[:, None], np.arange(columns)[None, :]
    near = taken[j + side, i + side] - taken[j, i + side] - taken[j + side, i] + taken[j, i]
    at = np.argwhere(near == 0)
    xy = (at[:, ::-1] + 0.5) * plan.resolution
    square = np.floor(xy / EYE_M).astype(np.int64)
    off = np.hypot(*(xy - (square + 0.5) * EYE_M).T)
    xy = np.ascontiguousarray(xy)
    best: dict[tuple[int, int], int] = {}
    for k in np.argsort(off, kind="stable").tolist():
        best.setdefault((int(square[k, 0]), int(square[k, 1])), k)
    pieces: dict[tuple[int, int], list[Array]] = {}
    for (a, b), k in sorted(best.items()):
        pieces.setdefault((math.floor(a * EYE_M / PIECE_M), math.floor(b * EYE_M / PIECE_M)), []).append(xy[k])
    return pieces


def image_of_cells(cells: Cells, resolution: float, T_map_cells: Array, identity: Identity) -> MapImage:
    """Map image of these cells; ``T_map_cells``: pose of the lower left corner of cell [0, 0] in the map.

    Raises:
        ValueError: it has no walls, or no free position for a robot.
    """
    plan = plan_of(np.ascontiguousarray(cells), resolution)
    squares = eyes_of(plan)
    if not len(plan.lines) or not squares:
        raise ValueError("the map has no free position beside a wall, so localisation in it is impossible")
    bearing = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    pieces: list[Piece] = []
    frames: list[Keyframe] = []
    for key, eyes in enumerate(squares.values(), 1):
        piece, seen = piece_of(plan, (key, len(frames) + 1), eyes, T_map_cells, bearing)
        frames += seen
        pieces.append(piece)
    middle = pieces[len(pieces) // 2].T_map_submap
    return MapImage(
        identity=identity,
        submaps=tuple(pieces),
        constraints=joined(list(squares), pieces),
        frames=tuple(frames),
        T_map_base=middle.copy(),
        P=np.diag((100.0**2, 100.0**2, np.pi**2)),
    )


def piece_of(
    plan: Plan, numbers: tuple[int, int], eyes: Sequence[Array], T_map_cells: Array, bearing: Array
) -> tuple[Piece, list[Keyframe]]:
    """A submap at the first of these positions, of everything visible from them, and the simulated scans.

    ``numbers``: its key, and that of its first keyframe.
    """
    key, first = numbers
    seen = np.zeros(len(plan.lines), np.uint8)
    T_cells_submap = np.array((*eyes[0], 0.0))
    T_map = se2.compose(T_map_cells, T_cells_submap)
    submap = Submap(key, first, T_map, T_map)
    frames = []
    for number, eye in enumerate(eyes, first):
        distance, kind = np.zeros(len(bearing)), np.zeros(len(bearing), np.uint8)
        at = np.array((*eye, plan.resolution))
        look(plan.cells, at, (plan.line_of, plan.lines), (bearing, distance, kind), seen)
        T = se2.compose(T_map_cells, np.array((*eye, 0.0)))
        frames.append(Keyframe(number, submap, T, np.zeros(3), bearing, 0.0, distance.astype(np.float32), kind))
    which = seen != 0
    elements = np.zeros((int(which.sum()), WIDTH))
    elements[:, [X, Y]] = plan.lines[which, :2] - eyes[0]
    elements[:, [NX, NY]] = plan.lines[which, 2:4]
    elements[:, SLOPE] = plan.lines[which, 4]
    elements[:, WEIGHT] = np.where(plan.count[which] >= 2 * FEW, 1.0, UNPROVED)
    elements[:, SEEN] = 1.0
    widest = max(frames, key=lambda frame: int((frame.beam == Beam.HIT).sum()))
    T_submap_witness = se2.between(T_map, widest.T_odom_keyframe)
    witness = Keyframe(widest.key, submap, T_submap_witness, np.zeros(3), bearing, 0.0, widest.range_m, widest.beam)
    sigma = max(0.01, plan.resolution / math.sqrt(12.0))
    settled = Settled(elements.astype(np.float32), witness, sigma)
    return Piece(key, first, T_map, T_map, 0.0, settled, None), frames


def joined(squares: Sequence[tuple[int, int]], pieces: Sequence[Piece]) -> Constraints:
    """Edges of each submap to the next one and to its neighbours above and to the right; the cells give exact poses."""
    number = {square: k for k, square in enumerate(squares)}
    pairs = {(k, k + 1) for k in range(len(pieces) - 1)}
    for (a, b), k in number.items():
        pairs |= {tuple(sorted((k, number[at]))) for at in ((a + 1, b), (a, b + 1)) if at in number}  # type: ignore[misc]  # sorted gives a list of two
    constraints = Constraints()
    for a, b in sorted(pairs):
        T = se2.between(pieces[a].T_map_submap, pieces[b].T_map_submap)
        constraints.add(pieces[a].key, pieces[b].key, T, JOINT, False)
    return constraints

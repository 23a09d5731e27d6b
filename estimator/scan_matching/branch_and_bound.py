"""Exact branch-and-bound correlative scan matching: the poses where a scan fits a map, without a prediction.

The score of a candidate pose is the mean likelihood at the scan's points, from a field of the map. The field at level l
holds the largest likelihood of a window of ``2**l`` cells. So one score there is an upper bound for all ``4**l`` shifts
in the window (Olson: Real-Time Correlative Scan Matching, ICRA 2009; Hess et al.: Real-Time Loop Closure in 2D LIDAR
SLAM, ICRA 2016). Candidates are opened best first. The first at the finest level is the global optimum, and the next
ones follow in order. This reveals ambiguity: a symmetric room has two best poses, and the search returns both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel

Bytes = npt.NDArray[np.uint8]
Nodes = npt.NDArray[np.int32]

Node = tuple[np.int32, np.int32, np.int32, np.int32]
"""Level, column, row, heading."""

LEVELS = 8
"""Levels of the pyramid: windows of up to 128 cells."""

SPREAD = 3.0
"""Radius of a point's likelihood, in sigmas of the field."""


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """Search region, if not everywhere: the sensor within ``reach_m`` (each axis) and ``reach_rad`` of a pose."""

    T_map_lidar: Array
    reach_m: float
    reach_rad: float


@dataclass(slots=True, eq=False)
class Field:
    """Likelihood field of a map: of a scan's point at each position.

    Attributes:
        pyramid: (levels, rows, columns) uint8, 255 on a surface. Row r, column c is the cell whose lower left corner is
            ``origin + resolution * (c, r)``. At level l it stands for the window of ``2**l`` cells that begins there.
        origin: (x, y) m.
        resolution: m a cell.
    """

    pyramid: Bytes
    origin: Array
    resolution: float


@dataclass(frozen=True, slots=True, eq=False)
class Hit:
    """A pose where the scan fits: the sensor's pose (x, y, yaw) and the mean likelihood there, 0 to 1."""

    T_map_lidar: Array
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Result of a search.

    Attributes:
        hits: best first, no two closer to each other than the settings allow.
        nodes: number of nodes opened.
        complete: False where the cap on nodes ended the search: a better pose may then have been missed.
    """

    hits: tuple[Hit, ...]
    nodes: int
    complete: bool


def field_of(
    points: Array, resolution: float = 0.05, sigma_m: float = 0.05, reach_m: float = 1.0, around: Around | None = None
) -> Field:
    """Likelihood field of a map's surface points (n, 2), over their extent plus ``reach_m`` and the search region.

    Raises:
        ValueError: no points, or points that are not finite.
    """
    if not len(points) or not np.isfinite(points).all():
        raise ValueError(f"a map of {len(points)} points, all of them finite, is needed")
    low, high = points.min(axis=0) - reach_m, points.max(axis=0) + reach_m
    if around is not None:
        low = np.minimum(low, around.T_map_lidar[:2] - around.reach_m)
        high = np.maximum(high, around.T_map_lidar[:2] + around.reach_m)
    width, height = np.ceil((high - low) / resolution).astype(int)
    pyramid = np.zeros((LEVELS, height, width), np.uint8)
    spread(np.ascontiguousarray(points), low, np.array((resolution, sigma_m)), pyramid[0])
    widen(pyramid)
    return Field(pyramid, low, resolution)


@kernel("void(f8[:, ::1], f8[::1], f8[::1], u1[:, ::1])", aside=True)
def spread(points: Array, origin: Array, how: Array, field: Bytes) -> None:
    """Write the Gaussian of the distance to the nearest point, cut off at SPREAD sigmas.

    ``how``: resolution, sigma (m).
    """
    resolution, sigma = how[0], how[1]
    reach = int(np.ceil(SPREAD * sigma / resolution))
    rows, columns = field.shape
    for k in range(len(points)):
        x, y = (points[k, 0] - origin[0]) / resolution, (points[k, 1] - origin[1]) / resolution
        c0, r0 = int(np.floor(x)), int(np.floor(y))
        for r in range(max(0, r0 - reach), min(rows, r0 + reach + 1)):
            for c in range(max(0, c0 - reach), min(columns, c0 + reach + 1)):
                d2 = ((c + 0.5 - x) ** 2 + (r + 0.5 - y) ** 2) * (resolution / sigma) ** 2
                if d2 < SPREAD * SPREAD:
                    field[r, c] = max(field[r, c], int(255.0 * np.exp(-0.5 * d2) + 0.5))


@kernel("void(u1[:, :, ::1])", aside=True)
def widen(pyramid: Bytes) -> None:
    """Fill the levels above the first: each the maximum of four windows half as wide."""
    levels, rows, columns = pyramid.shape
    for level in range(1, levels):
        half = 1 << (level - 1)
        for r in range(rows):
            for c in range(columns):
                best = pyramid[level - 1, r, c]
                if r + half < rows:
                    best = max(best, pyramid[level - 1, r + half, c])
                if c + half < columns:
                    best = max(best, pyramid[level - 1, r, c + half])
                    if r + half < rows:
                        best = max(best, pyramid[level - 1, r + half, c + half])
                pyramid[level, r, c] = best


@kernel("f8(u1[:, :, ::1], i4[:, ::1], i8, i8, i8)", inner=True)
def score_at(pyramid: Bytes, cells: Nodes, level: int, column: int, row: int) -> float:
    """Mean of the field under the points (cells (n, 2) from the sensor) with the sensor in the given window.

    A window below the field's lower edge can still reach into the field. It is read at the edge, which gives an upper
    bound.
    """
    rows, columns = pyramid.shape[1], pyramid.shape[2]
    window = (1 << level) - 1
    total = 0
    for k in range(len(cells)):
        c, r = column + cells[k, 0], row + cells[k, 1]
        if c + window < 0 or r + window < 0 or c >= columns or r >= rows:
            continue
        total += int(pyramid[level, max(r, 0), max(c, 0)])
    return total / (255.0 * len(cells))


@kernel("void(f8[::1], i4[:, ::1], i8, f8, Tuple((i4, i4, i4, i4)))", inner=True)
def push(keys: Array, nodes: Nodes, count: int, key: float, node: Node) -> None:
    """Add to a heap with the largest key on top."""
    i = count
    while i > 0:
        parent = (i - 1) >> 1
        if keys[parent] >= key:
            break
        keys[i] = keys[parent]
        for c in range(4):
            nodes[i, c] = nodes[parent, c]
        i = parent
    keys[i] = key
    nodes[i, 0], nodes[i, 1], nodes[i, 2], nodes[i, 3] = node


@kernel("void(f8[::1], i4[:, ::1], i8)", inner=True)
def pop(keys: Array, nodes: Nodes, count: int) -> None:
    """Remove the top of a heap of ``count`` entries."""
    last = count - 1
    key = keys[last]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= last:
            break
        if child + 1 < last and keys[child + 1] > keys[child]:
            child += 1
        if keys[child] <= key:
            break
        keys[i] = keys[child]
        for c in range(4):
            nodes[i, c] = nodes[child, c]
        i = child
    keys[i] = key
    for c in range(4):
        nodes[i, c] = nodes[last, c]


@kernel("b1(f8[:, ::1], i8, UniTuple(i4, 4), i8, f8[::1])", inner=True)
def near_hit(found: Array, hits: int, node: Node, headings: int, how: Array) -> bool:
    """Whether all of a node's window is close to a better hit."""
    level, column, row, h = node
    window = (1 << level) - 1
    for k in range(hits):
        turn = abs(h - found[k, 2])
        turn = min(turn, headings - turn)
        far = max(
            max(abs(column - found[k, 0]), abs(column + window - found[k, 0])),
            max(abs(row - found[k, 1]), abs(row + window - found[k, 1])),
        )
        if turn <= how[3] and far <= how[2]:
            return True
    return False


@kernel("Tuple((i8, i8, b1))(u1[:, :, ::1], i4[:, :, ::1], i8[::1], f8[::1], f8[:, ::1])", aside=True)
def branch(pyramid: Bytes, turned: Nodes, box: Ints, how: Array, found: Array) -> tuple[int, int, bool]:
    """Best-first search; returns the number of hits, the nodes opened, and whether the search is complete.

    ``turned``: (headings, points, 2) cells of the scan at each heading. ``box``: first and last column, first and last
    row of the sensor, and 1 if the headings cover the full circle. ``how``: smallest score, cap on nodes, distance of
    one hit in cells and headings, smallest share of the best score. ``found``: rows of column, row, heading, score.
    """
    headings, top = len(turned), pyramid.shape[0] - 1
    step = 1 << top
    around = headings if box[4] else 1 << 60
    capacity = headings * ((box[1] - box[0]) // step + 1) * ((box[3] - box[2]) // step + 1) + 1024
    keys, nodes = np.empty(capacity), np.empty((capacity, 4), np.int32)
    count = opened = hits = 0
    for h in range(headings):
        for c in range(box[0], box[1] + 1, step):
            for r in range(box[2], box[3] + 1, step):
                score = score_at(pyramid, turned[h], top, c, r)
                opened += 1
                if score >= how[0]:
                    push(keys, nodes, count, score, (np.int32(top), np.int32(c), np.int32(r), np.int32(h)))
                    count += 1
    while count > 0 and hits < len(found):
        if opened > how[1]:
            return hits, opened, False
        score, level, column, row, h = keys[0], nodes[0, 0], nodes[0, 1], nodes[0, 2], nodes[0, 3]
        if hits > 0 and score < how[4] * found[0, 3]:
            return hits, opened, True
        pop(keys, nodes, count)
        count -= 1
        if near_hit(found, hits, (level, column, row, h), around, how):
            continue
        if level == 0:
            found[hits, 0], found[hits, 1], found[hits, 2], found[hits, 3] = column, row, h, score
            hits += 1
            continue
        if count + 4 > len(keys):
            keys = np.concatenate((keys, np.empty(len(keys))))
            nodes = np.concatenate((nodes, np.empty((len(nodes), 4), np.int32)))
        half = 1 << (level - 1)
        for part in range(4):
            c, r = column + half * (part & 1), row + half * (part >> 1)
            if c > box[1] or r > box[3]:
                continue
            opened += 1
            score = score_at(pyramid, turned[h], level - 1, c, r)
            if score >= how[0]:
                push(keys, nodes, count, score, (np.int32(level - 1), np.int32(c), np.int32(r), np.int32(h)))
                count += 1
    return hits, opened, True


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Settings of a search.

    Attributes:
        least: smallest score of a hit.
        ratio: the same, as a share of the best score.
        hits: most hits returned.
        nodes: most nodes opened.
        apart_m, apart_rad: hits closer than this in both are one.
        points: most points of the scan.
        heading_rad: step of the headings; 0: the step that moves the farthest point by a cell.
        around: search region; everywhere and at every heading if None.
    """

    least: float = 0.4
    ratio: float = 0.0
    hits: int = 4
    nodes: int = 20_000_000
    apart_m: float = 0.5
    apart_rad: float = 0.3
    points: int = 120
    heading_rad: float = 0.0
    around: Around | None = None


def search(field: Field, points: Array, settings: SearchSettings = SearchSettings()) -> Search:
    """The poses in the field where a scan's points (n, 2), in the sensor's frame, fit best.

    Raises:
        ValueError: no points.
    """
    if not len(points):
        raise ValueError("a scan without points fits everywhere")
    few = points[:: -(-len(points) // settings.points)]
    far = float(np.hypot(few[:, 0], few[:, 1]).max())
    step = settings.heading_rad or max(0.005, field.resolution / max(far, field.resolution))
    count = int(np.ceil(2.0 * np.pi / step))
    step = 2.0 * np.pi / count
    box = np.array((0, field.pyramid.shape[2] - 1, 0, field.pyramid.shape[1] - 1, 1))
    yaw = np.asarray(step * np.arange(count), np.float64)
    if settings.around is not None:
        box, yaw = _boxed(field, settings.around, step)
    if box[1] < box[0] or box[3] < box[2]:
        return Search((), 0, True)
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    turned = np.stack((c * few[:, 0] - s * few[:, 1], s * few[:, 0] + c * few[:, 1]), axis=2)
    # the sensor is at the centre of its cell
    cells = np.floor(turned / field.resolution + 0.5).astype(np.int32)
    found = np.empty((settings.hits, 4))
    apart = (settings.apart_m / field.resolution, settings.apart_rad / step)
    how = np.array((settings.least, float(settings.nodes), *apart, settings.ratio))
    hits, nodes, complete = branch(field.pyramid, np.ascontiguousarray(cells), box, how, found)
    return Search(tuple(_hit(field, row, yaw) for row in found[:hits]), int(nodes), bool(complete))


def _boxed(field: Field, around: Around, step: float) -> tuple[Ints, Array]:
    """Cells of the sensor's position, and headings, within the search region."""
    x, y, heading = around.T_map_lidar.tolist()
    low = np.floor((np.array((x, y)) - around.reach_m - field.origin) / field.resolution).astype(np.int64)
    high = np.floor((np.array((x, y)) + around.reach_m - field.origin) / field.resolution).astype(np.int64)
    rows, columns = field.pyramid.shape[1:]
    box = (max(0, int(low[0])), min(columns - 1, int(high[0])), max(0, int(low[1])), min(rows - 1, int(high[1])))
    k = int(np.ceil(around.reach_rad / step))
    whole = (2 * k + 1) * step >= 2.0 * np.pi
    turns = np.arange(int(np.ceil(2.0 * np.pi / step))) if whole else np.arange(-k, k + 1)
    return np.array((*box, int(whole))), heading + step * turns


def _hit(field: Field, row: Array, yaw: Array) -> Hit:
    x, y = field.origin + field.resolution * (row[:2] + 0.5)
    return Hit(np.array((x, y, (yaw[int(row[2])] + np.pi) % (2.0 * np.pi) - np.pi)), float(row[3]))

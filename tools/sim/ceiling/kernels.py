"""Kernels of the ceiling: what a photodiode gets of each lamp directly, past obstacles, and by way of the walls.

All kernels of the ceiling are in this one file, because the compiler's cache does not notice an edited callee in
another. Nothing here is shared with the estimator but the decorator.

Obstacle rows: ``kind, a, b, c, d, low, top, clear``. Kind 0: segment from (a, b) to (c, d); 1: upright cylinder about
(a, b) of radius c; 2: box from (a, b) to (c, d). They reach from ``low`` to ``top`` and let ``clear`` of 1 through.
"""

from __future__ import annotations

from math import acos, atan2, fabs, pi, sqrt
from typing import Any, Final

import numpy as np

from estimator.numerics.jit import kernel

LAMP_COLUMNS: Final = 14
"""x, y, z, three rows of the rotation into the lamp's frame (its third axis points where it shines), radius, reach."""
SIGHT_COLUMNS: Final = 9
"""x, y, z of a photodiode, its axis, and its own x axis, which is at right angles to it."""
COLUMN_COLUMNS: Final = 8
"""x, y of a wall column's foot, normal x, y, length, reflectance, top, unused."""

LAMPS: Final = "Tuple((f8[:,::1], f8[:,:,::1], f8[:,::1]))"
"""Lamps, emission tables by lamp (angle from axis, azimuth), acceptance table (angle from axis, azimuth)."""
OBSTACLES: Final = "Tuple((f8[:,::1], i4[::1], i4[::1]))"
"""Rows, and compressed rows of numbers of those that may stand in the way of each lamp."""
COLUMNS: Final = "Tuple((f8[:,::1], f8[::1], f8[:,::1]))"
"""Wall columns, heights of the patches' middles, exitance of each patch (W per m^2 for a lamp of 1 W)."""


@kernel("f8(f8[:,::1], f8, f8)")
def look_up(table: Any, angle: Any, azimuth: Any) -> Any:
    """Bilinear: rows from 0 to 90 degrees, columns once round; 0 beyond 90 degrees."""
    row = angle * (2.0 / pi) * (table.shape[0] - 1)
    if row >= table.shape[0] - 1:
        return 0.0
    column = (azimuth / (2.0 * pi)) % 1.0 * table.shape[1]
    i, j = int(row), int(column) % table.shape[1]
    k = (j + 1) % table.shape[1]
    u, v = row - i, column - int(column)
    near = (1.0 - v) * table[i, j] + v * table[i, k]
    far = (1.0 - v) * table[i + 1, j] + v * table[i + 1, k]
    return (1.0 - u) * near + u * far


@kernel("f8(f8[::1], f8[::1], f8[:,::1], i8)")
def past_segment(here: Any, lamp: Any, rows: Any, n: Any) -> Any:
    """Share of the light that passes a wall, pane or low partition."""
    dx, dy = lamp[0] - here[0], lamp[1] - here[1]
    ex, ey = rows[n, 3] - rows[n, 1], rows[n, 4] - rows[n, 2]
    cross = dx * ey - dy * ex
    if fabs(cross) < 1e-12:
        return 1.0
    wx, wy = rows[n, 1] - here[0], rows[n, 2] - here[1]
    u = (wx * ey - wy * ex) / cross
    v = (wx * dy - wy * dx) / cross
    if u <= 0.0 or u >= 1.0 or v < 0.0 or v > 1.0:
        return 1.0
    z = here[2] + u * (lamp[2] - here[2])
    return rows[n, 7] if rows[n, 5] <= z <= rows[n, 6] else 1.0


@kernel("f8(f8[::1], f8[::1], f8[:,::1], i8)")
def past_cylinder(here: Any, lamp: Any, rows: Any, n: Any) -> Any:
    """Share of the light that passes a person or column; a lamp has a size, so the shadow has a soft edge."""
    dx, dy, dz = lamp[0] - here[0], lamp[1] - here[1], lamp[2] - here[2]
    ahead = dx * dx + dy * dy
    wx, wy = rows[n, 1] - here[0], rows[n, 2] - here[1]
    first, last = max((rows[n, 5] - here[2]) / dz, 0.0), min((rows[n, 6] - here[2]) / dz, 1.0)
    if first > last:
        return 1.0
    u = (wx * dx + wy * dy) / ahead if ahead > 1e-12 else 0.0
    u = min(max(u, first), last)
    distance = sqrt((u * dx - wx) ** 2 + (u * dy - wy) ** 2)
    blur = 2.0 * u * lamp[12] + 1e-9
    covered = min(max(0.5 + (rows[n, 3] - distance) / blur, 0.0), 1.0)
    return 1.0 - covered * (1.0 - rows[n, 7])


@kernel("f8(f8[::1], f8[::1], f8[:,::1], i8)")
def past_box(here: Any, lamp: Any, rows: Any, n: Any) -> Any:
    """Share of the light that passes a box: shelves with what is on them."""
    first, last = 0.0, 1.0
    for axis in range(3):
        low, high = rows[n, 1 + axis], rows[n, 3 + axis]
        if axis == 2:
            low, high = rows[n, 5], rows[n, 6]
        step = lamp[axis] - here[axis]
        if fabs(step) < 1e-12:
            if here[axis] < low or here[axis] > high:
                return 1.0
            continue
        a, b = (low - here[axis]) / step, (high - here[axis]) / step
        first, last = max(first, min(a, b)), min(last, max(a, b))
    return rows[n, 7] if first < last else 1.0


@kernel("f8(f8[::1], f8[::1], f8[:,::1], i8)")
def past(here: Any, lamp: Any, rows: Any, n: Any) -> Any:
    """Share of the light that passes obstacle ``n`` on its way from the lamp."""
    if rows[n, 0] == 0.0:
        return past_segment(here, lamp, rows, n)
    if rows[n, 0] == 1.0:
        return past_cylinder(here, lamp, rows, n)
    return past_box(here, lamp, rows, n)


@kernel("f8(f8[:,::1], f8[::1], f8, f8, f8)")
def emitted(table: Any, lamp: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Intensity (W/sr for 1 W) of a lamp into a unit direction."""
    u = lamp[3] * dx + lamp[4] * dy + lamp[5] * dz
    v = lamp[6] * dx + lamp[7] * dy + lamp[8] * dz
    w = lamp[9] * dx + lamp[10] * dy + lamp[11] * dz
    return look_up(table, acos(min(max(w, -1.0), 1.0)), atan2(v, u))


@kernel("f8(f8[:,::1], f8[::1], f8, f8, f8)")
def accepted(table: Any, sight: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """What the photodiode makes of light from a unit direction, cosine included; 1 on its axis."""
    w = sight[3] * dx + sight[4] * dy + sight[5] * dz
    if w <= 0.0:
        return 0.0
    u = sight[6] * dx + sight[7] * dy + sight[8] * dz
    cx = sight[4] * sight[8] - sight[5] * sight[7]
    cy = sight[5] * sight[6] - sight[3] * sight[8]
    cz = sight[3] * sight[7] - sight[4] * sight[6]
    v = cx * dx + cy * dy + cz * dz
    return look_up(table, acos(min(w, 1.0)), atan2(v, u))


@kernel(f"void(f8[:,::1], {LAMPS}, {OBSTACLES}, f8[:,:,::1], f8[:,::1])")
def direct(sights: Any, ceiling: Any, obstacles: Any, movers: Any, out: Any) -> None:
    """Direct light: irradiance (1/m^2) at each sight for each lamp of 1 W, weighted with the acceptance.

    Args:
        sights: (n, 9) see :data:`SIGHT_COLUMNS`.
        ceiling: see :data:`LAMPS`.
        obstacles: see :data:`OBSTACLES`.
        movers: (n or 1, k, 8) obstacles at the instant of each sight.
        out: (n, lamps).
    """
    lamps, emission, acceptance = ceiling
    rows, start, items = obstacles
    for i in range(sights.shape[0]):
        sight = sights[i]
        moving = movers[min(i, movers.shape[0] - 1)]
        for k in range(lamps.shape[0]):
            out[i, k] = 0.0
            lamp = lamps[k]
            dx, dy, dz = lamp[0] - sight[0], lamp[1] - sight[1], lamp[2] - sight[2]
            square = dx * dx + dy * dy
            if square > lamp[13] * lamp[13] or dz <= 0.0:
                continue
            square += dz * dz
            norm = sqrt(square)
            dx, dy, dz = dx / norm, dy / norm, dz / norm
            value = accepted(acceptance, sight, dx, dy, dz)
            if value <= 0.0:
                continue
            value *= emitted(emission[k], lamp, -dx, -dy, -dz) / square
            for at in range(start[k], start[k + 1]):
                value *= past(sight, lamp, rows, items[at])
                if value == 0.0:
                    break
            for n in range(moving.shape[0]):
                value *= past(sight, lamp, moving, n)
            out[i, k] = value


@kernel("f8(f8, f8, f8, f8, f8[:,::1])")
def open_way(ax: Any, ay: Any, bx: Any, by: Any, rows: Any) -> Any:
    """Share of light that passes in plan, standing walls and columns only."""
    here, lamp = np.zeros(3), np.zeros(14)
    here[0], here[1], here[2] = ax, ay, 1.0
    lamp[0], lamp[1], lamp[2] = bx, by, 1.0 + 1e-6
    share = 1.0
    for n in range(rows.shape[0]):
        share *= past(here, lamp, rows, n)
        if share == 0.0:
            break
    return share


@kernel("void(f8[:,::1], f8[:,::1], f8[:,::1], f4[:,::1])")
def see_columns(points: Any, columns: Any, rows: Any, out: Any) -> None:
    """How freely each of (n, 2) points sees each wall column's front; out (n, columns)."""
    for i in range(points.shape[0]):
        for k in range(columns.shape[0]):
            px, py = columns[k, 0] + 0.01 * columns[k, 2], columns[k, 1] + 0.01 * columns[k, 3]
            before = (points[i, 0] - px) * columns[k, 2] + (points[i, 1] - py) * columns[k, 3]
            out[i, k] = open_way(points[i, 0], points[i, 1], px, py, rows) if before > 0.0 else 0.0


@kernel("void(f8[::1], f8[:,::1], f4[::1], f8[:,::1], f8[::1], f8[:,::1])")
def light_up(lamp: Any, table: Any, seen: Any, columns: Any, heights: Any, out: Any) -> None:
    """Exitance (W/m^2 for a lamp of 1 W) of each wall patch after one reflection; out (columns, heights)."""
    for k in range(columns.shape[0]):
        for j in range(heights.shape[0]):
            out[k, j] = 0.0
            if seen[k] == 0.0 or heights[j] > columns[k, 6]:
                continue
            dx, dy, dz = columns[k, 0] - lamp[0], columns[k, 1] - lamp[1], heights[j] - lamp[2]
            square = max(dx * dx + dy * dy + dz * dz, 0.01)
            norm = sqrt(square)
            lean = -(dx * columns[k, 2] + dy * columns[k, 3]) / norm
            if lean > 0.0:
                shine = emitted(table, lamp, dx / norm, dy / norm, dz / norm)
                out[k, j] = seen[k] * columns[k, 5] * shine * lean / square


@kernel(f"void({COLUMNS}, f4[:,::1], f8, f8[:,::1])")
def exchange(walls: Any, seen: Any, patch_m: Any, out: Any) -> None:
    """Exitance after one more reflection from wall to wall.

    Args:
        walls: see :data:`COLUMNS`.
        seen: (columns, columns).
        patch_m: height of a patch.
        out: (columns, heights).
    """
    columns, heights, exitance = walls
    for k in range(columns.shape[0]):
        for j in range(heights.shape[0]):
            total = 0.0
            for a in range(columns.shape[0]):
                if seen[k, a] == 0.0:
                    continue
                dx, dy = columns[a, 0] - columns[k, 0], columns[a, 1] - columns[k, 1]
                lean = dx * columns[k, 2] + dy * columns[k, 3]
                back = -(dx * columns[a, 2] + dy * columns[a, 3])
                if lean <= 0.0 or back <= 0.0:
                    continue
                area = columns[a, 4] * patch_m / pi * seen[k, a] * lean * back
                for b in range(heights.shape[0]):
                    square = dx * dx + dy * dy + (heights[b] - heights[j]) ** 2
                    total += exitance[a, b] * area / max(square * square, 1e-3)
            out[k, j] = columns[k, 5] * total if heights[j] <= columns[k, 6] else 0.0


@kernel(f"void(f8[:,::1], {COLUMNS}, f4[:,::1], f8[:,::1], f8[::1])")
def gather(points: Any, walls: Any, seen: Any, acceptance: Any, out: Any) -> None:
    """Irradiance at level photodiodes from wall patches, weighted with the acceptance (its azimuths averaged).

    Args:
        points: (n, 4) x, y, z, height of a patch.
        walls: see :data:`COLUMNS`.
        seen: (n, columns).
        acceptance: (angles, 1).
        out: (n,).
    """
    columns, heights, exitance = walls
    for i in range(points.shape[0]):
        total = 0.0
        for k in range(columns.shape[0]):
            if seen[i, k] == 0.0:
                continue
            dx, dy = columns[k, 0] - points[i, 0], columns[k, 1] - points[i, 1]
            back = -(dx * columns[k, 2] + dy * columns[k, 3])
            if back <= 0.0:
                continue
            area = columns[k, 4] * points[i, 3] / pi * seen[i, k] * back
            for j in range(heights.shape[0]):
                dz = heights[j] - points[i, 2]
                if dz <= 0.0 or exitance[k, j] == 0.0:
                    continue
                square = dx * dx + dy * dy + dz * dz
                norm = sqrt(square)
                total += exitance[k, j] * area / (norm * max(square, 0.01)) * look_up(acceptance, acos(dz / norm), 0.0)
        out[i] = total

"""Map image rendering: grid dark on white, the trajectory coloured from start to end, lamps and a scale bar.

Ceiling lamps are drawn as rings filled with yellow, with their numbers, if the map is in the survey frame. The colours
of the trajectory suit colour-blind readers. :func:`picture` adds axes in metres of the map frame, and a legend.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps.drawing.axes import Entry, framed
from daemon.maps.drawing.font import word, write
from estimator import Array, Grid

Pixels = npt.NDArray[np.float64]

SMALLEST_SIDE: Final = 1200
"""Cells are enlarged until the longer side has about this many pixels."""

UNKNOWN: Final = np.array((205.0, 211.0, 220.0))
FREE: Final = np.array((255.0, 255.0, 255.0))
WALL: Final = np.array((28.0, 34.0, 48.0))
PATH: Final = np.array(((0, 90, 181), (170, 51, 119), (230, 120, 0)), dtype=np.float64)
"""Path colours from start to end: blue, purple, orange."""

START: Final = PATH[0]
END: Final = PATH[-1]
LAMP: Final = np.array((250.0, 204.0, 21.0))
_LAMP_PX: Final = 6.0
_RING_PX: Final = 2.0
_LINE_PX: Final = 1.2
_JUMP_M: Final = 0.5
_JUMP_TIMES: Final = 8.0
"""No line is drawn between two positions farther apart than this, and than this many typical steps. The robot was
carried there or found elsewhere."""
_DOT_PX: Final = 7.0
_BAR_PX: Final = 3.0
_NUMBER: Final = 2
"""Column of a lamp's number."""
_BAND: Final = 64
"""Rows of cells that are drawn at a time."""

Discs = tuple[Array, Pixels, float]
"""Positions (n, 2) in pixels, colours (n, 3) and radius."""


def draw(grid: Grid, path: Array, lamps: Array | None = None) -> npt.NDArray[np.uint8]:
    """RGB pixels (rows, columns, 3), top row first.

    Args:
        grid: the map.
        path: (n, 2 or more) positions in the map frame in order of time, metres; n may be 0.
        lamps: (k, 2 or 3) positions of lamps in the map frame, and their numbers; those beyond the map's edge are not
            drawn.
    """
    probability = grid.probability[::-1]
    if probability.size == 0:
        return np.broadcast_to(UNKNOWN, (16, 16, 3)).astype(np.uint8)
    rows, columns = probability.shape
    scale = max(1, round(SMALLEST_SIDE / max(rows, columns)))
    discs = _discs(grid, path, lamps, scale)
    pixels = np.empty((scale * rows, scale * columns, 3), np.uint8)
    for first in range(0, rows, _BAND):  # the intermediate arrays take twenty times the memory of the image
        band = _shade(probability[first : first + _BAND].repeat(scale, axis=0).repeat(scale, axis=1))
        top = scale * first
        for places, colours, radius in discs:
            _stamp(band, places - (top, 0.0), colours, radius)
        pixels[top : top + len(band)] = np.rint(band)
    if lamps is not None and lamps.shape[1] > _NUMBER:
        _draw_numbers(pixels, _to_pixels(grid, lamps, scale, scale * rows), lamps[:, _NUMBER])
    _draw_bar(pixels, scale / grid.resolution)
    return pixels


def picture(grid: Grid, path: Array, lamps: Array | None = None) -> npt.NDArray[np.uint8]:
    """The same as :func:`draw`, with axes and legend."""
    image = draw(grid, path, lamps)
    if grid.log_odds.size == 0:
        return image
    pixels_per_metre = image.shape[1] / (grid.log_odds.shape[1] * grid.resolution)
    legend = [Entry(START, "start"), Entry(END, "end")] if len(path) else []
    if lamps is not None and len(lamps):
        legend.append(Entry(LAMP, "lamp with its number" if lamps.shape[1] > _NUMBER else "lamp"))
    legend += [Entry(WALL, "wall"), Entry(FREE, "free"), Entry(UNKNOWN, "unknown")]
    return framed(image, (float(grid.origin[0]), float(grid.origin[1])), pixels_per_metre, legend)


def near(grid: Grid, path: Array, margin_m: float | None) -> Grid:
    """The part of the grid no farther from a path than ``margin_m`` along x and y; all of it without a path or margin.

    ``path``: (n, 2 or more) m in the map frame.
    """
    if margin_m is None or len(path) == 0 or grid.log_odds.size == 0:
        return grid
    low, high = path[:, :2].min(axis=0) - margin_m, path[:, :2].max(axis=0) + margin_m
    size = np.array(grid.log_odds.shape[::-1])
    first = np.clip(np.floor((low - grid.origin) / grid.resolution).astype(np.int64), 0, size)
    last = np.clip(np.ceil((high - grid.origin) / grid.resolution).astype(np.int64), 0, size)
    if (last <= first).any():
        return grid
    part = grid.log_odds[first[1] : last[1], first[0] : last[0]]
    return replace(grid, origin=grid.origin + first * grid.resolution, log_odds=part)


def _shade(probability: npt.NDArray[np.float32]) -> Pixels:
    """Pixel shades of an occupancy probability: one half is unknown, lower is free, higher is occupied."""
    certain = 2.0 * probability[..., None].astype(np.float64) - 1.0
    goal = np.where(certain > 0.0, WALL, FREE)
    return np.asarray(UNKNOWN + np.abs(certain) * (goal - UNKNOWN))


def _to_pixels(grid: Grid, path: Array, scale: int, rows: int) -> Array:
    """Pixel coordinates (row, column) of positions."""
    cells = (path[:, :2] - grid.origin) / grid.resolution * scale
    return np.stack([rows - cells[:, 1], cells[:, 0]], axis=1)


def _discs(grid: Grid, path: Array, lamps: Array | None, scale: int) -> list[Discs]:
    """Discs drawn over the map, the lowest layer first."""
    rows = scale * len(grid.log_odds)
    discs: list[Discs] = []
    if lamps is not None and len(lamps) > 0:
        at = _to_pixels(grid, lamps, scale, rows)
        discs.append((at, np.tile(WALL, (len(at), 1)), _LAMP_PX + _RING_PX))
        discs.append((at, np.tile(LAMP, (len(at), 1)), _LAMP_PX))
    places = _to_pixels(grid, path, scale, rows)
    return discs + _line(places, scale / grid.resolution) if len(places) > 0 else discs


def _line(places: Array, pixels_per_metre: float) -> list[Discs]:
    """The path as dense soft dots with a larger dot at either end; nothing where the robot was carried."""
    steps = np.hypot(*np.diff(places, axis=0).T) if len(places) > 1 else np.zeros(0)
    driven = steps[steps > 0.01 * pixels_per_metre]
    ordinary = float(np.percentile(driven, 90.0)) if len(driven) else 0.0
    carried = steps > max(_JUMP_M * pixels_per_metre, _JUMP_TIMES * ordinary)
    along = np.concatenate([[0.0], np.cumsum(np.where(carried, 1e-9, steps))])
    count = max(2, int(along[-1] * 1.5))
    wanted = np.linspace(0.0, along[-1], count)
    dense = np.stack([np.interp(wanted, along, places[:, axis]) for axis in (0, 1)], axis=1)
    shades = np.linspace(0.0, len(PATH) - 1.0, count)
    colours = np.stack([np.interp(shades, np.arange(len(PATH)), PATH[:, c]) for c in range(3)], axis=1)
    return [
        (dense, colours, _LINE_PX),
        (places[:1], START[None], _DOT_PX),
        (places[-1:], END[None], _DOT_PX),
    ]


def _stamp(pixels: Pixels, places: Array, colours: Pixels, radius: float) -> None:
    """Blend a soft-edged disc of ``radius`` pixels at each position; a pixel takes the colour of its last disc."""
    reach = int(np.ceil(radius)) + 1
    rows, columns = pixels.shape[:2]
    near = (places[:, 0] > -reach - 1) & (places[:, 0] < rows + reach + 1)
    if not near.any():
        return
    places, colours = places[near], colours[near]
    centre = np.floor(places).astype(np.int64)
    cover = np.zeros((rows, columns))
    paint = np.zeros((rows, columns, 3))
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            r, c = centre[:, 0] + down, centre[:, 1] + right
            distance = np.hypot(r + 0.5 - places[:, 0], c + 0.5 - places[:, 1])
            strength = np.clip(radius + 0.5 - distance, 0.0, 1.0)
            seen = (strength > 0.0) & (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
            np.maximum.at(cover, (r[seen], c[seen]), strength[seen])
            paint[r[seen], c[seen]] = colours[seen]
    pixels += cover[..., None] * (paint - pixels)


def _draw_numbers(pixels: npt.NDArray[np.uint8], places: Array, numbers: Array) -> None:
    """Write the number of each lamp beside it, dark on a white rim."""
    for (row, column), number in zip(places, numbers, strict=True):
        ink = word(str(int(number)))
        top, left = round(row) - ink.shape[0], round(column + _LAMP_PX + 2 * _RING_PX)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                write(pixels, ink, top + down, left + right, FREE)
        write(pixels, ink, top, left, WALL)


def _draw_bar(pixels: npt.NDArray[np.uint8], pixels_per_metre: float) -> None:
    """Draw a scale bar in the lower left corner, the longest of 1, 5, 10, 50, 100 m that takes at most a third."""
    rows, columns = pixels.shape[:2]
    length = next((m for m in (100, 50, 10, 5, 1) if m * pixels_per_metre <= columns / 3), 0)
    margin = round(4 * _BAR_PX)
    if length == 0 or rows <= 3 * margin:
        return
    end = margin + round(length * pixels_per_metre)
    bottom = rows - margin
    pixels[bottom - round(_BAR_PX) : bottom, margin:end] = WALL
    ink = word(f"{length} m")
    top = bottom - round(4 * _BAR_PX) - len(ink)
    if top >= 0 and margin + ink.shape[1] <= columns:
        write(pixels, ink, top, margin, WALL)
    for tick in np.linspace(margin, end - 1, (length if length <= 10 else 10) + 1):
        column = round(float(tick))
        pixels[bottom - round(3 * _BAR_PX) : bottom, column : column + 1] = WALL

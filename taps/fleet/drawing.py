"""Draws the fleet on one map, as text for a terminal or as an image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from taps.fleet.messages import Cells, printable
from taps.fleet.roster import Chart, Member, number
from taps.stream.tiles import FREE, UNSEEN, WALL

LABELS: Final = "123456789abcdefghijklmnopqrstuvwxyz"
TALL: Final = 2.0
"""Height of a character over its width."""
SMALLEST_SIDE: Final = 800
"""Cells are enlarged until the longer side has about this many pixels."""
DISC_PX: Final = 9
WIDEST: Final = 200
"""Most characters in a cell of the table."""
SHADES: Final = {UNSEEN: (205, 211, 220), FREE: (255, 255, 255), WALL: (28, 34, 48)}
COLOURS: Final = (
    ("blue", (37, 99, 235)),
    ("red", (220, 38, 38)),
    ("green", (16, 185, 129)),
    ("amber", (245, 158, 11)),
    ("violet", (139, 92, 246)),
    ("cyan", (6, 182, 212)),
    ("pink", (236, 72, 153)),
)
HEADS: Final = ("", "robot", "state", "x m", "y m", "deg", "bound m", "map", "survey", "age s", "said")


def table(members: Sequence[Member], now: float) -> list[str]:
    """The table of robots: a header and a line for each."""
    cells = (_row(label_of(k), member, now) for k, member in enumerate(members))
    rows = [HEADS, *(tuple(printable(cell[:WIDEST]) for cell in row) for row in cells)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEADS))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def label_of(place: int) -> str:
    """One-character label of a robot; the last label is shared."""
    return LABELS[min(place, len(LABELS) - 1)]


def _row(label: str, member: Member, now: float) -> tuple[str, ...]:
    place, state = member.place, member.state
    x, y, theta = (
        ("-",) * 3 if place is None else (f"{place[0]:.2f}", f"{place[1]:.2f}", f"{math.degrees(place[2]):.0f}")
    )
    at = (member.pose.agvPosition if member.pose is not None else None) or {}
    bound = number(at.get("deviationRange"))
    survey = None if state is None else state.held.get("survey")
    legend = "GONE" if not member.publishers else "?" if state is None else state.state_name
    faults = () if state is None else state.faults
    words = "; ".join(f"{one.fault} {one.meaning}" for one in faults if not one.cause) or (
        "" if state is None else state.meaning
    )
    return (
        label,
        member.name,
        legend,
        x,
        y,
        theta,
        "-" if bound is None else f"{bound:.2f}",
        member.map_id or "-",
        "-" if survey is None else str(survey.version),
        f"{now - member.t_message:.0f}" if math.isfinite(member.t_message) else "-",
        words,
    )


def on_chart(chart: Chart, members: Sequence[Member]) -> list[tuple[int, Member, float, float]]:
    """Robots with a pose in this map: number in the table, robot, row and column of its cell."""
    head, cells = chart
    found = []
    for k, member in enumerate(members):
        if member.place is None or member.map_id != f"{head.map_id:08x}":
            continue
        column = (member.place[0] - head.origin[0]) / head.resolution
        row = (member.place[1] - head.origin[1]) / head.resolution
        if 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]:
            found.append((k, member, row, column))
    return found


def plan(chart: Chart, members: Sequence[Member], wide: int = 100, high: int = 30) -> list[str]:
    """The map as lines of text, # wall, . free; robots by their label."""
    (head, cells), robots = chart, on_chart(chart, members)
    (first, last), (left, right) = _seen(cells)
    cells = cells[first:last, left:right]
    step = max((right - left) / wide, (last - first) / (high * TALL), 1.0)
    rows, columns = math.ceil((last - first) / (TALL * step)), math.ceil((right - left) / step)
    text = np.full((rows, columns), " ")
    at_row, first_row = _starts(last - first, TALL * step)
    at_column, first_column = _starts(right - left, step)
    for shade, letter in ((FREE, "."), (WALL, "#")):  # a wall takes precedence over free cells
        occupied = np.logical_or.reduceat(np.logical_or.reduceat(cells == shade, first_row, 0), first_column, 1)
        text[np.ix_(at_row, at_column)] = np.where(occupied, letter, text[np.ix_(at_row, at_column)])
    for k, _, row, column in robots:
        y, x = int((row - first) / (TALL * step)), int((column - left) / step)
        if 0 <= y < rows and 0 <= x < columns:
            text[y, x] = label_of(k)
    lines = ["".join(line).rstrip() for line in text[::-1]]
    named = f"map {head.map_id:08x}, {(right - left) * head.resolution:.0f} x {(last - first) * head.resolution:.0f} m"
    return [*lines, named]


def picture(chart: Chart, members: Sequence[Member]) -> tuple[npt.NDArray[np.uint8], list[str]]:
    """RGB pixels (rows, columns, 3), top row first; and the legend of colours."""
    _, cells = chart
    scale = max(1, round(SMALLEST_SIDE / max(cells.shape)))
    shades = np.empty((*cells.shape, 3), np.uint8)
    shades[:] = SHADES[UNSEEN]
    for shade in (FREE, WALL):
        shades[cells == shade] = SHADES[shade]
    pixels = shades.repeat(scale, axis=0).repeat(scale, axis=1)
    legend = []
    for k, member, row, column in on_chart(chart, members):
        name, colour = COLOURS[k % len(COLOURS)]
        legend.append(f"{printable(member.name)} {name}" + ("" if member.localised else " (last received pose)"))
        _disc(pixels, scale * row, scale * column, colour)
        assert member.place is not None
        nose = 1.6 * DISC_PX * np.array((math.sin(member.place[2]), math.cos(member.place[2])))
        _disc(pixels, scale * row + nose[0], scale * column + nose[1], colour, DISC_PX // 3)
    return pixels[::-1], legend


def _seen(cells: Cells) -> tuple[tuple[int, int], tuple[int, int]]:
    """Row range and column range of the known cells, ends excluded."""
    rows, columns = (np.nonzero((cells != UNSEEN).any(axis=axis))[0] for axis in (1, 0))
    if rows.size == 0:
        return (0, cells.shape[0]), (0, cells.shape[1])
    return (int(rows[0]), int(rows[-1]) + 1), (int(columns[0]), int(columns[-1]) + 1)


def _starts(cells: int, step: float) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Fields of ``step`` cells: the indices of those with cells, and the first cell of each."""
    fields, first = np.unique((np.arange(cells) / step).astype(np.intp), return_index=True)
    return fields, first


def _disc(
    pixels: npt.NDArray[np.uint8], row: float, column: float, colour: tuple[int, int, int], radius: int = DISC_PX
) -> None:
    top, left = max(0, int(row) - radius), max(0, int(column) - radius)
    part = pixels[top : int(row) + radius + 1, left : int(column) + radius + 1]
    y, x = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
    part[(y - row) ** 2 + (x - column) ** 2 <= radius**2] = colour

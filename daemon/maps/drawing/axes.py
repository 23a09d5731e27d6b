"""Axes round a map picture: ticks in metres of the map frame, names of the axes, and a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from daemon.maps.drawing.font import word, write

Pixels = npt.NDArray[np.uint8]
Colour = npt.NDArray[np.float64]

INK: Final = np.array((28.0, 34.0, 48.0))
PAPER: Final = np.array((255.0, 255.0, 255.0))
_APART_PX: Final = 90
"""Least distance of two labelled ticks."""
_TICK_PX: Final = 7
_PAD_PX: Final = 10
_LINE_PX: Final = 26
"""Height of a line of text, with the space below it."""
_DOT_PX: Final = 8


class Entry(NamedTuple):
    """One entry of the legend: the colour of its disc, and its text."""

    colour: Colour
    text: str


def framed(image: Pixels, corner: tuple[float, float], pixels_per_metre: float, legend: Sequence[Entry]) -> Pixels:
    """Image (rows, columns, 3), top row first, with axes and legend.

    ``corner``: (x, y) of the image's lower left corner in the map frame, m.
    """
    rows, columns = image.shape[:2]
    across = _ticks(corner[0], columns, pixels_per_metre)
    up = _ticks(corner[1], rows, pixels_per_metre)
    widest = max((word(text).shape[1] for _, text in up), default=0)
    left = _PAD_PX + _LINE_PX + widest + _PAD_PX + _TICK_PX
    lines = _lines(legend, columns)
    below = _TICK_PX + (2 + len(lines)) * _LINE_PX + _PAD_PX
    whole = np.empty((_PAD_PX + rows + below, left + columns + 3 * _PAD_PX, 3), np.uint8)
    whole[:] = PAPER
    bottom = _PAD_PX + rows
    whole[_PAD_PX - 1 : bottom + 1, left - 1 : left + columns + 1] = INK
    whole[_PAD_PX:bottom, left : left + columns] = image
    for at, text in across:
        column = left + at
        whole[bottom : bottom + _TICK_PX, column : column + 2] = INK
        write(whole, ink := word(text), bottom + _TICK_PX + 4, column - ink.shape[1] // 2, INK)
    for at, text in up:
        row = bottom - at
        whole[row - 1 : row + 1, left - _TICK_PX : left] = INK
        ink = word(text)
        write(whole, ink, row - ink.shape[0] // 2, left - _PAD_PX - _TICK_PX - ink.shape[1], INK)
    name = word("x, m (map frame)")
    write(whole, name, bottom + _TICK_PX + _LINE_PX, left + (columns - name.shape[1]) // 2, INK)
    name = np.rot90(word("y, m (map frame)"))
    write(whole, name, _PAD_PX + (rows - name.shape[0]) // 2, _PAD_PX, INK)
    for number, line in enumerate(lines):
        _write_legend(whole, line, bottom + _TICK_PX + (2 + number) * _LINE_PX, left)
    return whole


def _ticks(begin: float, size: int, pixels_per_metre: float) -> list[tuple[int, str]]:
    """Pixels from the corner and labels of an axis's ticks."""
    least = _APART_PX / pixels_per_metre
    power = 10.0 ** math.floor(math.log10(least))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least)
    first = math.ceil(begin / step)
    last = math.floor((begin + (size - 1) / pixels_per_metre) / step)
    digits = max(0, -math.floor(math.log10(step)))
    return [
        (round((number * step - begin) * pixels_per_metre), f"{number * step:.{digits}f}")
        for number in range(first, last + 1)
    ]


def _lines(legend: Sequence[Entry], width: int) -> list[list[Entry]]:
    """Entries in lines that fit into ``width`` pixels."""
    lines: list[list[Entry]] = []
    used = width
    for entry in legend:
        size = _entry_px(entry)
        if used + size > width:
            lines.append([])
            used = 0
        lines[-1].append(entry)
        used += size
    return lines


def _entry_px(entry: Entry) -> int:
    return 4 * _DOT_PX + int(word(entry.text).shape[1])


def _write_legend(pixels: Pixels, line: Sequence[Entry], top: int, left: int) -> None:
    y, x = np.mgrid[: 2 * _DOT_PX, : 2 * _DOT_PX] + 0.5 - _DOT_PX
    away = np.hypot(x, y)
    for entry in line:
        write(pixels, away <= _DOT_PX, top, left, INK)
        write(pixels, away <= _DOT_PX - 2, top, left, entry.colour)
        write(pixels, word(entry.text), top, left + 2 * _DOT_PX + 6, INK)
        left += _entry_px(entry)

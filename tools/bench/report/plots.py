"""Small pictures for a report: SVG text that stands in the page itself, without a plotting library."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

WIDTH, HEIGHT = 560, 260
LEFT, RIGHT, TOP, BOTTOM = 60, 12, 26, 40
COLOURS: Final = ("#1769aa", "#c0392b", "#2e8b57", "#8e44ad", "#b9770e")
MOST_POINTS: Final = 1500
TICKS: Final = 5


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a picture; where a value is not finite, the line is broken.

    Attributes:
        kind: ``line``, ``dots``, ``bars`` (from the axis up), or ``marks`` (upright lines at ``x``; ``y`` is not used).
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    kind: Literal["line", "dots", "bars", "marks"] = "line"


@dataclass(frozen=True, slots=True)
class Plot:
    """A picture: title, what its axes show, what is drawn. ``square``: a metre is as long in both directions."""

    title: str
    x: str
    y: str
    series: tuple[Series, ...]
    square: bool = False


def histogram(title: str, x: str, values: Sequence[float], bins: int = 40) -> Plot:
    """How often values occur; what is not finite is left out."""
    kept = np.asarray(values, dtype=np.float64)
    kept = kept[np.isfinite(kept)]
    counts, edges = np.histogram(kept, bins=bins) if kept.size else (np.zeros(1), np.array([0.0, 1.0]))
    middles = 0.5 * (edges[:-1] + edges[1:])
    return Plot(title, x, "number", (Series("", middles.tolist(), counts.tolist(), "bars"),))


def svg(plot: Plot) -> str:
    """The picture as an SVG element."""
    drawn = [(one, *_finite(one)) for one in plot.series]
    xs = np.concatenate([x for _, x, _ in drawn] or [np.zeros(0)])
    ys = np.concatenate([y for one, _, y in drawn if one.kind != "marks"] or [np.zeros(0)])
    if any(one.kind == "bars" for one in plot.series):
        ys = np.append(ys, 0.0)
    ranges = _range(xs), _range(ys)
    if plot.square:
        ranges = _square(*ranges)
    (x0, x1), (y0, y1) = ranges
    wide, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def at(x: float, y: float) -> tuple[float, float]:
        return LEFT + wide * (x - x0) / (x1 - x0), TOP + high * (y1 - y) / (y1 - y0)

    parts = [_frame(plot, ranges)]
    for number, (one, x, y) in enumerate(drawn):
        places = [at(a, b) for a, b in zip(x.tolist(), y.tolist(), strict=True)]
        parts.append(_drawn(one, places, COLOURS[number % len(COLOURS)]))
    parts.append(_legend([one.name for one in plot.series]))
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" font-family="sans-serif">{"".join(parts)}</svg>'


Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def _finite(one: Series) -> tuple[Floats, Floats]:
    """At most so many points; a line keeps gaps as NaN, everything else loses them."""
    x = np.asarray(one.x, dtype=np.float64)
    y = np.zeros_like(x) if one.kind == "marks" else np.asarray(one.y, dtype=np.float64)
    step = max(1, math.ceil(x.size / MOST_POINTS))
    x, y = x[::step], y[::step]
    good = np.isfinite(x) & np.isfinite(y)
    return (x, np.where(good, y, np.nan)) if one.kind == "line" else (x[good], y[good])


def _range(values: Floats) -> tuple[float, float]:
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    margin = 0.04 * (high - low) or max(abs(low) * 0.05, 1e-9)
    return low - margin, high + margin


def _square(x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float]]:
    wide, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    scale = max((x[1] - x[0]) / wide, (y[1] - y[0]) / high)

    def grown(low: float, high: float, pixels: int) -> tuple[float, float]:
        middle, half = 0.5 * (low + high), 0.5 * scale * pixels
        return middle - half, middle + half

    return grown(*x, wide), grown(*y, high)


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= rough)
    first = math.ceil(low / step)
    return [step * k for k in range(first, math.floor(high / step) + 1)]


def _frame(plot: Plot, ranges: tuple[tuple[float, float], tuple[float, float]]) -> str:
    (x0, x1), (y0, y1) = ranges
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts = [
        f'<text x="{LEFT}" y="16" font-size="14">{html.escape(plot.title)}</text>',
        f'<rect x="{LEFT}" y="{TOP}" width="{right - LEFT}" height="{bottom - TOP}" fill="none" stroke="#999"/>',
        f'<text x="{(LEFT + right) / 2}" y="{HEIGHT - 6}" font-size="12" text-anchor="middle">'
        f"{html.escape(plot.x)}</text>",
        f'<text transform="translate(12 {(TOP + bottom) / 2}) rotate(-90)" font-size="12" text-anchor="middle">'
        f"{html.escape(plot.y)}</text>",
    ]  # fmt: skip
    for tick in _ticks(x0, x1):
        place = LEFT + (right - LEFT) * (tick - x0) / (x1 - x0)
        parts.append(f'<path d="M{place:.1f} {TOP}V{bottom}" stroke="#eee"/>')
        parts.append(f'<text x="{place:.1f}" y="{bottom + 14}" font-size="11" text-anchor="middle">{tick:.6g}</text>')
    for tick in _ticks(y0, y1):
        place = TOP + (bottom - TOP) * (y1 - tick) / (y1 - y0)
        parts.append(f'<path d="M{LEFT} {place:.1f}H{right}" stroke="#eee"/>')
        parts.append(f'<text x="{LEFT - 4}" y="{place + 4:.1f}" font-size="11" text-anchor="end">{tick:.6g}</text>')
    return "".join(parts)


def _drawn(one: Series, places: list[tuple[float, float]], colour: str) -> str:
    bottom = HEIGHT - BOTTOM
    if one.kind == "line":
        path, down = [], False
        for x, y in places:
            if not math.isfinite(y):
                down = False
                continue
            path.append(f"{'L' if down else 'M'}{x:.1f} {y:.1f}")
            down = True
        return f'<path d="{"".join(path)}" fill="none" stroke="{colour}" stroke-width="1.4"/>'
    if one.kind == "dots":
        return "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.6" fill="{colour}"/>' for x, y in places)
    top = [TOP if one.kind == "marks" else y for _, y in places]
    lines = "".join(f"M{x:.1f} {bottom}V{y:.1f}" for (x, _), y in zip(places, top, strict=True))
    dashed = ' stroke-dasharray="4 3"' if one.kind == "marks" else ""
    return f'<path d="{lines}" stroke="{colour}" stroke-width="{1.2 if dashed else 5}"{dashed}/>'


def _legend(names: list[str]) -> str:
    shown = [(number, name) for number, name in enumerate(names) if name]
    return "".join(
        f'<text x="{WIDTH - RIGHT - 6}" y="{TOP + 15 + 15 * row}" font-size="12" text-anchor="end" '
        f'fill="{COLOURS[number % len(COLOURS)]}">{html.escape(name)}</text>'
        for row, (number, name) in enumerate(shown)
    )

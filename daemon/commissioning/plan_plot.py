"""Plot of a lamp plan: links at each place, sigma by light alone, and axes that are not known."""

from __future__ import annotations

import io
from importlib.util import find_spec
from typing import Any, Final, NamedTuple

import numpy as np

from daemon.commissioning.floor import Array, Hall
from daemon.commissioning.lamp_selection import Plan
from daemon.commissioning.laser_information import KNOWN_SIGMA_M
from daemon.commissioning.light_information import worst

_LYING: Final = 0.4
"""Smallest ratio of height to width at which the three panels stand side by side; flatter floors are stacked."""
_PANEL_IN: Final = 11.0
"""Longest side of a panel, inches, where the floor is tall or the panels are stacked."""
_WIDE_IN: Final = 4.2
_LEAST_IN: Final = 2.2
_STAR_M: Final = 0.9
_MARGIN_M: Final = 1.0
_WORST_CM: Final = 25.0


def draw(hall: Hall, plan: Plan) -> bytes | None:
    """Returns a PNG; None without matplotlib."""
    if find_spec("matplotlib") is None:
        return None
    from matplotlib.figure import Figure

    window = _window(hall, plan)
    upright = window.height >= _LYING * window.width
    canvas = Figure(figsize=_inches(window, upright), dpi=100, layout="constrained")
    links, accuracy, blind = canvas.subplots(*((1, 3) if upright else (3, 1)), sharex=True, sharey=True)
    seen = _places(links, hall, plan, window, np.minimum(plan.links, 8), "RdYlGn", (0, 8))
    links.set_title(f"{len(plan.lamps)} lamps:\nlinks that each place sees", fontsize="medium")
    bar: dict[str, Any] = {"shrink": 0.7} if upright else {"shrink": 0.9, "aspect": 10}
    canvas.colorbar(seen, ax=links, **bar)
    centimetres = np.minimum(100.0 * plan.light_sigma, _WORST_CM)
    known = _places(accuracy, hall, plan, window, centimetres, "viridis_r", (0.0, _WORST_CM))
    accuracy.set_title("deviation from light alone,\nworse axis, cm", fontsize="medium")
    canvas.colorbar(known, ax=accuracy, **bar)
    _axes(blind, hall, plan, window)
    canvas.legend(*blind.get_legend_handles_labels(), loc="outside lower right", ncols=2, fontsize="small")
    out = io.BytesIO()
    canvas.savefig(out, format="png")
    return out.getvalue()


class Window(NamedTuple):
    """Drawn part of the plan, m in the plan's frame."""

    left: float
    below: float
    width: float
    height: float


def _window(hall: Hall, plan: Plan) -> Window:
    points = np.concatenate((hall.places, plan.lamps)) if len(hall.places) else np.zeros((1, 2))
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    return Window(low[0], low[1], high[0] - low[0], high[1] - low[1])


def _panel(window: Window) -> tuple[float, float]:
    """Returns width and height of one panel, inches."""
    ratio = window.height / window.width
    wide = min(_WIDE_IN, _PANEL_IN / ratio) if ratio >= _LYING else _PANEL_IN
    return wide, wide * ratio


def _inches(window: Window, upright: bool) -> tuple[float, float]:
    """Returns width and height of the whole figure, inches."""
    wide, high = _panel(window)
    if upright:
        return 3.0 * (max(wide, _LEAST_IN) + 0.8), max(high, _LEAST_IN) + 1.4
    return wide + 1.2, 3.0 * (max(high, 0.5) + 0.9) + 0.4


def _points_per_m(window: Window) -> float:
    return 72.0 * _panel(window)[0] / window.width


def _lamps(axes: Any, plan: Plan, window: Window) -> None:
    """Plots the lamps as stars, small enough to leave the plan visible."""
    size = float(np.clip(_STAR_M * _points_per_m(window), 3.0, 9.0))
    axes.plot(*plan.lamps.T, "*", color="black", markerfacecolor="gold", markersize=size, markeredgewidth=0.1 * size)


def _walls(axes: Any, hall: Hall, window: Window) -> None:
    rows, columns = hall.solid.shape
    shade = np.where(hall.tall, 0.0, np.where(hall.solid, 0.5, np.nan))
    extent = (0.0, columns * hall.cell, 0.0, rows * hall.cell)
    axes.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    axes.set_xlim(window.left, window.left + window.width)
    axes.set_ylim(window.below, window.below + window.height)
    axes.set_aspect("equal")


def _gridded(hall: Hall, value: Array) -> tuple[tuple[float, float, float, float], Array]:
    """Returns left, right, lower and upper edge in m, and the places' values (n,) as rows from below; NaN between them.

    One square per place, side by side in the plan's own metres; markers would have a fixed size on paper and leave
    gaps.
    """
    low = hall.places.min(axis=0)
    column, row = np.rint((hall.places - low) / hall.step).astype(np.int64).T
    grid = np.full((row.max() + 1, column.max() + 1), np.nan)
    grid[row, column] = value
    left, below = low - 0.5 * hall.step
    rows, columns = grid.shape
    return (left, left + columns * hall.step, below, below + rows * hall.step), grid


def _places(
    axes: Any, hall: Hall, plan: Plan, window: Window, value: Array, colours: str, span: tuple[float, float]
) -> Any:
    _walls(axes, hall, window)
    extent, grid = _gridded(hall, value)
    drawn = axes.imshow(
        grid, origin="lower", extent=extent, cmap=colours, vmin=span[0], vmax=span[1], interpolation="nearest"
    )
    _lamps(axes, plan, window)
    return drawn


def _axes(axes: Any, hall: Hall, plan: Plan, window: Window) -> None:
    """Plots lines along the axes that are not known: by the lidar alone, and with lamps."""
    _walls(axes, hall, window)
    for info, colour, label in (
        (plan.walls, "tab:orange", "laser alone"),
        (plan.walls + plan.light, "tab:red", "laser and light"),
    ):
        sigma, way = worst(info)
        at = sigma > KNOWN_SIGMA_M
        half = 0.4 * hall.step * np.column_stack((np.cos(way[at]), np.sin(way[at])))
        ends = np.stack((hall.places[at] - half, hall.places[at] + half, np.full_like(half, np.nan)), axis=1)
        x, y = ends.reshape(-1, 2).T
        axes.plot(x, y, color=colour, lw=1.5, label=f"{label}: {100.0 * at.mean():.1f} %")
    _lamps(axes, plan, window)
    axes.set_title(f"axes that are not known to {100 * KNOWN_SIGMA_M:.0f} cm", fontsize="medium")

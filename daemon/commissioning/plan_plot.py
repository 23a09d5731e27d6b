"""Plot of a lamp plan in the map frame: links at each place, sigma by light alone, and axes that are not known.

All axes are metres of the map frame, so that a lamp can be hung by the plot. The colours differ in lightness too and
suit colour-blind readers.
"""

from __future__ import annotations

import io
from importlib.util import find_spec
from typing import Any, Final, NamedTuple

import numpy as np

from daemon.commissioning.floor import Array, Hall
from daemon.commissioning.lamp_selection import Plan
from daemon.commissioning.laser_information import KNOWN_SIGMA_M
from daemon.commissioning.light_information import worst

_LYING: Final = 0.8
"""Smallest ratio of height to width at which the three panels stand side by side; flatter floors are stacked."""
_PANEL_IN: Final = 9.0
"""Longest side of a panel, inches."""
_WIDE_IN: Final = 5.0
_LEAST_IN: Final = 3.0
_LAMP_M: Final = 0.6
_MARGIN_M: Final = 1.0
_WORST_CM: Final = 25.0
_MOST_LINKS: Final = 8
_NUMBERED: Final = 200
"""With more lamps than these, numbers would hide the plan."""
_LEFT_OUT: Final = 0.85
"""Grey of floor that the robot does not reach."""
_LASER, _BOTH = "#e69f00", "#0072b2"
"""Orange and blue that colour-blind readers distinguish (Okabe, Ito)."""


def draw(hall: Hall, plan: Plan) -> bytes | None:
    """Returns a PNG; None without matplotlib."""
    if find_spec("matplotlib") is None:
        return None
    out = io.BytesIO()
    figure(hall, plan).savefig(out, format="png")
    return out.getvalue()


def figure(hall: Hall, plan: Plan) -> Any:
    """Returns the plot as a figure of matplotlib."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    window = _window(hall, plan)
    upright = window.height >= _LYING * window.width
    canvas = Figure(figsize=_inches(window, upright), dpi=100, layout="constrained")
    links, accuracy, blind = canvas.subplots(*((1, 3) if upright else (3, 1)), sharex=True, sharey=True)
    bar: dict[str, Any] = {"shrink": 0.8} if upright else {"aspect": 12}
    steps = colormaps["viridis"].resampled(_MOST_LINKS + 1)
    counted = np.minimum(plan.links, _MOST_LINKS)
    seen = _places(links, hall, plan, window, counted, steps, (-0.5, _MOST_LINKS + 0.5))
    links.set_title("Lamps\nin view of each position", fontsize="medium")
    scale = canvas.colorbar(seen, ax=links, label="number of lamps", ticks=range(_MOST_LINKS + 1), **bar)
    scale.ax.set_yticklabels([*map(str, range(_MOST_LINKS)), f"{_MOST_LINKS}+"])
    centimetres = np.minimum(100.0 * plan.light_sigma, _WORST_CM)
    known = _places(accuracy, hall, plan, window, centimetres, colormaps["cividis_r"], (0.0, _WORST_CM))
    accuracy.set_title("Standard deviation\nof the light solution, worse axis", fontsize="medium")
    canvas.colorbar(known, ax=accuracy, label="standard deviation, cm", extend="max", **bar)
    _axes(blind, hall, plan, window)
    for panel in (links, accuracy, blind):
        panel.set(xlabel="x, m (map frame)", ylabel="y, m (map frame)")
        panel.tick_params(labelbottom=True, labelleft=True)
    canvas.suptitle(f"{len(plan.lamps)} lamps", fontsize="large")
    lines, labels = blind.get_legend_handles_labels()
    if hall.reached.left_out.any():
        lines.append(Patch(color=str(_LEFT_OUT)))
        labels.append("excluded area")
    canvas.legend(lines, labels, loc="outside lower center", ncols=2, fontsize="small")
    return canvas


class Window(NamedTuple):
    """Drawn part of the plan, m in the map frame."""

    left: float
    below: float
    width: float
    height: float


def _window(hall: Hall, plan: Plan) -> Window:
    points = hall.in_map(np.concatenate((hall.places, plan.lamps))) if len(hall.places) else np.zeros((1, 2))
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
        return 3.0 * (max(wide, _LEAST_IN) + 1.2), max(high, _LEAST_IN) + 1.6
    return wide + 2.6, 3.0 * (max(high, 0.8) + 0.8) + 0.6


def _points_per_m(window: Window) -> float:
    return 72.0 * _panel(window)[0] / window.width


def _lamps(axes: Any, hall: Hall, plan: Plan, window: Window) -> None:
    """Plots the lamps as white discs, small enough to leave the plan visible."""
    size = float(np.clip(_LAMP_M * _points_per_m(window), 3.0, 8.0))
    axes.plot(
        *hall.in_map(plan.lamps).T, "o", color="black", markerfacecolor="white", markersize=size, label="lamp",
        markeredgewidth=0.15 * size,
    )  # fmt: skip


def _numbers(axes: Any, hall: Hall, plan: Plan) -> None:
    """Writes the number that each lamp has in the survey beside it."""
    from matplotlib.patheffects import withStroke

    if len(plan.lamps) > _NUMBERED:
        return
    clear = [withStroke(linewidth=1.5, foreground="white")]
    for number, place in enumerate(hall.in_map(plan.lamps), 1):
        axes.annotate(str(number), place, (3, 3), textcoords="offset points", fontsize=7, path_effects=clear)


def _image(axes: Any, hall: Hall, value: Array, extent: tuple[float, float, float, float], **how: Any) -> Any:
    """Plots rows of cells from below, ``extent`` in the plan's frame, where they lie in the map frame."""
    from matplotlib.transforms import Affine2D

    x, y, yaw = hall.origin
    drawn = axes.imshow(value, origin="lower", extent=extent, interpolation="nearest", **how)
    drawn.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)
    return drawn


def _walls(axes: Any, hall: Hall, window: Window) -> None:
    rows, columns = hall.solid.shape
    shade = np.where(hall.tall, 0.0, np.where(hall.solid, 0.5, np.where(hall.reached.left_out, _LEFT_OUT, np.nan)))
    extent = (0.0, columns * hall.cell, 0.0, rows * hall.cell)
    _image(axes, hall, shade, extent, cmap="gray", vmin=0.0, vmax=1.0)
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
    axes: Any, hall: Hall, plan: Plan, window: Window, value: Array, colours: Any, span: tuple[float, float]
) -> Any:
    extent, grid = _gridded(hall, value)
    drawn = _image(axes, hall, grid, extent, cmap=colours, vmin=span[0], vmax=span[1])
    _walls(axes, hall, window)
    _lamps(axes, hall, plan, window)
    return drawn


def _axes(axes: Any, hall: Hall, plan: Plan, window: Window) -> None:
    """Plots lines along the axes that are not known: by the lidar alone, and with lamps."""
    _walls(axes, hall, window)
    for info, colour, label in (
        (plan.walls, _LASER, "degenerate for the lidar alone"),
        (plan.walls + plan.light, _BOTH, "degenerate for lidar and light"),
    ):
        sigma, way = worst(info)
        at = sigma > KNOWN_SIGMA_M
        half = 0.4 * hall.step * np.column_stack((np.cos(way[at]), np.sin(way[at])))
        ends = hall.in_map(np.concatenate((hall.places[at] - half, hall.places[at] + half)))
        ends = np.stack((*np.split(ends, 2), np.full_like(half, np.nan)), axis=1)
        x, y = ends.reshape(-1, 2).T
        axes.plot(x, y, color=colour, lw=1.5, label=f"{label}: {100.0 * at.mean():.1f} % of positions")
    _lamps(axes, hall, plan, window)
    _numbers(axes, hall, plan)
    axes.set_title(f"Directions not known to\n{100 * KNOWN_SIGMA_M:.0f} cm; lamp numbers", fontsize="medium")

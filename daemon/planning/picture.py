"""The picture of a plan: how many lamps each place sees, how well it knows itself, and which axes are blind."""

from __future__ import annotations

import io
from importlib.util import find_spec
from typing import Any, Final

import numpy as np

from daemon.planning.choose import Plan
from daemon.planning.hall import Array, Hall
from daemon.planning.sight import worst
from daemon.planning.walls import KNOWN_SIGMA_M

_INCHES: Final = (15.0, 5.5)
_WORST_CM: Final = 25.0


def draw(hall: Hall, plan: Plan) -> bytes | None:
    """PNG; None without matplotlib."""
    if find_spec("matplotlib") is None:
        return None
    from matplotlib.figure import Figure

    canvas = Figure(figsize=_INCHES, dpi=100, layout="constrained")
    links, accuracy, blind = canvas.subplots(1, 3, sharex=True, sharey=True)
    seen = _places(links, hall, plan, np.minimum(plan.links, 8), "RdYlGn", (0, 8))
    links.set_title(f"{len(plan.lamps)} lamps: links that each place sees")
    canvas.colorbar(seen, ax=links, shrink=0.5)
    centimetres = np.minimum(100.0 * plan.light_sigma, _WORST_CM)
    known = _places(accuracy, hall, plan, centimetres, "viridis_r", (0.0, _WORST_CM))
    accuracy.set_title("deviation from light alone, worse axis, cm")
    canvas.colorbar(known, ax=accuracy, shrink=0.5)
    _axes(blind, hall, plan)
    out = io.BytesIO()
    canvas.savefig(out, format="png")
    return out.getvalue()


def _walls(axes: Any, hall: Hall) -> None:
    rows, columns = hall.solid.shape
    shade = np.where(hall.tall, 0.0, np.where(hall.solid, 0.5, np.nan))
    extent = (0.0, columns * hall.cell, 0.0, rows * hall.cell)
    axes.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    axes.set_aspect("equal")


def _places(axes: Any, hall: Hall, plan: Plan, value: Array, colours: str, span: tuple[float, float]) -> Any:
    _walls(axes, hall)
    size = 40.0 * (hall.step / max(hall.cell * max(hall.solid.shape), 1e-9) * 25.0) ** 2
    drawn = axes.scatter(*hall.places.T, c=value, s=size, marker="s", cmap=colours, vmin=span[0], vmax=span[1], lw=0)
    axes.plot(*plan.lamps.T, "*", color="black", markerfacecolor="gold", markersize=9)
    return drawn


def _axes(axes: Any, hall: Hall, plan: Plan) -> None:
    """Lines along the axis that is not known: by the laser alone, and with lamps."""
    _walls(axes, hall)
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
    axes.plot(*plan.lamps.T, "*", color="black", markerfacecolor="gold", markersize=9)
    axes.set_title(f"axes that are not known to {100 * KNOWN_SIGMA_M:.0f} cm")
    axes.legend(loc="upper right")

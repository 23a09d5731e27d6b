"""Pictures of Fig. 5: maps as scans put at the estimated poses, the estimated way, the true walls and the true way."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from tools.experiments.support.trajectory import Array, Track
from tools.sim.building.buildings import building
from tools.sim.building.world import CIRCLE

VIEWS: Final = {"room": (-6.3, 6.3, -6.3, 6.3), "tour": (-14.0, 58.0, 8.0, -9.5)}
"""What is shown: left, right, bottom, top of the picture in m; the tour lies on its side (y to the right, x down)."""

WALLS: Final = {"color": "lightskyblue", "lw": 2.0, "label": "walls of the building"}
POINTS: Final = {"ls": "", "marker": ",", "color": "black", "alpha": 0.5, "label": "scans at the estimated poses"}
TRUTH: Final = {"ls": "--", "lw": 0.6, "color": "tab:gray", "label": "true path"}
POSE: Final = {"ls": "-", "lw": 0.8, "color": "tab:red", "label": "estimated path"}
"""How each is drawn."""
NAMED: Final[dict[str, Any]] = {"scans at the estimated poses": {"marker": ".", "alpha": 1.0}}
"""How it is drawn in the legend, where that differs: a pixel could not be seen there."""


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One map. points: (n, 2) in the map's frame."""

    title: str
    track: Track
    points: Array


def draw_maps(panels: list[Panel], where: str, canvas: Any) -> None:
    """Draw panels side by side (room) or one below the other (tour, turned by 90 degrees)."""
    lying = where == "tour"
    across = 1 if lying else (len(panels) + 1) // 2
    places = canvas.subplots(-(-len(panels) // across), across, squeeze=False).ravel()
    for axes, panel in zip(places, panels, strict=False):
        walls(axes, lying)
        for points, how in ((panel.points, POINTS), (panel.track.truth, TRUTH), (panel.track.pose, POSE)):
            axes.plot(*(points[:, 1::-1] if lying else points[:, :2]).T, **how)
        left, right, bottom, top = VIEWS[where]
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.tick_params(labelsize=7)
        name_axes(axes, lying)
        axes.set_title(panel.title.replace("\n", ": ") if lying else panel.title, fontsize=8)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    name_lines(canvas, 4 if across > 1 else 2)


def name_axes(axes: Any, lying: bool = False) -> None:
    """Names the axes of a panel, with their unit."""
    across, up = ("y, m", "x, m") if lying else ("x, m", "y, m")
    axes.set_xlabel(across, fontsize=8)
    axes.set_ylabel(up, fontsize=8)


def name_lines(canvas: Any, columns: int, *more: dict[str, Any]) -> None:
    """One legend below all panels."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], **(how | NAMED.get(how["label"], {}))) for how in (WALLS, POINTS, TRUTH, POSE, *more)]
    canvas.legend(handles=lines, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def walls(axes: Any, lying: bool) -> None:
    """The true building, in light blue."""
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    for kind, a, b, c, d, _ in building("paper_room").world.shapes:
        x, y = (a + c * np.cos(turn), b + c * np.sin(turn)) if kind == CIRCLE else (np.array((a, c)), np.array((b, d)))
        axes.plot(*((y, x) if lying else (x, y)), **WALLS, zorder=0)

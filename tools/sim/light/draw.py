"""Maps of the light in a building, for people (needs matplotlib, extra ``plot``).

``python -m tools.sim.light.draw paper_room light.png`` draws what a photodiode receives at every place: the strongest
lamp, how many are in plain view, and one lamp's strength over what its data sheet says.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from tools.sim.building.buildings import building
from tools.sim.building.draw import asked, draw_building
from tools.sim.ceiling.ceiling import IDEAL, Array, Ceiling, ceiling_of
from tools.sim.ceiling.diffuse import within
from tools.sim.ceiling.lamps import Zone

PIXELS: Final = 160
"""Along the longer side."""
PLAIN_A: Final = 30e-9
"""Modulated current of a lamp near the edge of the field of view; weaker light came by way of walls and ceiling."""
WIDE_M: Final = 5.0
"""A room at least so wide is drawn by itself."""


def places(ceiling: Ceiling, pixels: int = PIXELS, only: Zone | None = None) -> tuple[Array, Array, Array]:
    """Grid (x and y) over a room, or all lamps' rooms, and the (n, 3) poses of a robot that looks east everywhere."""
    zones = np.array([only or lamp.zone for lamp in ceiling.fixtures])
    low, high = zones[:, :2].min(axis=0), zones[:, 2:].max(axis=0)
    step = float((high - low).max()) / pixels
    x, y = (np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high, strict=True))
    gx, gy = np.meshgrid(x, y)
    return x, y, np.column_stack([gx.ravel(), gy.ravel(), np.zeros(gx.size)])


def room_of(ceiling: Ceiling, at: tuple[float, float]) -> Zone | None:
    """The wide room around a place; None in a corridor."""
    for x_min, y_min, x_max, y_max in {lamp.zone for lamp in ceiling.fixtures}:
        wide = min(x_max - x_min, y_max - y_min) > WIDE_M
        if wide and x_min <= at[0] <= x_max and y_min <= at[1] <= y_max:
            return x_min, y_min, x_max, y_max
    return None


def maps(ceiling: Ceiling, poses: Array) -> tuple[Array, Array]:
    """(places, lamps) received, and by the book: ideal lamps of the plan in empty space."""
    book = Ceiling(ceiling.fixtures, ceiling.world, ceiling.height_m, replace(IDEAL, floor=0.0), ceiling.photodiode)
    zero = np.zeros(len(poses))
    return ceiling.amplitudes(poses, zero), book.amplitudes(poses, zero)


def draw(figure: Any, name: str, pixels: int = PIXELS) -> None:
    """Three maps of a building's light."""
    place = building(name)
    ceiling = ceiling_of(place)
    start = place.route.corners[0]
    x, y, poses = places(ceiling, pixels, room_of(ceiling, start))
    received, book = maps(ceiling, poses)
    shape = (len(y), len(x))
    lit = np.any([within(poses[:, :2], zone) for zone in {f.zone for f in ceiling.fixtures}], axis=0)
    received[~lit] = np.nan
    lamp = int(np.argmin(np.hypot(*(ceiling.placed[:, :2] - start).T)))
    seen = (book[:, lamp] > 0.0) & (received[:, lamp] > PLAIN_A)
    over = np.full(len(received), np.nan)
    over[seen] = 100.0 * (
        received[seen, lamp] / book[seen, lamp] / np.median(received[seen, lamp] / book[seen, lamp]) - 1
    )
    pictures: tuple[tuple[str, Array, dict[str, Any]], ...] = (
        ("strongest lamp, nA", 1e9 * received.max(axis=1), {"cmap": "inferno"}),
        (
            f"lamps above {1e9 * PLAIN_A:.0f} nA",
            np.where(lit, (received > PLAIN_A).sum(axis=1), np.nan),
            {"cmap": "viridis"},
        ),
        (
            f"lamp {ceiling.fixtures[lamp].lamp_id} over its data sheet, %",
            over,
            {"cmap": "RdBu", "vmin": -15, "vmax": 15},
        ),
    )
    tall = shape[0] >= shape[1]
    axes = figure.subplots(1, 3) if tall else figure.subplots(3, 1)
    for one, (title, values, more) in zip(axes, pictures, strict=True):
        image = one.imshow(values.reshape(shape), origin="lower", extent=(x[0], x[-1], y[0], y[-1]), zorder=1.5, **more)
        figure.colorbar(image, ax=one, shrink=0.7)
        draw_building(one, place)
        one.plot(*ceiling.placed[:, :2].T, "c.", markersize=3)
        one.set_xlim(x[0] - 0.5, x[-1] + 0.5)
        one.set_ylim(y[0] - 0.5, y[-1] + 0.5)
        one.set_title(title)


def main(name: str, path: str) -> None:
    """Draw a building's light to an image file."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(15, 6), layout="constrained")
    draw(figure, name)
    figure.savefig(path, dpi=70)


if __name__ == "__main__":
    main(*asked("tools.sim.light.draw", __doc__))

"""Where lamps hang in the buildings, and which codes they send: the drawing on the electrician's desk.

Positions are in the building's frame, which is the survey's. A room or corridor is a zone: diffuse light fills it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from tools.sim.building.building import Building

CODES: Final = 129
Zone = tuple[float, float, float, float]
"""``x_min, y_min, x_max, y_max`` of a room."""


@dataclass(frozen=True, slots=True)
class Fixture:
    """A lamp as planned.

    Attributes:
        x, y, z: of its luminous centre. zone: its room. lamp_id: its number in the building. code: what it sends.
        power_w: mean radiant power. half_angle_deg: of half power. radius_m: of its luminous area.
    """

    x: float
    y: float
    z: float
    zone: Zone
    lamp_id: int = 0
    code: int = 0
    power_w: float = 1.5
    half_angle_deg: float = 70.0
    radius_m: float = 0.08


def fixtures(building: Building) -> tuple[Fixture, ...]:
    """The lamps of a building of `buildings.BUILDINGS`; raises ValueError for one without a plan."""
    if building.name not in PLANS:
        raise ValueError(f"nobody has planned lamps for {building.name!r}; planned: {', '.join(sorted(PLANS))}")
    return with_codes(PLANS[building.name](building))


def with_codes(planned: Iterable[Fixture], codes: int = CODES) -> tuple[Fixture, ...]:
    """Number the lamps and give each the code whose nearest other user is farthest away."""
    lamps = list(planned)
    at = np.array([(lamp.x, lamp.y) for lamp in lamps])
    nearest = np.full((len(lamps), codes), np.inf)  # of each place, to the nearest user of each code
    made = []
    for number, lamp in enumerate(lamps):
        free = nearest[number]
        code = int(np.argmax(free)) if np.isfinite(free).all() else int(np.flatnonzero(np.isinf(free))[0])
        distance = np.hypot(*(at - at[number]).T)
        nearest[:, code] = np.minimum(nearest[:, code], distance)
        place = (lamp.x, lamp.y, lamp.z, lamp.zone)
        made.append(Fixture(*place, number + 1, code, lamp.power_w, lamp.half_angle_deg, lamp.radius_m))
    return tuple(made)


def row(zone: Zone, z: float, spacing: float) -> list[Fixture]:
    """Lamps in a grid of at most ``spacing`` that fills a zone, half a spacing from its sides."""
    x_min, y_min, x_max, y_max = zone
    nx, ny = (max(int(np.ceil((b - a) / spacing)), 1) for a, b in ((x_min, x_max), (y_min, y_max)))
    return [
        Fixture(x_min + (i + 0.5) * (x_max - x_min) / nx, y_min + (j + 0.5) * (y_max - y_min) / ny, z, zone)
        for j in range(ny)
        for i in range(nx)
    ]


def _paper_room(building: Building) -> list[Fixture]:
    """16 lamps 2.5 m apart in the room, 25 in the corridor."""
    z = building.height_m - 0.1
    return row((-5.0, -5.0, 5.0, 5.0), z, 2.5) + row((-7.15, -12.0, -5.15, 56.0), z, 2.75)


def _corridor_loop(building: Building) -> list[Fixture]:
    """One row along each of the four legs."""
    x_min, y_min, x_max, y_max = 0.0, 0.0, 40.0, 25.0
    width, z = 2.2, building.height_m - 0.1
    legs: list[Zone] = [(x_min, y_min, x_max, y_min + width), (x_min, y_max - width, x_max, y_max)]
    legs += [(x, y_min + width, x + width, y_max - width) for x in (x_min, x_max - width)]
    return [lamp for leg in legs for lamp in row(leg, z, 2.9)]


def _warehouse(building: Building) -> list[Fixture]:
    """High-bay lamps 7.8 m up: over the lanes between the racks, and along the walls."""
    zone: Zone = (0.0, 0.0, 50.0, 30.0)
    z = building.height_m - 0.2
    xs, ys = np.linspace(3.0, 47.0, 10), (2.75, 8.0, 13.0, 18.0, 23.0, 27.75)
    return [Fixture(float(x), y, z, zone, 0, 0, 8.0, 60.0, 0.2) for y in ys for x in xs]


def _office(building: Building) -> list[Fixture]:
    """Two lamps in each of 60 rooms, and rows along corridors and passages: more lamps than codes."""
    from tools.sim.building import office

    z, deep, wide = building.height_m - 0.1, office.ROOM_DEPTH, office.CORRIDOR
    south, north, top = deep, 3 * deep + wide, 4 * deep + 2 * wide
    zones: list[tuple[Zone, float]] = [((0.0, y, office.LENGTH, y + wide), 2.7) for y in (south, north)]
    zones += [((a, south + wide, b, north), 2.5) for a, b in office.PASSAGES]
    outer = np.linspace(0.0, office.LENGTH, 17)
    inner = [np.linspace(a[1], b[0], 8) for a, b in zip(office.PASSAGES, office.PASSAGES[1:], strict=False)]
    middle = south + wide + deep
    rows = [(outer, 0.0, south), (outer, north + wide, top)]
    rows += [(x, a, b) for x in inner for a, b in ((south + wide, middle), (middle, north))]
    rooms = [(float(a), y0, float(b), y1) for x, y0, y1 in rows for a, b in pairwise(x)]
    lamps = [lamp for zone, spacing in zones for lamp in row(zone, z, spacing)]
    shares = (0.3, 0.7)
    return lamps + [
        Fixture(0.5 * (x0 + x1), y0 + share * (y1 - y0), z, (x0, y0, x1, y1))
        for x0, y0, x1, y1 in rooms
        for share in shares
    ]


PLANS: Final[dict[str, Callable[[Building], list[Fixture]]]] = {
    "paper_room": _paper_room,
    "corridor_loop": _corridor_loop,
    "warehouse_hall": _warehouse,
    "office_floor": _office,
}

"""The buildings: each a world to see, a tour to drive through it, and people who walk about."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Final

import numpy as np

from tools.sim.building.building import Building
from tools.sim.building.office import office_floor
from tools.sim.building.people import Walker
from tools.sim.building.world import Plan, Point
from tools.sim.robot.drive import Route

TURN_Y: Final = 46.9  # where the paper's robot turns round in the corridor: makes its tour 160 m


def paper_room(people: int = 2) -> Building:
    """The room of the paper's evaluation: 10 x 10 m, axisymmetric, four columns, one side partly transparent.

    A door in the west wall leads to a 68 m corridor with polished floor, whose only relief are flat door niches. The
    tour is 160 m long and returns to its start. The room is symmetric about both axes but for the panes in the east
    and the door, so that a place and its mirror image look alike.
    """
    plan = Plan()
    plan.line((-5, -5), (5, -5))
    plan.line((-5, 5), (5, 5))
    _glazed_side(plan, x=5.0)
    plan.wall((-5.075, -5), (-5.075, 5), gaps=[(4.4, 5.6)], thickness=0.15)
    for x in (-2.2, 2.2):
        for y in (-2.2, 2.2):
            plan.circle((x, y), 0.25)
    _outside(plan)
    _paper_corridor(plan)
    corners: list[Point] = [(1.2, 0), (3.7, 0), (3.7, 3.7), (-3.7, 3.7), (-3.7, -3.7), (3.7, -3.7), (3.7, 0)]
    corners += [(0, 0), (0, 3.7), (-3.7, 3.7), (-3.7, 0), (-6.15, 0)]
    turn = TURN_Y  # a keyhole, so that the robot comes back along the middle
    corners += [(-6.15, turn), (-6.6, turn + 1.2), (-6.15, turn + 2.2), (-5.7, turn + 1.2), (-6.15, turn)]
    corners += [(-6.15, 0), (-3.7, 0), (-3.7, -3.7), (0, -3.7), (0, 0)]
    walkers = (
        Walker(((-6.5, -8.0), (-6.5, 30.0)), 1.2, 12.0),
        Walker(((-4.3, -4.3), (4.3, -4.4), (4.4, 4.3)), 0.9, 3.0),
        Walker(((-5.8, 5.0), (-5.8, 40.0)), 1.4, 20.0, "black"),
    )
    return Building("paper_room", plan.build(), Route(tuple(corners), 1.2), walkers[:people])


def _glazed_side(plan: Plan, x: float) -> None:
    """A wall with two tall panes; the posts between them are steel."""
    for begin, end in ((-5.0, -3.9), (-1.1, 1.1), (3.9, 5.0)):
        plan.line((x, begin), (x, end))
    for begin, end in ((-3.9, -1.1), (1.1, 3.9)):
        middle = 0.5 * (begin + end)
        plan.line((x, begin), (x, end), "glass")
        plan.box((x, middle), (0.06, 0.06), 0.0, "steel")


def _outside(plan: Plan) -> None:
    """What is seen through the panes: a few trunks, a parapet, a wall far away."""
    for centre, radius in (((9.0, 2.0), 0.2), ((11.5, -3.0), 0.25), ((10.2, 4.5), 0.15)):
        plan.circle(centre, radius, "wood")
    plan.line((13.0, -9.0), (13.0, -1.0), "cardboard", top=1.1)
    plan.line((24.0, -12.0), (24.0, 14.0))


def _paper_corridor(plan: Plan) -> None:
    """The corridor west of the room: 68 m x 2 m, niches of 4 cm at irregular distances, polished floor."""
    x_min, x_max, y_min, y_max = -7.15, -5.15, -12.0, 56.0
    plan.line((x_max, y_min), (x_max, -5.0))
    plan.line((x_max, 5.0), (x_max, y_max))
    plan.line((x_max, -5.0), (x_max + 0.15, -5.0))
    plan.line((x_max, 5.0), (x_max + 0.15, 5.0))
    plan.line((x_min, y_min), (x_max, y_min))
    plan.line((x_min, y_max), (x_max, y_max))
    _niches(plan, x_min, y_min, y_max)
    plan.polish(x_min, y_min, x_max, y_max)


def _niches(plan: Plan, x: float, y_min: float, y_max: float) -> None:
    """A wall along y with closed doors set back by 4 cm."""
    at = y_min
    for door in (-9.3, -3.1, 4.2, 8.7, 16.9, 21.2, 30.4, 37.0, 43.8, 52.1):
        plan.line((x, at), (x, door))
        plan.line((x, door), (x - 0.04, door))
        plan.line((x - 0.04, door), (x - 0.04, door + 0.9), "wood")
        plan.line((x - 0.04, door + 0.9), (x, door + 0.9))
        at = door + 0.9
    plan.line((x, at), (x, y_max))


def corridor_loop(length: float = 40.0, depth: float = 25.0, width: float = 2.2, people: int = 0) -> Building:
    """A plain corridor around a block: nothing along its walls tells one metre from the next, only corners do."""
    plan = Plan()
    plan.outline([(0, 0), (length, 0), (length, depth), (0, depth)])
    inner: list[Point] = [(width, width), (length - width, width)]
    inner += [(length - width, depth - width), (width, depth - width)]
    plan.outline(inner)
    plan.polish(0.0, 0.0, length, width)
    half = 0.5 * width
    right, top = length - half, depth - half
    walkers = tuple(
        Walker(((half, half + 0.4), (right, half + 0.4), (right, top)), 1.1, 9.0 * number) for number in range(people)
    )
    corners: tuple[Point, ...] = ((0.5 * length, half), (right, half), (right, top), (half, top), (half, half))
    return Building("corridor_loop", plan.build(), Route(corners, 1.8), walkers)


def warehouse_hall(seed: int = 0, people: int = 3) -> Building:
    """A hall of 50 x 30 m with five double racks: long rows of equal uprights, pallets in some of the bays."""
    rng = np.random.default_rng(seed)
    plan = Plan()
    plan.wall((0, 0), (50, 0), gaps=[(6.0, 9.5), (21.0, 24.5)], thickness=0.3)
    plan.line((6.0, 0.0), (9.5, 0.0), "steel")
    plan.line((21.0, 0.0), (24.5, 0.0), "steel")
    for a, b in (((50, 0), (50, 30)), ((50, 30), (0, 30)), ((0, 30), (0, 0))):
        plan.line(a, b)
    rows = (5.5, 10.5, 15.5, 20.5, 25.5)
    for y in rows:
        for x in np.arange(6.0, 44.1, 2.7):
            for side in (-1.1, 0.0, 1.1):
                plan.box((float(x), y + side), (0.1, 0.09), 0.0, "steel", top=6.0)
        for x in np.arange(6.0, 42.0, 2.7):
            for side in (-0.55, 0.55):
                if rng.random() < 0.6:
                    size = (float(rng.uniform(0.8, 1.2)), float(rng.uniform(0.7, 0.9)))
                    centre = (float(x) + 1.35 + float(rng.uniform(-0.5, 0.5)), y + side)
                    yaw, material = float(rng.normal(0.0, 0.03)), str(rng.choice(["cardboard", "black", "wood"]))
                    plan.box(centre, size, yaw, material, top=1.5)
        _upper_shelves(plan, y, seed)
    lanes = [0.5 * (a + b) for a, b in pairwise(rows)]
    corners: list[Point] = [(3.0, 5.5)]
    for number, y in enumerate(lanes):
        corners += [(3.0, y), (47.0, y)] if number % 2 == 0 else [(47.0, y), (3.0, y)]
    corners += [(2.0, lanes[3]), (2.0, 3.0), (3.0, 3.0)]
    walkers = tuple(
        Walker(((8.0, lanes[k % 4] + 0.9), (42.0, lanes[k % 4] + 0.9)), 1.1, 7.0 * k) for k in range(people)
    )
    return Building("warehouse_hall", plan.build(), Route(tuple(corners), 1.8), walkers, 8.0)


def _upper_shelves(plan: Plan, y: float, seed: int) -> None:
    """Two levels of shelves above the pallets on the floor, three bays of four loaded; drawn by chance of their own."""
    rng = np.random.default_rng((seed, round(10 * y)))
    for x in np.arange(6.0, 42.0, 2.7):
        for low in (2.0, 4.0):
            for side in (-0.55, 0.55):
                if rng.random() < 0.75:
                    height = float(rng.uniform(0.9, 1.7))
                    plan.shelf(
                        (float(x) + 0.1, float(x) + 2.6), (y + side - 0.45, y + side + 0.45), (low, low + height)
                    )


BUILDINGS: Final[dict[str, Callable[[], Building]]] = {
    "paper_room": paper_room,
    "corridor_loop": corridor_loop,
    "warehouse_hall": warehouse_hall,
    "office_floor": office_floor,
}


def building(name: str) -> Building:
    """The building of that name; raises ValueError that lists the names there are."""
    if name not in BUILDINGS:
        raise ValueError(f"no building is called {name!r}; there are: {', '.join(sorted(BUILDINGS))}")
    return BUILDINGS[name]()

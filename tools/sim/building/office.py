"""An office floor: 60 rooms on two corridors and three cross passages; doors, furniture, glass fronts, people."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from tools.sim.building.building import Building
from tools.sim.building.people import Walker
from tools.sim.building.world import Array, Plan, Point
from tools.sim.robot.drive import Route

LENGTH: Final = 64.0
ROOM_DEPTH: Final = 5.0
CORRIDOR: Final = 2.0
PARTITION: Final = 0.12
DOOR: Final = 0.95
PASSAGES: Final = ((0.0, 2.0), (31.0, 33.0), (62.0, 64.0))  # x of the cross passages

SOUTH_Y: Final = ROOM_DEPTH + 0.5 * CORRIDOR
NORTH_Y: Final = 3 * ROOM_DEPTH + 1.5 * CORRIDOR


def office_floor(seed: int = 7, people: int = 6) -> Building:
    """The floor of that seed: which doors stand open, where furniture stands and who walks differ between seeds."""
    rng = np.random.default_rng(seed)
    plan = Plan()
    depth = 4 * ROOM_DEPTH + 2 * CORRIDOR
    plan.outline([(0.0, 0.0), (LENGTH, 0.0), (LENGTH, depth), (0.0, depth)])
    outer = np.linspace(0.0, LENGTH, 17)
    core_a = np.linspace(PASSAGES[0][1], PASSAGES[1][0], 8)
    core_b = np.linspace(PASSAGES[1][1], PASSAGES[2][0], 8)
    south, north = ROOM_DEPTH + CORRIDOR, 3 * ROOM_DEPTH + CORRIDOR
    _row(plan, rng, outer, (0.0, ROOM_DEPTH))
    _row(plan, rng, outer, (depth, north + CORRIDOR))
    for core in (core_a, core_b):
        middle = south + ROOM_DEPTH
        _row(plan, rng, core, (middle, south))
        _row(plan, rng, core, (middle, north))
        plan.line((core[0], middle), (core[-1], middle))
        for x in (core[0], core[-1]):
            plan.wall((x, south), (x, north), thickness=PARTITION)
    return Building("office_floor", plan.build(), _tour(), _walkers(people))


def _tour() -> Route:
    """The east ring twice, then the west one: counter-clockwise, the middle passage is shared."""
    west, middle, east = (0.5 * (a + b) for a, b in PASSAGES)
    corners: list[Point] = [(16.0, SOUTH_Y), (east, SOUTH_Y), (east, NORTH_Y), (middle, NORTH_Y), (middle, SOUTH_Y)]
    corners += [(east, SOUTH_Y), (east, NORTH_Y), (west, NORTH_Y), (west, SOUTH_Y)]
    return Route(tuple(corners), 1.6)


def _row(plan: Plan, rng: np.random.Generator, edges: Array, y: tuple[float, float]) -> None:
    """A row of rooms between x ``edges``; ``y`` is (back wall, corridor wall)."""
    back, front = y
    inward = 1.0 if back > front else -1.0
    gaps: list[Point] = []
    for left, right in pairwise(edges):
        hinge = left + float(rng.uniform(0.4, right - left - DOOR - 0.4))
        gaps.append((hinge - edges[0], hinge + DOOR - edges[0]))
        _door(plan, rng, (hinge, front), inward)
        if rng.random() < 0.12:
            gaps.append(_glass_front(plan, (left, right), hinge, front, edges[0]))
        _furnish(plan, rng, (left, right), (back, front))
    plan.wall((edges[0], front), (edges[-1], front), gaps=gaps, thickness=PARTITION)
    for x in edges[1:-1]:
        plan.wall((x, back), (x, front + 0.5 * inward * PARTITION), thickness=PARTITION)


def _door(plan: Plan, rng: np.random.Generator, hinge: Point, inward: float) -> None:
    """A leaf that is shut, ajar or wide open into the room."""
    opening = float(rng.choice([0.0, 0.3, 1.2, 1.55], p=[0.45, 0.1, 0.15, 0.3]))
    leaf = (DOOR * np.cos(opening), inward * DOOR * np.sin(opening))
    foot = (hinge[0], hinge[1] + inward * 0.03)
    plan.line(foot, (foot[0] + leaf[0], foot[1] + leaf[1]), "wood", top=2.05)


def _glass_front(plan: Plan, room: Point, hinge: float, front: float, origin: float) -> Point:
    """A pane beside the door, on the roomier side; returns the gap it fills."""
    left = (room[0] + 0.2, hinge - 0.15)
    right = (hinge + DOOR + 0.15, room[1] - 0.2)
    begin, end = left if left[1] - left[0] > right[1] - right[0] else right
    plan.line((begin, front), (end, front), "glass")
    return begin - origin, end - origin


def _furnish(plan: Plan, rng: np.random.Generator, x: Point, y: Point) -> None:
    """One or two desks (drawers and two legs), chairs, a cabinet, sometimes somebody sitting."""
    back, front = y
    inward = 1.0 if back > front else -1.0
    for _ in range(int(rng.integers(1, 3))):
        cx = float(rng.uniform(x[0] + 1.0, x[1] - 1.0))
        cy = back - inward * float(rng.uniform(0.6, 2.6))
        plan.box((cx - 0.5, cy), (0.42, 0.60), 0.0, "wood", top=0.7)
        for side in (-0.33, 0.33):
            plan.circle((cx + 0.7, cy + side), 0.03, "steel", top=0.7)
        plan.circle((cx + 0.1, cy - inward * 0.7), 0.04, "black", top=0.45)
        if rng.random() < 0.25:
            for side in (-0.12, 0.12):
                plan.circle((cx + 0.1 + side, cy - inward * 0.5), 0.07, "cloth", top=0.5)
    if rng.random() < 0.7:
        against = x[0] + 0.3 if rng.random() < 0.5 else x[1] - 0.3
        cy = back - inward * float(rng.uniform(1.0, ROOM_DEPTH - 1.6))
        plan.box((against, cy), (0.42, 0.9), 0.0, "black" if rng.random() < 0.2 else "wood", top=1.8)


def _walkers(people: int) -> tuple[Walker, ...]:
    """People in the corridors, on either side of the robot's lane."""
    west, middle, east = (0.5 * (a + b) for a, b in PASSAGES)
    paths: tuple[tuple[Point, ...], ...] = (
        ((3.0, SOUTH_Y + 0.5), (60.0, SOUTH_Y + 0.5)),
        ((6.0, NORTH_Y - 0.5), (58.0, NORTH_Y - 0.5)),
        ((middle + 0.5, SOUTH_Y), (middle + 0.5, NORTH_Y)),
        ((west - 0.5, SOUTH_Y), (west - 0.5, NORTH_Y), (20.0, NORTH_Y + 0.5)),
        ((east + 0.5, NORTH_Y), (east + 0.5, SOUTH_Y), (40.0, SOUTH_Y - 0.5)),
        ((12.0, SOUTH_Y - 0.5), (30.0, SOUTH_Y - 0.5)),
    )
    return tuple(
        Walker(paths[k % len(paths)], 0.9 + 0.1 * (k % 5), 5.0 * k, "black" if k % 3 == 2 else "cloth")
        for k in range(people)
    )

"""Places of the integrity runs, drawn by chance: rooms, symmetric ones, glass, corridors, an office; with routes.

A place is a world to see, lamps above it, routes through it that keep clear of everything, and people.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from tools.sim.building.buildings import corridor_loop
from tools.sim.building.office import office_floor
from tools.sim.building.people import Walker
from tools.sim.building.world import Array, Plan, Point, SimWorld
from tools.sim.ceiling.lamps import Fixture, fixtures, row, with_codes
from tools.sim.robot.drive import Route, smooth

CLEAR_M: Final = 0.42
"""The robot's centre keeps this far from everything."""
TRIES: Final = 200
Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A world, its lamps as planned, a way to draw a route through it, and people."""

    world: SimWorld
    lamps: tuple[Fixture, ...]
    route: Callable[[np.random.Generator], Route]
    walkers: tuple[Walker, ...] = ()


def room(rng: np.random.Generator, glass: bool = False, people: int = 0) -> Place:
    """A room of 8 to 14 by 7 to 11 m with furniture and columns; ``glass``: panes in up to three of its walls."""
    width, depth = float(rng.uniform(8.0, 14.0)), float(rng.uniform(7.0, 11.0))
    plan = Plan()
    panes = set(rng.permutation(4)[: int(rng.integers(1, 4))].tolist()) if glass else set()
    corners = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    for side, (a, b) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
        _side(plan, a, b, side in panes, rng)
    if panes:
        _outside(plan, width, depth, rng)
    for _ in range(int(rng.integers(3, 8))):
        size = (float(rng.uniform(0.4, 1.6)), float(rng.uniform(0.4, 0.9)))
        at = (float(rng.uniform(0.8, width - 0.8)), float(rng.uniform(0.8, depth - 0.8)))
        plan.box(at, size, float(rng.uniform(0.0, 3.1)), str(rng.choice(["wood", "cardboard", "black"])), top=1.2)
    for _ in range(int(rng.integers(0, 3))):
        plan.circle((float(rng.uniform(2.0, width - 2.0)), float(rng.uniform(2.0, depth - 2.0))), 0.2)
    return _indoors(plan, (0.0, 0.0, width, depth), rng, people)


def symmetric_room(rng: np.random.Generator) -> Place:
    """An empty room, square or not, with four columns: it looks the same from both ends, a square one from all four."""
    width = float(rng.uniform(8.0, 12.0))
    depth = width if rng.random() < 0.3 else float(rng.uniform(6.5, 10.0))
    plan = Plan()
    plan.outline([(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)])
    if rng.random() < 0.7:
        for x in (0.28 * width, 0.72 * width):
            for y in (0.28 * depth, 0.72 * depth):
                plan.circle((x, y), 0.25)
    return _indoors(plan, (0.0, 0.0, width, depth), rng, 0)


def corridor(rng: np.random.Generator) -> Place:
    """A plain corridor around a block: along its walls one metre looks like the next."""
    length, depth = float(rng.uniform(18.0, 40.0)), float(rng.uniform(12.0, 25.0))
    width = float(rng.uniform(1.9, 2.5))
    built = corridor_loop(length, depth, width)
    legs: list[Box] = [(0.0, 0.0, length, width), (0.0, depth - width, length, depth)]
    legs += [(x, width, x + width, depth - width) for x in (0.0, length - width)]
    lamps = with_codes([lamp for leg in legs for lamp in row(leg, 2.9, 2.9)])
    half = 0.5 * width
    corners = [(half, half), (length - half, half), (length - half, depth - half), (half, depth - half)]

    def route(own: np.random.Generator) -> Route:
        k = int(own.integers(0, 4))
        turned = corners[k:] + corners[:k]
        share = float(own.uniform(0.15, 0.85))
        (x0, y0), (x1, y1) = turned[-1], turned[0]
        begin = (x0 + share * (x1 - x0), y0 + share * (y1 - y0))
        ring = [begin, *turned]
        return Route(tuple(ring if own.random() < 0.5 else [begin, *reversed(turned)]), 1.8)

    return Place(built.world, lamps, route)


def office(rng: np.random.Generator) -> Place:
    """One of a few office floors, all doors of which look alike, driven along its corridors."""
    built, lamps = _floor(int(rng.integers(0, 2)))
    ring = list(built.route.corners)

    def route(own: np.random.Generator) -> Route:
        loops: tuple[tuple[Point, ...], ...] = ((*ring[0:1], *ring[1:5]), (ring[4], ring[3], ring[7], ring[8]))
        loop = list(loops[int(own.integers(0, len(loops)))])
        k = int(own.integers(0, len(loop)))
        loop = loop[k:] + loop[:k]
        share = float(own.uniform(0.2, 0.8))
        (x0, y0), (x1, y1) = loop[-1], loop[0]
        return Route(((x0 + share * (x1 - x0), y0 + share * (y1 - y0)), *loop), 1.6)

    return Place(built.world, lamps, route, built.people[:2] if rng.random() < 0.5 else ())


@cache
def _floor(seed: int) -> tuple[object, tuple[Fixture, ...]]:
    built = office_floor(seed)
    return built, fixtures(built)


def _side(plan: Plan, a: Point, b: Point, pane: bool, rng: np.random.Generator) -> None:
    """One wall of a room, with a pane in its middle or a niche somewhere."""
    begin, end = sorted(rng.uniform(0.1, 0.9, 2).tolist())
    if pane:
        begin, end = 0.2, float(rng.uniform(0.5, 0.85))
    at = [(a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])) for s in (begin, end)]
    plan.line(a, at[0])
    plan.line(at[1], b)
    plan.line(at[0], at[1], "glass" if pane else "wood" if rng.random() < 0.5 else "wall")


def _outside(plan: Plan, width: float, depth: float, rng: np.random.Generator) -> None:
    """What is seen through the panes."""
    for _ in range(6):
        angle = float(rng.uniform(0.0, 6.28))
        reach = float(rng.uniform(1.0, 6.0)) + 0.5 * float(np.hypot(width, depth))
        plan.circle((0.5 * width + reach * np.cos(angle), 0.5 * depth + reach * np.sin(angle)), 0.2, "wood")


def _indoors(plan: Plan, zone: Box, rng: np.random.Generator, people: int) -> Place:
    world = plan.build()
    lamps = with_codes(row(zone, 2.9, float(rng.uniform(2.3, 3.0))))
    walkers = tuple(
        Walker(
            tuple((float(rng.uniform(0.4, zone[2] - 0.4)), float(rng.uniform(0.4, zone[3] - 0.4))) for _ in range(4)),
            float(rng.uniform(0.5, 1.4)),
            float(rng.uniform(0.0, 20.0)),
            str(rng.choice(["cloth", "black"])),
        )
        for _ in range(people)
    )
    return Place(world, lamps, lambda own: wander(world, zone, own), walkers)


def wander(world: SimWorld, zone: Box, rng: np.random.Generator) -> Route:
    """A closed route through a room that keeps clear of everything; raises RuntimeError where there is none."""
    for attempt in range(TRIES):
        count = int(rng.integers(5, 9)) if attempt < TRIES // 2 else 4
        corners: list[Point] = []
        for _ in range(40):
            point = (float(rng.uniform(zone[0] + 0.7, zone[2] - 0.7)), float(rng.uniform(zone[1] + 0.7, zone[3] - 0.7)))
            far = not corners or np.hypot(point[0] - corners[-1][0], point[1] - corners[-1][1]) > 1.6
            if far and _clear(world, np.array([*corners[-1:], point])):
                corners.append(point)
            if len(corners) == count:
                break
        if len(corners) >= 4 and _clear(world, np.array([corners[-1], corners[0]])):
            route = Route(tuple(corners), 1.2)
            if float(world.clearance(smooth(route)[::10]).min()) > CLEAR_M:
                return route
    raise RuntimeError("no way through this room")


def _clear(world: SimWorld, line: Array) -> bool:
    s = np.linspace(0.0, 1.0, 30)[:, None]
    return bool(world.clearance(line[0] + s * (line[-1] - line[0])).min() > CLEAR_M + 0.1)

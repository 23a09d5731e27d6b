"""Where robots are switched on and carried about: a lit house, a symmetric room, free places in them, and short ways.

The house has seven rooms on a corridor, four of them of one shape, lamps 2 m apart over all of it, furniture along the
walls. The room is its own image when it is turned by a quarter. The lidar sees 270 deg with 361 beams, ten times a
second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.measurements import Beam, LightEpoch, Odometry, Scan
from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.building import Building
from tools.sim.building.people import Crowd, Walker
from tools.sim.building.world import Array, Plan, Point
from tools.sim.ceiling.ceiling import Ceiling, Effects
from tools.sim.ceiling.lamps import Fixture, Zone, row, with_codes
from tools.sim.ceiling.records import epochs, survey
from tools.sim.robot.drive import Body, Route

DEPTH, CORRIDOR, LENGTH, HEIGHT = 6.0, 2.0, 24.0, 3.0
SOUTH: Final = (0.0, 6.0, 12.0, 18.0, 24.0)
NORTH: Final = (0.0, 8.0, 16.0, 24.0)
DOOR_M: Final = 1.1
SPACING_M: Final = 2.4
BEAMS, PERIOD_S, SIGMA_M = 361, 0.1, 0.01
VIEW: Final = np.radians(270.0)
ODOMETRY_S: Final = 0.02
CLEARANCE_M: Final = 0.4
REACH: Final = np.tan(np.radians(52.0))
"""Lamps up to there from the vertical count as in view: the receiver's half field of view less its rim."""
BODY: Final = Body()

Poses = Callable[[Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A building with its lamps. ``rooms``: where robots may be put."""

    building: Building
    lamps: tuple[Fixture, ...]
    rooms: tuple[Zone, ...]


def lit_house(seed: int = 3, reused: bool = False) -> Place:
    """The house; with ``reused`` its lamps have 26 codes: every other room to the south repeats those of the first."""
    rng, plan = np.random.default_rng(seed), Plan()
    depth = 2.0 * DEPTH + CORRIDOR
    plan.outline([(0.0, 0.0), (LENGTH, 0.0), (LENGTH, depth), (0.0, depth)])
    corners: list[Point] = [(1.2, DEPTH + 0.7)]
    rooms: list[Zone] = []
    for edges, y0, y1, front in ((SOUTH, 0.0, DEPTH, DEPTH), (NORTH, DEPTH + CORRIDOR, depth, DEPTH + CORRIDOR)):
        inner = [(a, y0, b, y1) for a, b in pairwise(edges)]
        doors = [0.5 * (a + b) + float(rng.uniform(-1.0, 1.0)) for a, _, b, _ in inner]
        gaps = [(x - 0.5 * DOOR_M, x + 0.5 * DOOR_M) for x in doors]
        plan.wall((0.0, front), (LENGTH, front), gaps=gaps)
        for x in edges[1:-1]:
            plan.wall((x, y0), (x, y1))
        ordered = list(zip(inner, doors, strict=True))
        for room, door in ordered if front == DEPTH else ordered[::-1]:
            corners += tour_of(room, door, front)
            furnish(plan, rng, room, front)
        rooms += inner
    corners += [(1.2, DEPTH + CORRIDOR - 0.7)]
    hall: Zone = (0.0, DEPTH, LENGTH, DEPTH + CORRIDOR)
    lamps = [lamp for zone in (*rooms, hall) for lamp in row(zone, HEIGHT - 0.1, SPACING_M)]
    building = Building("lit_house", plan.build(), Route(tuple(corners), 0.8), (), HEIGHT)
    coded = with_codes(lamps)
    return Place(building, again(coded, rooms) if reused else coded, (*rooms, hall))


def again(lamps: tuple[Fixture, ...], rooms: list[Zone]) -> tuple[Fixture, ...]:
    """The same lamps with codes by their place in the room: rooms of one row send what the room two doors on sends."""
    count: dict[Zone, int] = {}
    made = []
    for lamp in lamps:
        number = count.get(lamp.zone, 0)
        count[lamp.zone] = number + 1
        index = rooms.index(lamp.zone) if lamp.zone in rooms else len(rooms)
        base = 9 * (index % 2) if index < 4 else 18 + 12 * (index % 2) if index < len(rooms) else 42
        made.append(replace(lamp, code=base + number))
    return tuple(made)


def tour_of(room: Zone, door: float, front: float) -> list[Point]:
    """Corners of a way from the corridor round a room and out again."""
    x0, y0, x1, y1 = room
    south = front == y1
    lane = front + (0.7 if south else -0.7)
    near, far = (y1 - 1.5, y0 + 1.7) if south else (y0 + 1.5, y1 - 1.7)
    west, east = x0 + 1.5, x1 - 1.5
    return [
        (door, lane),
        (door, near),
        (west, near),
        (west, far),
        (east, far),
        (east, near),
        (door, near),
        (door, lane),
    ]


def furnish(plan: Plan, rng: np.random.Generator, room: Zone, front: float) -> None:
    """Cupboards along the walls and a round bin: no two rooms have the same."""
    x0, y0, x1, y1 = room
    back = y0 if front == y1 else y1
    inward = 1.0 if back == y0 else -1.0
    for side in (x0, x1):
        for _ in range(int(rng.integers(1, 3))):
            deep, wide = float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.5, 1.6))
            x = side + (0.5 * deep + 0.06 if side == x0 else -0.5 * deep - 0.06)
            plan.box((x, float(rng.uniform(y0 + 1.2, y1 - 1.2))), (deep, wide), 0.0, "wood", top=1.8)
    for _ in range(int(rng.integers(1, 4))):
        deep, wide = float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.6, 1.4))
        at = float(rng.uniform(x0 + 0.9, x1 - 0.9)), back + inward * 0.5 * deep
        plan.box(at, (wide, deep), 0.0, "wood", top=0.9)
    at = float(rng.uniform(x0 + 0.4, x1 - 0.4)), back + inward * float(rng.uniform(0.3, 0.6))
    plan.circle(at, 0.15, "black", 0.6)


def symmetric_room(half: float = 4.0) -> Place:
    """A square room with a column in each quarter: turned by a quarter it is the same."""
    plan = Plan()
    plan.outline([(-half, -half), (half, -half), (half, half), (-half, half)])
    for x in (-1.8, 1.8):
        for y in (-1.8, 1.8):
            plan.circle((x, y), 0.25)
    zone: Zone = (-half, -half, half, half)
    route = Route(((0.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0), (-3.0, -3.0), (0.0, -3.0), (0.0, 3.0)), 0.8)
    building = Building("symmetric_room", plan.build(), route, (), HEIGHT)
    return Place(building, with_codes(row(zone, HEIGHT - 0.1, SPACING_M)), (zone,))


@dataclass(eq=False)
class Site:
    """A place with light in it. ``effects``: how far the lamps depart from the plan; seed: of that, and of noise."""

    place: Place
    effects: Effects
    seed: int

    @cached_property
    def ceiling(self) -> Ceiling:
        """Its lamps."""
        building = self.place.building
        return Ceiling(self.place.lamps, building.world, building.height_m, self.effects, seed=self.seed)

    @cached_property
    def survey(self) -> Survey:
        """What the robot is told of them."""
        return survey(self.ceiling)

    @cached_property
    def _scanner(self) -> Scanner:
        bearing = np.linspace(-0.5 * VIEW, 0.5 * VIEW, BEAMS)
        return Scanner(self.place.building.world, Sweep(bearing, 0.0, 0.075), UTM_30LX, self.seed)

    @cached_property
    def free(self) -> Array:
        """(n, 2) places a quarter of a metre apart at which a robot can stand."""
        cells = [
            np.stack(np.meshgrid(np.arange(x0 + 0.2, x1, 0.25), np.arange(y0 + 0.2, y1, 0.25)), axis=-1).reshape(-1, 2)
            for x0, y0, x1, y1 in self.place.rooms
        ]
        at = np.vstack(cells)
        some = self.place.building.world.clearance(at) > CLEARANCE_M
        return np.asarray(at[some])

    def scan(self, k: int, poses: Poses, crowd: Crowd) -> Scan:
        """Revolution ``k``."""
        t, scanner = k * PERIOD_S, self._scanner
        legs = crowd.legs(t, poses(np.array([t]))[0])
        seen = scanner.measure(t, lambda at: lidar(poses(at)), legs, Posture(BODY.height, BODY.tilt, 0.0))
        reach = 1e-3 * np.rint(1e3 * seen.range_m[:, 0])
        reach = np.where((reach >= 0.02) & (reach <= 30.0), reach, 0.0)
        beam = np.where(reach > 0.0, np.uint8(Beam.HIT), np.uint8(Beam.NONE))
        sweep = scanner.sweep
        return Scan(t, t + sweep.sweep_s, k, np.array(BODY.lidar), sweep.bearing_rad, reach, beam, SIGMA_M)

    def light(self, poses: Poses, span: tuple[float, float], seed: int) -> Iterator[LightEpoch]:
        """What the decoder says on a way."""
        return epochs(self.ceiling, poses, span, seed)

    def codes_at(self, at: Array) -> list[frozenset[int]]:
        """The codes in view at (n, 2) places: of lamps in the same room that are not near the edge of view."""
        out = []
        for x, y in at.tolist():
            out.append(
                frozenset(
                    lamp.code
                    for lamp in self.place.lamps
                    if lamp.zone[0] <= x <= lamp.zone[2]
                    and lamp.zone[1] <= y <= lamp.zone[3]
                    and np.hypot(lamp.x - x, lamp.y - y) < (lamp.z - BODY.height) * REACH
                )
            )
        return out

    @cached_property
    def _views(self) -> dict[frozenset[int], Array]:
        views: dict[frozenset[int], list[list[float]]] = {}
        for at, codes in zip(self.free.tolist(), self.codes_at(self.free), strict=True):
            views.setdefault(codes, []).append(at)
        return {codes: np.array(at) for codes, at in views.items()}

    def unique(self, at: Array) -> bool:
        """Whether the set of codes in view at a place is that of no other part of the building."""
        codes = self.codes_at(at[None])[0]
        others = self._views.get(codes)
        return others is None or bool(np.all(np.hypot(*(others - at).T) < 4.0))


def lidar(poses: Array) -> Array:
    """(n, 3) poses of the lidar of a robot at (n, 3) poses."""
    x, y, yaw = BODY.lidar
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.column_stack([poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y, poses[:, 2] + yaw])


@dataclass(frozen=True, slots=True, eq=False)
class Stroll:
    """A short way: at rest at ``begin`` (x, y, yaw) for ``rest_s``, then at constant speed and turn rate."""

    begin: Array
    speed: float
    turn: float
    rest_s: float = 0.0

    def at(self, t: Array) -> Array:
        """(n, 3) poses at (n,) times since its begin."""
        t = np.maximum(np.asarray(t, dtype=float) - self.rest_s, 0.0)
        x, y, yaw = self.begin
        if abs(self.turn) < 1e-9:
            return np.column_stack([x + self.speed * t * np.cos(yaw), y + self.speed * t * np.sin(yaw), yaw + 0.0 * t])
        now, r = yaw + self.turn * t, self.speed / self.turn
        return np.column_stack([x + r * (np.sin(now) - np.sin(yaw)), y - r * (np.cos(now) - np.cos(yaw)), now])


def stroll(site: Site, rng: np.random.Generator, seconds: float, moving: bool) -> Stroll:
    """A random way of that length on which nothing is run into, with three lamps in view where it begins."""
    world = site.place.building.world
    while True:
        at = site.free[rng.integers(len(site.free))] + rng.uniform(-0.1, 0.1, 2)
        begin = np.array((*at, rng.uniform(-np.pi, np.pi)))
        speed = float(rng.uniform(0.1, 0.4)) if moving else 0.0
        turn = float(rng.uniform(-0.5, 0.5)) if moving else 0.0
        way = Stroll(begin, speed, turn)
        some = way.at(np.arange(0.0, seconds, 0.2))[:, :2]
        if len(site.codes_at(at[None])[0]) >= 3 and np.all(world.clearance(some) > 0.3):
            return way


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """A way, then being lifted and carried straight to another place, then a way there.

    Attributes:
        first, second: the two ways. t_up, t_down: when it is lifted and put down, s.
    """

    first: Stroll
    second: Stroll
    t_up: float
    t_down: float

    def at(self, t: Array) -> Array:
        """(n, 3) true poses at (n,) times."""
        t = np.asarray(t, dtype=float)
        before, after = self.first.at(np.minimum(t, self.t_up)), self.second.at(np.maximum(t - self.t_down, 0.0))
        share = np.clip((t - self.t_up) / max(self.t_down - self.t_up, 1e-9), 0.0, 1.0)[:, None]
        return np.asarray((1.0 - share) * before + share * after)

    def rolled(self, t: Array) -> Array:
        """(n, 3) poses as the wheels count them: being carried is no motion."""
        t = np.asarray(t, dtype=float)
        before, up = self.first.at(np.minimum(t, self.t_up)), self.first.at(np.array([self.t_up]))[0]
        after, down = self.second.at(np.maximum(t - self.t_down, 0.0)), self.second.begin
        turn = up[2] - down[2]
        c, s = np.cos(turn), np.sin(turn)
        x, y = (after[:, :2] - down[:2]).T
        moved = np.column_stack([up[0] + c * x - s * y, up[1] + s * x + c * y, after[:, 2] + turn])
        return np.where((t >= self.t_down)[:, None], moved, before)


def odometry(rolled: Poses, span: tuple[float, float], rng: np.random.Generator) -> Iterator[Odometry]:
    """What wheels say of it, half a percent off and with noise."""
    t = np.arange(span[0], span[1] + 1e-9, ODOMETRY_S)
    poses = rolled(t)
    off = 1.0 + 0.005 * rng.standard_normal(2)
    for k in range(1, len(t)):
        c, s = np.cos(poses[k - 1, 2]), np.sin(poses[k - 1, 2])
        dx, dy = poses[k, :2] - poses[k - 1, :2]
        turned = poses[k, 2] - poses[k - 1, 2]
        way = np.hypot(dx, dy)
        noise = 0.003 * np.sqrt(way) * rng.standard_normal(2)
        delta = np.array(((c * dx + s * dy) * off[0] + noise[0], c * dy - s * dx, turned * off[1] + noise[1]))
        yield Odometry(float(t[k - 1]), float(t[k]), delta)


def person(rng: np.random.Generator, near: Array) -> tuple[Walker, ...]:
    """Somebody who walks up and down some metres from a place, or nobody."""
    if rng.random() < 0.5:
        return ()
    angle, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.0, 2.0)
    x, y = near[:2] + away * np.array((np.cos(angle), np.sin(angle)))
    u, v = rng.uniform(-1.5, 1.5, 2)
    return (Walker(((x - u, y - v), (x + u, y + v)), 0.8),)


__all__ = ["Carried", "Place", "Site", "Stroll", "lit_house", "odometry", "person", "stroll", "symmetric_room"]

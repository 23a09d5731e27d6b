"""Link-level drives for experiments with light: odometry and light epochs in order of time, with the truth.

::

    run = room_run(Effects(gain_spread=0.15), seed=3)
    for record in run.records(): ...            # Odometry and LightEpoch
    run.truth(t), run.survey, run.ceiling
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from heapq import merge
from typing import Final

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.measurements import LightEpoch, Odometry
from tools.sim.building.building import Building
from tools.sim.building.buildings import building
from tools.sim.building.people import Walker
from tools.sim.building.world import SimWorld
from tools.sim.ceiling.ceiling import Array, Ceiling, Effects, ceiling_of, paper_ceiling
from tools.sim.ceiling.links import Reception
from tools.sim.ceiling.movers import lean_of, walkers_of
from tools.sim.ceiling.records import epochs, survey
from tools.sim.robot.drive import Body, Drive, Route
from tools.sim.robot.odometry import Odometer, Wheels

ROOM_ROUTE: Final = Route(
    (
        (-3.6, -3.6), (3.6, -3.6), (4.2, -1.1), (-3.6, -1.1), (-4.2, 1.1), (3.6, 1.1), (3.6, 3.7), (-3.6, 3.7),
        (-3.6, -3.3), (-1.1, -4.2), (-1.1, 4.2), (1.1, 3.7), (1.1, -4.2), (3.7, -3.7), (3.7, 3.7), (0.0, 4.3),
        (0.0, 0.0), (-4.3, 0.0), (-4.3, -3.6), (0.0, -4.3), (0.0, -1.1), (1.1, 1.1), (4.3, 0.0), (4.3, -4.3),
        (0.0, -3.6), (0.0, 3.6), (-3.9, 3.9), (-3.4, 0.6), (3.5, -0.5), (3.4, 3.3), (-1.0, 3.2), (-1.0, -2.6),
        (0.6, -2.6), (0.6, 1.7), (-3.7, 0.2),
    ),
    1.2,
)  # fmt: skip
"""About 160 m up and down and across the paper's room, between its columns and within 0.5 m of its walls."""
ROOM_BODY: Final = Body(speed=0.54)
ROOM_WALKERS: Final = (
    Walker(((-4.3, -4.5), (4.3, -4.5), (4.5, 4.3)), 0.9, 3.0),
    Walker(((-2.9, 4.4), (0.4, 0.6), (3.0, -2.9)), 1.1, 5.0, "black"),
)


@dataclass(frozen=True, slots=True, eq=False)
class LightRun:
    """One drive under a ceiling.

    Attributes:
        drive: the truth. ceiling: of the building. survey: what the robot is told of it. odometer: its wheels.
        seconds: length. reception: noise of the receiver.
    """

    drive: Drive
    ceiling: Ceiling
    survey: Survey
    wheels: Wheels
    world: SimWorld
    seed: int
    seconds: float
    reception: Reception

    def truth(self, t: Array) -> Array:
        """(n, 3) true poses T_map_base at (n,) times."""
        return self.drive.pose(np.asarray(t, dtype=float))

    def odometry(self) -> Iterator[Odometry]:
        """Increments from reading to reading."""
        odometer, rate = Odometer(self.drive, self.world, self.wheels, self.seed), self.wheels.rate_hz
        before = odometer.reading(0)
        for k in range(1, int(self.seconds * rate) + 1):
            now = odometer.reading(k)
            c, s = np.cos(before[2]), np.sin(before[2])
            dx, dy = now[:2] - before[:2]
            yield Odometry((k - 1) / rate, k / rate, np.array([c * dx + s * dy, c * dy - s * dx, now[2] - before[2]]))
            before = now

    def light(self) -> Iterator[LightEpoch]:
        """One epoch every 50 ms."""
        return epochs(self.ceiling, self.drive.pose, (0.0, self.seconds), self.seed, self.reception)

    def records(self) -> Iterator[Odometry | LightEpoch]:
        """Both, ordered by the end of their interval."""
        return merge(self.odometry(), self.light(), key=lambda record: record.t_end)

    def dead_reckoning(self) -> Array:
        """(n, 3) poses from the true start on odometry alone, one a reading."""
        return dead_reckoning(self.drive, self.world, self.wheels, self.seed, self.seconds)


def dead_reckoning(drive: Drive, world: SimWorld, wheels: Wheels, seed: int, seconds: float) -> Array:
    """(n, 3) poses from the true start on odometry alone, one a reading."""
    odometer = Odometer(drive, world, wheels, seed)
    read = np.array([odometer.reading(k) for k in range(int(seconds * wheels.rate_hz) + 1)])
    x, y, yaw = drive.pose(np.zeros(1))[0]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([x + c * read[:, 0] - s * read[:, 1], y + s * read[:, 0] + c * read[:, 1], yaw + read[:, 2]])


def sized_wheels(drive: Drive, world: SimWorld, seed: int, off_m: float, wheels: Wheels | None = None) -> Wheels:
    """Wheels of which dead reckoning ends about ``off_m`` off after the drive: the seed's errors, scaled together."""
    wheels, size = wheels or Wheels(), 0.3
    end = drive.pose(np.array([drive.lap_s]))[0, :2]
    for _ in range(8):
        trial = scaled(wheels, size)
        off = float(np.hypot(*(dead_reckoning(drive, world, trial, seed, drive.lap_s)[-1, :2] - end)))
        if abs(off - off_m) < 0.05 * off_m:
            break
        size *= float(np.clip(off_m / max(off, 1e-3), 0.4, 2.5))
    return trial


def scaled(wheels: Wheels, size: float) -> Wheels:
    """Wheels with all errors but ticks that many times as large."""
    return replace(
        wheels,
        scale=size * wheels.scale,
        base_scale=size * wheels.base_scale,
        noise=size * wheels.noise,
        slip_m=size * wheels.slip_m,
    )


def room_run(effects: Effects | None = None, seed: int = 0, off_m: float = 1.5, people: int = 2) -> LightRun:
    """The paper's room, 160 m in some 320 s under its 16 lamps; dead reckoning ends about ``off_m`` off."""
    place = building("paper_room")
    ceiling = paper_ceiling(effects, seed)
    drive = Drive(ROOM_ROUTE, ROOM_BODY, 2.0, 1)
    ceiling.lean, ceiling.movers = lean_of(drive), walkers_of(ROOM_WALKERS[:people])
    wheels = sized_wheels(drive, place.world, seed, off_m)
    return LightRun(drive, ceiling, survey(ceiling), wheels, place.world, seed, drive.lap_s, Reception())


def tour_run(
    name: str,
    effects: Effects | None = None,
    seed: int = 0,
    wheels: Wheels | None = None,
    place: Building | None = None,
) -> LightRun:
    """The tour of a building under all its lamps."""
    place = place or building(name)
    ceiling = ceiling_of(place, effects, seed)
    drive = Drive(place.route, Body(), 2.0, 1)
    ceiling.lean, ceiling.movers = lean_of(drive), walkers_of(place.people)
    wheels = wheels or Wheels()
    return LightRun(drive, ceiling, survey(ceiling), wheels, place.world, seed, drive.lap_s, Reception())

"""Sensors that lie plausibly, in the simulator: who notices, how soon, and is the pose wrong meanwhile?

A robot drives through a room for a minute, under lamps or by laser and wheels alone. From :data:`SINCE` to
:data:`UNTIL` one of its sensors lies; a survey is wrong from the start, and a mount that was turned stays so.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from daemon.health.faults import Fault
from estimator.light_filter.survey import Lamp, Survey
from estimator.numerics import se2
from hal.imu import RawImu
from hal.lidar import RawScan
from hal.odometry import RawOdometry
from tools.experiments.belief.replays import Watcher
from tools.experiments.integrity.report import Found, judged
from tools.experiments.integrity.run import arrivals, robot_of, row
from tools.experiments.integrity.scene import Scenario, draw
from tools.sim.building.world import Array
from tools.sim.robot.truth import in_map

SINCE, UNTIL = 25.0, 50.0
"""While a sensor lies, s."""
IMU_S: Final = 0.02
Arrival = tuple[float, object]
Change = Callable[[list[Arrival], Scenario], list[Arrival]]

LIDAR: Final = tuple(fault for fault in Fault if 101 <= fault <= 110)
SURVEY: Final = (Fault.NO_LAMPS, Fault.SURVEY_CONTRADICTED, Fault.TWIN_LAMPS, Fault.LAMP_MOVED, Fault.LAMP_DEAD)
ODOMETRY: Final = tuple(fault for fault in Fault if 201 <= fault <= 205)
GYRO: Final = (Fault.GYRO_SCALE,)


@dataclass(frozen=True, slots=True)
class Lie:
    """A sensor that lies.

    Attributes:
        change: of all that arrives. scene: of the scenario itself. culprits: faults that name the sensor.
        lit: whether there are lamps, in the cases that are run.
    """

    culprits: tuple[Fault, ...]
    change: Change | None = None
    scene: Callable[[Scenario], None] | None = None
    lit: tuple[bool, ...] = (True, False)


def on(one: RawScan | RawOdometry) -> bool:
    """Whether the sensor lies by then."""
    return SINCE <= one.t_mono < UNTIL


def scans(change: Callable[[RawScan, list[RawScan]], RawScan], late_s: float = 0.0) -> Change:
    """A lidar that lies; ``change`` gets a scan and all scans so far, itself the last."""

    def changed(told: list[Arrival], scene: Scenario) -> list[Arrival]:
        so_far: list[RawScan] = []
        out: list[Arrival] = []
        for t, thing in told:
            if isinstance(thing, RawScan):
                so_far.append(thing)
                out.append((t + late_s * on(thing), change(thing, so_far) if on(thing) else thing))
            else:
                out.append((t, thing))
        return sorted(out, key=lambda one: one[0])

    return changed


def seen_in(scan: RawScan, other: RawScan, order: slice = slice(None)) -> RawScan:
    """A scan with what another one has seen."""
    return replace(scan, ranges=other.ranges[order].copy(), code=other.code[order].copy())


def frozen(scan: RawScan, so_far: Sequence[RawScan]) -> RawScan:
    """The scan of the moment in which it froze, again and again."""
    return seen_in(scan, next(one for one in so_far if on(one)))


def old(seconds: float) -> Callable[[RawScan, list[RawScan]], RawScan]:
    """A buffer that does not empty: what was seen some time ago, with the stamps of now."""
    return lambda scan, so_far: seen_in(scan, next(one for one in so_far if one.t_mono >= scan.t_mono - seconds))


def late(seconds: float) -> Change:
    """Stamped at a late arrival."""
    return scans(lambda scan, _: replace(scan, t_mono=scan.t_mono + seconds, t_rx=scan.t_rx + seconds), seconds)


def scaled(factor: float) -> Callable[[RawScan, list[RawScan]], RawScan]:
    """Ranges in a wrong unit of length, nearly."""
    return lambda scan, _: replace(scan, ranges=np.rint(factor * scan.ranges).astype(np.int32))


def steps(change: Callable[[Array], Sequence[float]]) -> Change:
    """Odometry that measures other steps (ahead, left, turn) than the wheels make."""

    def changed(told: list[Arrival], scene: Scenario) -> list[Arrival]:
        before: Array | None = None
        pose = se2.identity()
        out: list[Arrival] = []
        for t, thing in told:
            if isinstance(thing, RawOdometry):
                now = np.array((thing.x, thing.y, thing.yaw))
                if before is None:
                    pose = now
                else:
                    step = se2.between(before, now)
                    pose = se2.compose(pose, np.asarray(change(step) if on(thing) else step, float))
                before = now
                thing = replace(thing, x=float(pose[0]), y=float(pose[1]), yaw=float(pose[2]))
            out.append((t, thing))
        return out

    return changed


def gyro(change: Callable[[float], float]) -> Change:
    """A gyro beside the wheels, right until it lies."""

    def changed(told: list[Arrival], scene: Scenario) -> list[Arrival]:
        t = np.arange(1.0, scene.seconds - 1.0, IMU_S)
        yaw = np.unwrap(scene.pose(t)[:, 2])
        rate = np.gradient(yaw, IMU_S).tolist()
        turns = [change(one) if SINCE <= at < UNTIL else one for at, one in zip(t.tolist(), rate, strict=True)]
        more = [(at + 0.004, RawImu(at + 0.004, at, turn)) for at, turn in zip(t.tolist(), turns, strict=True)]
        return sorted([*told, *more], key=lambda one: one[0])

    return changed


def surveyed(change: Callable[[Survey, Scenario], Iterable[Lamp]]) -> Callable[[Scenario], None]:
    """A survey of another building than this one."""

    def changed(scene: Scenario) -> None:
        assert scene.told is not None
        scene.told = replace(scene.told, lamps=tuple(change(scene.told, scene)))

    return changed


def mirrored(told: Survey, scene: Scenario) -> Iterable[Lamp]:
    """Left is right: a plan read from above and below."""
    width = min(lamp.x for lamp in told.lamps) + max(lamp.x for lamp in told.lamps)
    return (replace(lamp, x=width - lamp.x) for lamp in told.lamps)


def permuted(told: Survey, scene: Scenario) -> Iterable[Lamp]:
    """Lamps hang in the right places, with each other's codes."""
    order = np.random.default_rng(scene.seed).permutation(len(told.lamps)).tolist()
    at = [(told.lamps[k].x, told.lamps[k].y, told.lamps[k].z) for k in order]
    return (replace(lamp, x=x, y=y, z=z) for lamp, (x, y, z) in zip(told.lamps, at, strict=True))


def knocked(degrees: float, degrees_per_s: float = 0.0) -> Callable[[Scenario], None]:
    """The mount is turned at once, or turns on and on."""

    def changed(scene: Scenario) -> None:
        scene.mount = (SINCE, math.inf, math.radians(degrees), math.radians(degrees_per_s))

    return changed


def left_dead(step: Array) -> Sequence[float]:
    """The left encoder is dead, on a track of 0.4 m."""
    right = step[0] + 0.2 * step[2]
    return 0.5 * right, step[1], right / 0.4


LIES: Final = {
    "lidar frozen": Lie(LIDAR, scans(frozen)),
    "lidar mirrored": Lie(LIDAR, scans(lambda scan, _: seen_in(scan, scan, slice(None, None, -1)))),
    "lidar 0.3 s late": Lie(LIDAR, late(0.3)),
    "lidar 3 s old": Lie(LIDAR, scans(old(3.0))),
    "lidar swapped": Lie(LIDAR, scans(old(20.0))),
    "lidar +20 %": Lie(LIDAR, scans(scaled(1.2))),
    "lidar turned 6 deg": Lie(LIDAR, scene=knocked(6.0)),
    "lidar turned 10 deg": Lie(LIDAR, scene=knocked(10.0)),
    "lidar loose 0.5 deg/s": Lie(LIDAR, scene=knocked(0.0, 0.5)),
    "survey mirrored": Lie(SURVEY, scene=surveyed(mirrored), lit=(True,)),
    "survey permuted": Lie(SURVEY, scene=surveyed(permuted), lit=(True,)),
    "survey 0.6 m low": Lie(
        SURVEY, scene=surveyed(lambda told, _: (replace(lamp, z=lamp.z - 0.6) for lamp in told.lamps)), lit=(True,)
    ),
    "odometry backwards": Lie(ODOMETRY, steps(lambda step: (-step[0], step[1], step[2]))),
    "odometry turns inverted": Lie(ODOMETRY, steps(lambda step: (step[0], step[1], -step[2]))),
    "odometry left wheel dead": Lie(ODOMETRY, steps(left_dead)),
    "odometry in mm": Lie(ODOMETRY, steps(lambda step: (1e3 * step[0], 1e3 * step[1], step[2]))),
    "odometry turns in deg": Lie(ODOMETRY, steps(lambda step: (step[0], step[1], math.degrees(step[2])))),
    "odometry -30 %": Lie(ODOMETRY, steps(lambda step: (0.7 * step[0], 0.7 * step[1], step[2]))),
    "odometry turns 10 deg/s": Lie(ODOMETRY, steps(lambda step: (step[0], step[1], step[2] + math.radians(0.5)))),
    "odometry zero": Lie(ODOMETRY, steps(lambda step: (0.0, 0.0, 0.0))),
    "gyro in deg/s": Lie(GYRO, gyro(math.degrees)),
    "gyro inverted": Lie(GYRO, gyro(lambda rate: -rate)),
    "gyro bias 0.3 rad/s": Lie(GYRO, gyro(lambda rate: rate + 0.3)),
    "gyro stuck at 0.5 rad/s": Lie(GYRO, gyro(lambda rate: 0.5)),
}


@dataclass(frozen=True, slots=True)
class Case:
    """A lie, with or without lamps, and the seed of room and drive."""

    lie: str
    lit: bool
    seed: int


@dataclass(frozen=True, slots=True)
class Told:
    """What came of it.

    Attributes:
        found: verdict of the cycles from the beginning of the lie on. named: seconds from then until a fault has named
            the sensor; infinite: none has. other: fault that was present first while none had, 0: none.
    """

    case: Case
    found: Found
    named: float
    other: int
    mount: tuple[tuple[float, float, float, float], ...] = ()

    @property
    def lied(self) -> bool:
        """TRACKING and wrong for longer than is allowed."""
        return self.found.wrong


def scene_of(case: Case) -> Scenario:
    """The drive; raises RuntimeError where the room that was drawn is too full to drive in."""
    scene = draw("clean_lit" if case.lit else "clean_unlit", case.seed)
    scene.wheels = True
    return scene


def told(case: Case) -> Told | None:
    """Run one case; None where nothing can drive in the room that was drawn."""
    logging.disable(logging.CRITICAL)
    lie = LIES[case.lie]
    try:
        scene = scene_of(case)
    except RuntimeError:
        return None
    if lie.scene is not None:
        lie.scene(scene)
    watcher, rows = followed(scene, lie.change)
    begun = 0.0 if case.lie.startswith("survey") else SINCE
    late = rows[rows[:, 0] >= begun]
    seen = {fault: [t for t in times if t >= begun] for fault, times in watcher.faults.items()}
    first = {fault: times[0] - begun for fault, times in seen.items() if times and fault != Fault.PROTECTION_ALERT}
    named = min((t for fault, t in first.items() if fault in lie.culprits), default=math.inf)
    other = min((t, fault) for fault, t in [*first.items(), (0, math.inf)] if fault not in lie.culprits)
    found = judged(f"{case.lie}-{case.seed}", late, np.zeros((0, 2)), (case.lit, False, ""))
    return Told(case, found, named, other[1] if other[0] < named else 0, tuple(watcher.mount))


def followed(scene: Scenario, change: Change | None = None) -> tuple[Watcher, Array]:
    """A scenario through the daemon's cycle: its faults, and rows as :data:`integrity.run.COLUMNS`."""
    robot, watcher = robot_of(scene), Watcher()
    told = list(arrivals(scene))
    rows: list[list[float]] = []
    anchor: tuple[Array, Array] | None = None
    for arrived in told if change is None else change(told, scene):
        snapshot = robot.take(arrived)
        if snapshot is None:
            continue
        watcher.look(robot.cycle, snapshot.t_sent)
        if snapshot.pose is None:
            continue
        site, result = scene.pose(np.array([snapshot.t_mono]))[0], robot.cycle.result
        anchor = anchor or (site, np.array(snapshot.pose))
        placed = result is not None and result.placed
        rows.append(row(snapshot, site if placed else in_map(site, *anchor)))
    return watcher, np.array(rows)

"""Sensors that lie plausibly, in the simulator: who notices, how soon, and is the pose wrong meanwhile?

A robot drives through a room for a minute, under lamps or by laser and wheels alone. From 25 to 50 s one of its sensors
lies; a survey is wrong from the start, and a mount that was turned stays so.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, Final

import numpy as np

from daemon.health.faults import Fault
from estimator.light_filter.survey import Lamp
from estimator.numerics import se2
from hal.imu import RawImu
from hal.lidar import RawScan
from hal.odometry import RawOdometry
from tools.experiments.belief.replays import Watcher, quiet
from tools.experiments.integrity.report import Found, judged
from tools.experiments.integrity.run import arrivals, robot_of, row
from tools.experiments.integrity.scene import Scenario, draw
from tools.sim.building.world import Array
from tools.sim.robot.truth import in_map

SINCE, UNTIL = 25.0, 50.0
"""While a sensor lies, s."""
Arrival = tuple[float, Any]
Change = Callable[[list[Arrival], Scenario], list[Arrival]]
Lidar = Callable[[RawScan, list[RawScan]], RawScan]
"""Returns the scan that replaces the given one; the second argument has all scans so far, that one the last."""

LIDAR: Final = tuple(fault for fault in Fault if 101 <= fault <= 110)
SURVEY: Final = tuple(fault for fault in Fault if 171 <= fault <= 175)
ODOMETRY: Final = tuple(fault for fault in Fault if 201 <= fault <= 205)
GYRO: Final = (Fault.GYRO_SCALE,)


@dataclass(frozen=True, slots=True)
class Lie:
    """A sensor that lies.

    Attributes:
        culprits: faults that name the sensor. change: of all that arrives. scene: of the scenario itself.
    """

    culprits: tuple[Fault, ...]
    change: Change | None = None
    scene: Callable[[Scenario], None] | None = None

    @property
    def lit(self) -> tuple[bool, ...]:
        """With lamps, without: a survey lies where there are lamps."""
        return (True,) if self.culprits == SURVEY else (True, False)


def _lidar(change: Lidar, late_s: float = 0.0) -> Lie:
    def changed(stream: list[Arrival], scene: Scenario) -> list[Arrival]:
        so_far: list[RawScan] = []
        out: list[Arrival] = []
        for t, thing in stream:
            if isinstance(thing, RawScan):
                so_far.append(thing)
                if SINCE <= thing.t_mono < UNTIL:
                    t, thing = t + late_s, change(thing, so_far)
            out.append((t, thing))
        return sorted(out, key=itemgetter(0))

    return Lie(LIDAR, changed)


def _seen_in(other: Callable[[RawScan, list[RawScan]], RawScan], order: slice = slice(None)) -> Lidar:
    """A scan with what another one has seen, chosen by ``other``."""

    def change(scan: RawScan, so_far: list[RawScan]) -> RawScan:
        seen = other(scan, so_far)
        return replace(scan, ranges=seen.ranges[order].copy(), code=seen.code[order].copy())

    return change


def _old(seconds: float) -> Lidar:
    """A buffer that does not empty: what was seen some time ago, with the stamps of now."""
    return _seen_in(lambda scan, so_far: next(one for one in so_far if one.t_mono >= scan.t_mono - seconds))


def _knocked(degrees: float, degrees_per_s: float = 0.0) -> Lie:
    """The mount is turned at once, or turns on and on."""

    def changed(scene: Scenario) -> None:
        scene.mount = (SINCE, math.radians(degrees), math.radians(degrees_per_s))

    return Lie(LIDAR, scene=changed)


def _survey(change: Callable[[tuple[Lamp, ...], int], Sequence[Lamp]]) -> Lie:
    """A survey of other lamps than these; ``change`` gets them and a seed."""

    def changed(scene: Scenario) -> None:
        assert scene.told is not None
        scene.told = replace(scene.told, lamps=tuple(change(scene.told.lamps, scene.seed)))

    return Lie(SURVEY, scene=changed)


def _mirrored(lamps: tuple[Lamp, ...], seed: int) -> Sequence[Lamp]:
    ends = min(lamp.x for lamp in lamps) + max(lamp.x for lamp in lamps)
    return [replace(lamp, x=ends - lamp.x) for lamp in lamps]


def _permuted(lamps: tuple[Lamp, ...], seed: int) -> Sequence[Lamp]:
    order = np.random.default_rng(seed).permutation(len(lamps)).tolist()
    return [replace(lamps[k], lamp_id=lamp.lamp_id, code=lamp.code) for k, lamp in zip(order, lamps, strict=True)]


def _odometry(change: Callable[[float, float, float], Sequence[float]]) -> Lie:
    """Odometry that measures other steps (ahead, left, turn) than the wheels make."""

    def changed(stream: list[Arrival], scene: Scenario) -> list[Arrival]:
        before = pose = se2.identity()
        out: list[Arrival] = []
        for t, thing in stream:
            if isinstance(thing, RawOdometry):
                now = np.array((thing.x, thing.y, thing.yaw))
                step = se2.between(before, now)
                lies = SINCE <= thing.t_mono < UNTIL
                pose = se2.compose(pose, np.array(change(*step.tolist()) if lies else step, float))
                before, (x, y, yaw) = now, pose.tolist()
                thing = replace(thing, x=x, y=y, yaw=yaw)
            out.append((t, thing))
        return out

    return Lie(ODOMETRY, changed)


def _gyro(change: Callable[[float], float]) -> Lie:
    """A gyro of 50 Hz beside the wheels, right until it lies."""

    def changed(stream: list[Arrival], scene: Scenario) -> list[Arrival]:
        t = np.arange(1.0, scene.seconds - 1.0, 0.02)
        rate = np.gradient(np.unwrap(scene.pose(t)[:, 2]), t).tolist()
        turns = ((at, change(one) if SINCE <= at < UNTIL else one) for at, one in zip(t.tolist(), rate, strict=True))
        return sorted([*stream, *((at + 0.004, RawImu(at + 0.004, at, turn)) for at, turn in turns)], key=itemgetter(0))

    return Lie(GYRO, changed)


LIES: Final = {
    "lidar frozen": _lidar(_seen_in(lambda _, so_far: next(one for one in so_far if one.t_mono >= SINCE))),
    "lidar mirrored": _lidar(_seen_in(lambda scan, _: scan, slice(None, None, -1))),
    "lidar 0.3 s late": _lidar(lambda scan, _: replace(scan, t_mono=scan.t_mono + 0.3, t_rx=scan.t_rx + 0.3), 0.3),
    "lidar 3 s old": _lidar(_old(3.0)),
    "lidar swapped": _lidar(_old(20.0)),
    "lidar +20 %": _lidar(lambda scan, _: replace(scan, ranges=np.rint(1.2 * scan.ranges).astype(np.int32))),
    "lidar turned 6 deg": _knocked(6.0),
    "lidar turned 10 deg": _knocked(10.0),
    "lidar loose 0.5 deg/s": _knocked(0.0, 0.5),
    "survey mirrored": _survey(_mirrored),
    "survey permuted": _survey(_permuted),
    "survey 0.6 m low": _survey(lambda lamps, _: [replace(lamp, z=lamp.z - 0.6) for lamp in lamps]),
    "odometry backwards": _odometry(lambda ahead, left, turn: (-ahead, left, turn)),
    "odometry turns inverted": _odometry(lambda ahead, left, turn: (ahead, left, -turn)),
    "odometry left wheel dead": _odometry(
        lambda ahead, left, turn: (0.5 * ahead + 0.1 * turn, left, 2.5 * ahead + 0.5 * turn)
    ),
    "odometry in mm": _odometry(lambda ahead, left, turn: (1e3 * ahead, 1e3 * left, turn)),
    "odometry turns in deg": _odometry(lambda ahead, left, turn: (ahead, left, math.degrees(turn))),
    "odometry -30 %": _odometry(lambda ahead, left, turn: (0.7 * ahead, 0.7 * left, turn)),
    "odometry turns 10 deg/s": _odometry(lambda ahead, left, turn: (ahead, left, turn + math.radians(0.5))),
    "odometry zero": _odometry(lambda ahead, left, turn: (0.0, 0.0, 0.0)),
    "gyro in deg/s": _gyro(math.degrees),
    "gyro inverted": _gyro(lambda rate: -rate),
    "gyro bias 0.3 rad/s": _gyro(lambda rate: rate + 0.3),
    "gyro stuck at 0.5 rad/s": _gyro(lambda rate: 0.5),
}


@dataclass(frozen=True, slots=True)
class Case:
    """A lie (empty: none), the kind of scenario, its seed, and the sensors beside the wheels: both, or light."""

    lie: str
    kind: str
    seed: int
    use: str = "both"

    @property
    def lit(self) -> bool:
        """Whether there are lamps."""
        return not self.kind.endswith("_unlit")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a case.

    Attributes:
        rows: (cycles, columns) of :data:`integrity.run.COLUMNS`, from where the lie begins. found: their verdict.
        named: seconds from then until a fault has named the sensor; infinite: none has. other: the fault that was
            present first while none had, 0: none.
    """

    case: Case
    rows: Array
    found: Found
    named: float
    other: int


@quiet()
def outcome(case: Case) -> Outcome | None:
    """Run one case; None where nothing can drive in the room that was drawn."""
    lie = LIES.get(case.lie, Lie(()))
    try:
        scene = draw(case.kind, case.seed)
    except RuntimeError:
        return None
    scene.wheels = True
    if case.use == "light":
        scene.blind = ((0.0, scene.seconds),)
    if lie.scene is not None:
        lie.scene(scene)
    watcher, rows = followed(scene, lie.change)
    begun = 0.0 if lie.culprits in ((), SURVEY) else SINCE
    rows = rows[rows[:, 0] >= begun]
    first = {fault: min((t for t in times if t >= begun), default=math.inf) for fault, times in watcher.faults.items()}
    named = min((t for fault, t in first.items() if fault in lie.culprits), default=math.inf)
    others = {t: fault for fault, t in first.items() if t < named and fault != Fault.PROTECTION_ALERT}
    found = judged(f"{case.lie or case.kind}-{case.seed}", rows, np.zeros((0, 2)), (case.lit, False, ""))
    return Outcome(case, rows, found, named - begun, others[min(others)] if others else 0)


def followed(scene: Scenario, change: Change | None) -> tuple[Watcher, Array]:
    """A scenario through the daemon's cycle: its faults, and rows as :data:`integrity.run.COLUMNS`."""
    robot, watcher = robot_of(scene), Watcher()
    rows: list[list[float]] = []
    anchor: tuple[Array, Array] | None = None
    for arrived in arrivals(scene) if change is None else change(list(arrivals(scene)), scene):
        snapshot = robot.take(arrived)
        if snapshot is None:
            continue
        watcher.look(robot.cycle, snapshot.t_sent)
        if snapshot.pose is not None:
            site, result = scene.pose(np.array([snapshot.t_mono]))[0], robot.cycle.result
            anchor = anchor or (site, np.array(snapshot.pose))
            placed = result is not None and result.placed
            rows.append(row(snapshot, site if placed else in_map(site, *anchor)))
    return watcher, np.array(rows)

"""Two scans of a drive and three ideas of the motion between them: from lights and wheels, from wheels, and none.

The idea is T1 of the paper: ``X_ref^-1 X_new``, with the poses of the `lights` filter (lamps and odometry, never laser)
or of dead reckoning, each as known at the instant of its scan; "none" takes the robot to be where it was.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimator.light_filter import light_filter
from estimator.measurements import Odometry, Scan
from estimator.numerics import se2
from estimator.result import Fix
from tools.experiments.support.trajectory import Array
from tools.sim.building.buildings import building
from tools.sim.ceiling.ceiling import ceiling_of, paper_ceiling
from tools.sim.ceiling.links import Reception
from tools.sim.ceiling.movers import lean_of, walkers_of
from tools.sim.ceiling.records import survey
from tools.sim.light.link_drive import ROOM_ROUTE, ROOM_WALKERS, LightRun
from tools.sim.robot.drive import Body, Drive
from tools.sim.robot.odometry import Wheels
from tools.sim.scan_drive import Laser

LIT, WHEELS, NONE = "lights and wheels", "wheels", "none"
IDEAS: Final = (LIT, WHEELS, NONE)
GOOD: Final = Wheels()
SLIPPING: Final = Wheels(slips_per_m=0.5, slip_m=0.03)
"""Every 2 m one wheel spins or skids by 3 cm, which turns the reckoned heading by 4 degrees."""
SETTLED_S: Final = 30.0
"""Pairs are taken from here on: the `lights` filter has found its place and heading."""
BACK_M, NEAR_M, ALIKE_RAD = 20.0, 0.4, 0.45
"""A return: after so long a way, within so far of an earlier scan's place and heading."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A drive. ``where``: `room` (the paper's) or `office`. speed: m/s."""

    name: str
    where: str
    speed: float
    wheels: Wheels


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Scans with the robot's motion while each was taken, the true motion between their ends, and ideas of it."""

    reference: Scan
    new: Scan
    moved: tuple[Array, Array]
    truth: Array
    ideas: dict[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A drive as the robot knows it: dead reckoning (n, 3) at (n,) instants, and the lights' poses.

    ``lit``: (m, 6) rows: when it was known, for which instant, x, y, yaw, 1 if the place and heading were sure.
    """

    t: Array
    reckoned: Array
    lit: Array

    def by_wheels(self, t: float) -> Array:
        """Dead-reckoned pose at an instant."""
        return np.array([np.interp(t, self.t, self.reckoned[:, axis]) for axis in range(3)])

    def sure(self, t: float) -> bool:
        """Whether light alone knew place and heading then."""
        return bool(self.lit[np.searchsorted(self.lit[:, 0], t, side="right") - 1, 5])

    def by_lights(self, t: float) -> Array:
        """What the `lights` filter knew at an instant, carried on by the wheels."""
        row = self.lit[np.searchsorted(self.lit[:, 0], t, side="right") - 1]
        return se2.compose(row[2:5], se2.between(self.by_wheels(float(row[1])), self.by_wheels(t)))


def drive_of(condition: Condition, seed: int, seconds: float = np.inf) -> tuple[LightRun, Laser]:
    """The robot of a condition under its lamps, all effects on, and its lidar; at most so long."""
    place = building("paper_room" if condition.where == "room" else "office_floor")
    route, walkers = (ROOM_ROUTE, ROOM_WALKERS) if condition.where == "room" else (place.route, place.people)
    ceiling = paper_ceiling(None, seed) if condition.where == "room" else ceiling_of(place, None, seed)
    drive = Drive(route, Body(speed=condition.speed), 2.0, 1)
    ceiling.lean, ceiling.movers = lean_of(drive), walkers_of(walkers)
    plan, seconds = survey(ceiling), min(seconds, drive.lap_s)
    run = LightRun(drive, ceiling, plan, condition.wheels, place.world, seed, seconds, Reception())
    return run, Laser(run, walkers)


def way_of(run: LightRun) -> Way:
    """Reckon by wheels, and by lights and wheels, over a drive."""
    filter_, pose = light_filter.new_lights(run.survey), np.zeros(3)
    t, reckoned, lit = [0.0], [pose], []
    for record in run.records():
        if isinstance(record, Odometry):
            light_filter.predict(filter_, record)
            pose = se2.compose(pose, record.delta)
            t.append(record.t_end)
            reckoned.append(pose)
            continue
        result = light_filter.update(filter_, replace(record, lamps=(None,) * len(record.ids)))
        lit.append((record.t_end, result.t_pose, *result.T_map_base, float(result.fix in (Fix.GOOD, Fix.HELD))))
    poses = np.array(reckoned)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Way(np.array(t), poses, np.array(lit))


def apart(run: LightRun, laser: Laser, gap_s: float, count: int) -> list[tuple[int, int]]:
    """Revolutions that far apart in time, evenly over the drive while it moves."""
    period = laser.model.true_period_s
    step = max(1, round(gap_s / period))
    last = int(run.seconds / period) - step - 2
    first = round(min(SETTLED_S, 0.5 * run.seconds) / period)
    return [(k, k + step) for k in np.linspace(first, last, count).round().astype(int).tolist()]


def returns(run: LightRun, laser: Laser, count: int) -> list[tuple[int, int]]:
    """Revolutions at about the same place and heading with a long way between them, evenly over those there are."""
    period = laser.model.true_period_s
    at = np.arange(round(min(SETTLED_S, 0.25 * run.seconds) / period), int(run.seconds / period) - 2, 10)
    t = period * at
    pose, way, found = run.truth(t), run.drive.travelled(t), []
    for k in range(len(at)):
        old = np.flatnonzero(way < way[k] - BACK_M)
        far = np.hypot(*(pose[old, :2] - pose[k, :2]).T)
        turned = np.abs(np.angle(np.exp(1j * (pose[old, 2] - pose[k, 2]))))
        fit = np.flatnonzero((far < NEAR_M) & (turned < ALIKE_RAD))
        if len(fit):
            found.append((int(at[old[fit[np.argmin(far[fit])]]]), int(at[k])))
    some = np.linspace(0, len(found) - 1, min(count, len(found))).round().astype(int)
    return [found[i] for i in some]


def lit_only(way: Way, which: list[tuple[int, int]], period: float) -> list[tuple[int, int]]:
    """Those of which light knew both poses; elsewhere the paper's pause leaves T1 to the wheels."""
    return [pair for pair in which if all(way.sure((k + 1) * period) for k in pair)]


def pairs_of(run: LightRun, laser: Laser, way: Way, which: list[tuple[int, int]]) -> list[Pair]:
    """The scans of these revolutions, and the ideas of the motion between them."""
    return [pair_of(run, laser.scan(a), laser.scan(b), way) for a, b in which]


def pair_of(run: LightRun, reference: Scan, new: Scan, way: Way) -> Pair:
    """One pair; scans are put straight by the wheels, as in `step`."""
    ends = np.array([reference.t_end, new.t_end])
    true = run.truth(ends)
    wheels, lit = ([by(t) for t in ends.tolist()] for by in (way.by_wheels, way.by_lights))
    moved = tuple(se2.between(way.by_wheels(scan.t_begin), way.by_wheels(scan.t_end)) for scan in (reference, new))
    ideas = {LIT: se2.between(*lit), WHEELS: se2.between(*wheels), NONE: np.zeros(3)}
    return Pair(reference, new, (moved[0], moved[1]), se2.between(*true), ideas)

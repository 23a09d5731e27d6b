"""The paper's robot on a drive of 160 m and half of it again: records for `step`, and what estimators make of them.

Its lidar sees 180 deg with 721 beams at 40 Hz. Between the passes the lamps may age: each changes its power at once, up
or down, by half to all of the given share. Everything is at the level of `step`: no daemon, no wire, light as decoded
epochs.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from heapq import merge
from typing import Any, Final

import numpy as np

from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import UNLIMITED, LightEpoch, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.paper import LUMILOOP, method
from estimator.paper.methods import Method
from estimator.pipeline import Settings, State, keyframe_poses
from estimator.result import Fix, StepResult
from tools.experiments.support.trajectory import Array, Track, moved
from tools.sim.building.buildings import building
from tools.sim.building.people import Walker
from tools.sim.ceiling.ceiling import Ceiling
from tools.sim.ceiling.movers import lean_of, walkers_of
from tools.sim.ceiling.records import epochs
from tools.sim.light.link_drive import ROOM_ROUTE, ROOM_WALKERS, LightRun, room_run, tour_run
from tools.sim.robot.drive import Drive
from tools.sim.scan_drive import Laser

AT_ONCE_S: Final = 1e-6
THIN: Final = 4
"""Every so manieth scan's pose is kept: ten a second."""


@dataclass(frozen=True, slots=True, eq=False)
class Outing:
    """A drive and, without a break, its first half once more. ``seconds``: of the first pass."""

    run: LightRun
    walkers: tuple[Walker, ...]
    seconds: float

    def span(self, number: int) -> tuple[float, float]:
        """Begin and end of pass 0 or 1, s."""
        return (self.seconds, 1.5 * self.seconds) if number else (0.0, self.seconds)

    def scans(self, number: int) -> list[Scan]:
        """What the laser sees on a pass."""
        return list(Laser(self.run, self.walkers).scans(self.span(number)))

    def odometry(self, number: int) -> list[Odometry]:
        """What the wheels say on a pass."""
        begin, end = self.span(number)
        return [record for record in self.run.odometry() if begin < record.t_end <= end]

    def light(self, number: int, aged: float = 0.0) -> list[LightEpoch]:
        """What the decoder says on a pass, under lamps that have aged by that share."""
        return list(epochs(aged_by(self.run.ceiling, aged), self.run.truth, self.span(number), self.run.seed))


def aged_by(ceiling: Ceiling, share: float) -> Ceiling:
    """The same lamps, each of them brighter or darker by half to all of a share."""
    return replace(ceiling, effects=replace(ceiling.effects, ageing=share, ageing_s=AT_ONCE_S)) if share else ceiling


def outing(where: str, seed: int, seconds: float) -> Outing:
    """``room``: up and down the paper's room; ``tour``: from there into its corridor and back. At most ``seconds``."""
    if where == "room":
        run, route, walkers = room_run(seed=seed), ROOM_ROUTE, ROOM_WALKERS
    else:
        place = building("paper_room")
        run, route, walkers = tour_run(place.name, seed=seed, place=place), place.route, place.people
    drive = Drive(route, run.drive.body, 2.0, 2)
    run.ceiling.lean, run.ceiling.movers = lean_of(drive), walkers_of(walkers)
    return Outing(replace(run, drive=drive, seconds=2.0 * drive.lap_s), walkers, min(seconds, drive.lap_s))


@dataclass(slots=True, eq=False)
class Log:
    """What a robot came to over a pass, ten times a second.

    ``kept``: the same way as the keyframes are known at the end. ``lights``: of lamps and odometry alone, NaN where not
    known.
    """

    t: list[float]
    live: list[Array]
    hung: list[tuple[int, Array]]
    lights: list[Array]

    def tracks(self, state: State, truth: Callable[[Array], Array]) -> dict[str, Track]:
        """As live, kept and lights tracks."""
        t, frames = np.array(self.t), keyframe_poses(state)
        kept = np.array([se2.compose(frames[anchor], T) for anchor, T in self.hung])
        true = truth(t)
        return {
            "live": Track(t, np.array(self.live), true),
            "kept": Track(t, kept, true),
            "lights": Track(t, np.array(self.lights), true),
        }


NOWHERE: Final = np.full(3, np.nan)


def play(robot: Method, streams: Iterable[Iterable[Record]]) -> Log:
    """All records through a method, one step a scan."""
    log, pending = Log([], [], [], []), list[Record]()
    ordered: Iterable[Any] = merge(*streams, key=lambda record: record.t_end)  # type: ignore[union-attr]  # no orders
    for record in ordered:
        pending.append(record)
        if isinstance(record, Scan):
            result = robot.step(pending, UNLIMITED)
            pending = []
            if record.seq % THIN == 0:
                note(log, result)
    return log


def note(log: Log, result: StepResult) -> None:
    """Take down a result."""
    log.t.append(result.t_mono)
    log.live.append(se2.compose(result.T_map_odom, result.T_odom_base))
    log.hung.append((result.anchor, result.T_anchor_base))
    known = result.lights is not None and result.lights.fix in (Fix.GOOD, Fix.HELD)
    log.lights.append(result.lights.T_map_base if known and result.lights is not None else NOWHERE)


def fresh(run: LightRun, lit: bool, name: str = LUMILOOP) -> Method:
    """A robot that has just been switched on; with a photodiode it knows the lamps as new. No loops are closed.

    ``name``: of its method.
    """
    lights = LightsSetup(run.survey, clock_ppm=0.0) if lit else None
    return method(name)(Settings(history=True, loops=None), lights)


def reckoned(records: list[Odometry], t: Array, truth: Callable[[Array], Array]) -> Track:
    """Dead reckoning by these records from the true pose at their begin, at (n,) instants."""
    pose, poses = np.zeros(3), [np.zeros(3)]
    for record in records:
        pose = se2.compose(pose, record.delta)
        poses.append(pose)
    at = np.array([records[0].t_begin, *(record.t_end for record in records)])
    way = np.array(poses)
    way[:, 2] = np.unwrap(way[:, 2])
    there = np.column_stack([np.interp(t, at, way[:, axis]) for axis in range(3)])
    return Track(t, moved(there, way[0], truth(at[:1])[0]), truth(t))

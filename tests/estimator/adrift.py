"""A robot with a stored map that does not know where in it it is: buildings, ways through them, and its cycles."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from estimator.mapping.keyframe import SIZE, Settled, Submap, keep, settle
from estimator.mapping.submap_graph import SubmapGraph
from estimator.measurements import UNLIMITED, Answer, Array, Beam, Command, Job, Odometry, Record
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state, step
from estimator.result import StepResult
from estimator.state import State
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene, bearings, box

BEAMS = bearings(181, 270.0)
Corners = Sequence[tuple[float, float]]

SMALL = np.diag((0.01**2, 0.01**2, 0.003**2))


def rooms(widths: Sequence[float]) -> Scene:
    """Rooms 5 m deep beside each other, each with a door to one corridor; of other widths they look different."""
    walls, x = box(0.0, 0.0, sum(widths), 7.0), 0.0
    for width in widths:
        walls += [(x, 5.0, x + 1.4, 5.0), (x + 2.3, 5.0, x + width, 5.0), (x + width, 0.0, x + width, 5.0)]
        x += width
    return Scene(np.array(walls, dtype=np.float64), (0.4, 0.4), (x - 0.4, 6.6))


def furnished(widths: Sequence[float] = (4.0, 3.2, 4.6), seed: int = 1) -> Scene:
    """The same with a cupboard or two in each."""
    plain, rng, x = rooms(widths), np.random.default_rng(seed), 0.0
    more: list[tuple[float, float, float, float]] = []
    for width in widths:
        y = rng.uniform(0.2, 2.0)
        more += box(x, y, x + rng.uniform(0.3, 0.7), y + rng.uniform(0.6, 2.0))
        more += box(x + width - rng.uniform(0.3, 0.7), 0.0, x + width, rng.uniform(0.8, 3.0))
        x += width
    return Scene(np.vstack((plain.walls, np.array(more))), plain.low, plain.high)


def way(corners: Corners, step_m: float, turn: float = 0.2) -> Array:
    """Poses (n, 3) from corner to corner, turning on the spot."""
    poses: list[tuple[float, float, float]] = []
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        heading, length = float(np.arctan2(y1 - y0, x1 - x0)), float(np.hypot(x1 - x0, y1 - y0))
        turned = se2.wrap(heading - poses[-1][2]) if poses else 0.0
        count = int(abs(turned) / turn)
        poses += [(x0, y0, heading - turned * (1.0 - (k + 1) / (count + 1))) for k in range(count)]
        along = np.arange(max(1, round(length / step_m))) / max(1, round(length / step_m))
        poses += [(x0 + a * (x1 - x0), y0 + a * (y1 - y0), heading) for a in along.tolist()]
    return np.array(poses)


def mapped(scene: Scene, corners: Corners, seed: int = 0) -> list[tuple[Array, Settled]]:
    """Submaps of a drive, 2 cm off each, with their places."""
    rng = np.random.default_rng(seed)
    frames = [keep(key, T, T, scan_in(scene, T, BEAMS, rng), 0.0) for key, T in enumerate(way(corners, 0.25), 1)]
    made = []
    for k in range(0, len(frames) - 3, SIZE):
        T = frames[k].T_odom_keyframe
        made.append((se2.compose(T, rng.normal(0.0, (0.02, 0.02, 0.005))), settle(frames[k : k + SIZE], T, 0.01)))
    return made


def stored(submaps: list[tuple[Array, Settled]], settings: Settings | None = None) -> State:
    """A state that has just been switched on with this map, and believes to be somewhere else."""
    state = new_state(settings)
    atlas: SubmapGraph = state.map.graph
    for key, (T, settled) in enumerate(submaps, 1):
        atlas.submaps[key] = Submap(key, key, T.copy(), T.copy(), -1000.0, settled)
        if key > 1:
            atlas.constraints.add(key - 1, key, se2.between(submaps[key - 2][0], T), SMALL, False)
    atlas.parts.detached, atlas.parts.detached_since, state.map.next_key = len(submaps) + 1, 1000, 1000
    atlas.parts.session_start, atlas.parts.fixed = 1000, state.settings.localise
    state.pose.T_map_odom = np.array((40.0, -7.0, 1.0))
    return state


@dataclass(eq=False)
class Robot:
    """Scans ten times a second, wheels that count 1 % too much, jobs that answer some scans later.

    ``readings``: of the wheels, from scan to scan.
    """

    state: State
    scene: Scene
    late: int = 3
    t: float = 100.0
    T: Array | None = None
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))
    due: list[tuple[int, Job]] = field(default_factory=list)
    scans: int = 0
    readings: int = 1

    def at(
        self, T: Array, *orders: Command, carried: bool = False, covered: bool = False, silent: bool = False
    ) -> StepResult:
        """One scan at a true pose; the wheels do not see that a robot is carried, nor the lidar while it is covered.

        ``silent``: the wheels tell nothing.
        """
        self.scans += 1
        ready = [job for scan, job in self.due if scan <= self.scans]
        self.due = [(scan, job) for scan, job in self.due if scan > self.scans]
        records: list[Record] = [Answer(self.t, job.job_id, job.run()) for job in ready]
        records += orders
        t, self.t = self.t, self.t + 0.1
        delta = np.zeros(3) if self.T is None or carried else se2.between(self.T, T)
        if not silent:
            parts = self.readings
            for k in range(parts):  # of one scan's time
                begin, end = t + 0.1 * k / parts, t + 0.1 * (k + 1) / parts
                made = delta / parts * (1.01, 1.0, 1.0) + self.rng.normal(0.0, 5e-4 / parts**0.5, 3)
                records.append(Odometry(begin, end, made))
        self.T = T
        seen = scan_in(self.scene, T, BEAMS, self.rng, t=self.t)
        if covered:
            seen.range_m[:], seen.beam[:] = 0.0, Beam.NONE
        result = step(self.state, [*records, seen], UNLIMITED)
        self.due += [(self.scans + self.late, job) for job in result.jobs]
        return result

    def along(self, poses: Array, carried: bool = False) -> list[int | None]:
        """Drive until the place is known or the way is over; how many places fitted, scan by scan."""
        said = []
        for k, T in enumerate(poses):
            said.append(self.at(T, carried=carried and k == 0).places)
            if said[-1] is None and not (carried and k < 30):
                break
        return said

    def off(self) -> tuple[float, float]:
        """Error of the pose: metres, radians."""
        assert self.T is not None
        x, y, yaw = se2.between(self.T, se2.compose(self.state.pose.T_map_odom, self.state.motion.T_odom_base)).tolist()
        return float(np.hypot(x, y)), abs(yaw)

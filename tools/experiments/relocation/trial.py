"""One robot that is switched on, or carried away, in a building whose map it has; what it says, and when it is right.

Everything is at the level of `step` and the state machine: background jobs answer with the next scan. A pose counts as
given where the daemon would publish it without reservation: the place is not being looked for, and the state is not one
of those that say so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from heapq import merge
from typing import Any, Final

import numpy as np

from daemon.integrity.observer import Observer
from daemon.integrity.state_machine import judge
from daemon.integrity.state_memory import Memory
from daemon.snapshot import State as Said
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage
from estimator.measurements import UNLIMITED, Answer, Array, Job, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, State, step
from estimator.result import StepResult
from estimator.stored_map import restored
from hal.lidar import LidarStatus, Link
from tools.experiments.relocation.worlds import PERIOD_S, Carried, Poses, Site, Stroll, odometry, person, stroll
from tools.sim.building.people import Crowd

RIGHT_M, RIGHT_RAD = 0.2, math.radians(3.0)
FAR_M, FAR_RAD = 1.0, math.radians(15.0)
"""Beyond which a pose is called confidently wrong."""
BAD_M, BAD_RAD = 0.5, math.radians(5.0)
"""Beyond which TRACKING must not be said."""
HIDDEN: Final = (Said.STARTING, Said.NO_LIDAR, Said.AMBIGUOUS, Said.LOST, Said.RELOCATING)
"""States in which the pose is said not to be known."""


@dataclass(frozen=True, slots=True)
class Moment:
    """What was said after one scan: seconds, state, reason, whether a pose was given, its errors (m, rad), places."""

    t: float
    state: int
    reason: int
    given: bool
    off_m: float
    off_rad: float
    places: int | None

    @property
    def right(self) -> bool:
        """Given, and within 20 cm and 3 deg."""
        return self.given and self.off_m < RIGHT_M and self.off_rad < RIGHT_RAD

    @property
    def far(self) -> bool:
        """Given, and off by more than 1 m or 15 deg."""
        return self.given and (self.off_m > FAR_M or self.off_rad > FAR_RAD)

    @property
    def astray(self) -> bool:
        """TRACKING, and off by more than 0.5 m or 5 deg."""
        return self.state == Said.TRACKING and (self.off_m > BAD_M or self.off_rad > BAD_RAD)


@dataclass(eq=False)
class Robot:
    """An estimator with the part of the daemon that judges it, and a worker that answers with the next step.

    Attributes:
        period_s: from scan to scan. waiting: jobs to be run. slowest_job_s: processor time.
    """

    state: State
    observer: Observer
    memory: Memory = field(default_factory=Memory)
    period_s: float = PERIOD_S
    waiting: list[Job] = field(default_factory=list)
    slowest_job_s: float = 0.0
    result: StepResult | None = None

    def take(self, t: float, records: list[Record]) -> StepResult:
        """One cycle."""
        jobs, self.waiting = sorted(self.waiting, key=lambda job: job.priority), []
        answers = [Answer(t, job.job_id, self._run(job)) for job in jobs]
        taken: tuple[Record, ...] = (*answers, *records)
        for record in records:
            if isinstance(record, Odometry):
                self.observer.on_odometry(record.t_end)
            if isinstance(record, Scan):
                self.observer.on_scan(record.t_end)
        self.result = step(self.state, taken, UNLIMITED)
        self.waiting = list(self.result.jobs)
        evidence = self.observer.evidence(t, self.period_s, LidarStatus(link=Link.STREAMING), taken, self.result)
        self.memory = judge(self.memory, evidence)
        return self.result

    @property
    def t_mono(self) -> float:
        """The instant that the pose is for."""
        assert self.result is not None
        return self.result.t_mono

    def _run(self, job: Job) -> object:
        begin = time.thread_time()
        payload = job.run()
        self.slowest_job_s = max(self.slowest_job_s, time.thread_time() - begin)
        return payload

    def moment(self, t: float, true: Array) -> Moment:
        """What is said now, against the truth of the instant that the pose is for."""
        assert self.result is not None
        off = se2.compose(self.result.T_map_odom, self.result.T_odom_base) - true
        places = self.result.places
        given = self.memory.state not in HIDDEN and places is None
        state, reason = int(self.memory.state), int(self.memory.reason)
        return Moment(t, state, reason, given, math.hypot(off[0], off[1]), abs(se2.wrap(float(off[2]))), places)


def switched_on(image: MapImage, lights: LightsSetup | None, t: float = 0.0, period_s: float = PERIOD_S) -> Robot:
    """A robot with a map, at its first moment."""
    state = restored(image, Settings(), lights)
    return Robot(state, Observer(t, odometry=True, lidar=True, lights=lights is not None), period_s=period_s)


@dataclass(frozen=True, slots=True)
class Case:
    """What is tried.

    Attributes:
        name: of the place and whether there is light in it. carried: from one place to another, else switched on.
        moving: slowly, else at rest. seconds: watched, of the last place.
    """

    name: str
    carried: bool
    moving: bool
    seconds: float = 8.0


BEFORE_S: Final = 9.0
"""A robot that will be carried away has had so long before."""
LIFTED_S: Final = 1.5


def way_of(site: Site, case: Case, rng: np.random.Generator) -> tuple[Carried, float, float]:
    """A way, when its last part begins, and when it ends, s."""
    second = stroll(site, rng, case.seconds, case.moving)
    if not case.carried:
        return Carried(second, second, 1e9, 2e9), 0.0, case.seconds
    first = stroll(site, rng, BEFORE_S, True)
    begin = BEFORE_S + LIFTED_S
    return Carried(first, second, BEFORE_S, begin), begin, begin + case.seconds


def records_of(
    site: Site, way: Carried, end: float, lit: bool, seed: int, near: Array
) -> Iterable[tuple[Scan, list[Record]]]:
    """Scans of a way, each with the records since the one before, itself the last."""
    rng = np.random.default_rng((seed, 5))
    crowd = Crowd(person(rng, near))
    poses: Poses = way.at
    streams: list[Iterable[Any]] = [odometry(way.rolled, (0.0, end), rng)]
    streams.append(site.scan(k, poses, crowd) for k in range(int(end / PERIOD_S)))
    if lit:
        streams.append(site.light(poses, (0.0, end), seed))
    pending: list[Record] = []
    for record in merge(*streams, key=lambda one: one.t_end):
        pending.append(record)
        if isinstance(record, Scan):
            yield record, pending
            pending = []


@dataclass(frozen=True, slots=True)
class Outcome:
    """One trial; times in s since being switched on or put down, None: never.

    Attributes:
        right_s: pose given and right, and given and right from then on. tracking_s: the state then is TRACKING.
        end: name of the last state. ended_right: at the end. wrong: given and more than 20 cm or 3 deg off, longest
            time without a break; far: the same for 1 m or 15 deg; astray: TRACKING with more than 0.5 m or 5 deg.
        ambiguous: AMBIGUOUS was said at some time. unique: whether the codes in view are of one place only.
        known_before: carried robots: TRACKING was said, and was right, before. job_s: slowest background job.
    """

    case: str
    seed: int
    carried: bool
    moving: bool
    unique: bool
    lamps: int
    right_s: float | None
    tracking_s: float | None
    end: str
    ended_right: bool
    wrong_s: float
    far_s: float
    astray_s: float
    ambiguous: bool
    known_before: bool
    job_s: float
    off_m: float
    off_rad: float


def trial(site: Site, image: MapImage, case: Case, seed: int, lights: LightsSetup | None) -> Outcome:
    """Switch a robot on somewhere, or carry it off, and watch it."""
    rng = np.random.default_rng((seed, 3))
    way, begin, end = way_of(site, case, rng)
    robot = switched_on(image, lights)
    moments: list[Moment] = []
    for scan, records in records_of(site, way, end, lights is not None, seed, way.second.begin):
        robot.take(scan.t_end, records)
        moments.append(robot.moment(scan.t_end, way.at(np.array([robot.t_mono]))[0]))
    at = way.second.begin[:2]
    return outcome(case, seed, begin, moments, (site.unique(at), len(site.codes_at(at[None])[0])), robot.slowest_job_s)


def outcome(
    case: Case, seed: int, begin: float, moments: list[Moment], view: tuple[bool, int], job_s: float
) -> Outcome:
    """What the moments amount to; ``begin``: when being switched on or put down, s."""
    before = [one for one in moments if one.t <= begin - LIFTED_S]
    after = [one for one in moments if one.t > begin]
    last = after[-1]
    since = None
    for one in reversed(after):
        if not one.right:
            break
        since = one.t - begin
    tracking = next((one.t - begin for one in after if one.right and one.state == Said.TRACKING), None)
    return Outcome(
        case=case.name, seed=seed, carried=case.carried, moving=case.moving, unique=view[0], lamps=view[1],
        right_s=since, tracking_s=tracking, end=Said(last.state).name, ended_right=last.right,
        wrong_s=longest(after, [one.given and not one.right for one in after]),
        far_s=longest(after, [one.far for one in after]), astray_s=longest(after, [one.astray for one in after]),
        ambiguous=any(one.state == Said.AMBIGUOUS for one in after),
        known_before=bool(before) and before[-1].right and before[-1].state == Said.TRACKING,
        job_s=job_s, off_m=last.off_m, off_rad=last.off_rad,
    )  # fmt: skip


def longest(moments: list[Moment], flags: list[bool]) -> float:
    """Seconds of the longest run of moments for which something held, one scan counting as one period."""
    best, begun = 0.0, None
    period = (moments[-1].t - moments[0].t) / max(1, len(moments) - 1)
    for one, flag in zip(moments, flags, strict=True):
        begun = (one.t if begun is None else begun) if flag else None
        best = max(best, 0.0 if begun is None else one.t - begun + period)
    return best


__all__ = ["Case", "Moment", "Outcome", "Robot", "Stroll", "outcome", "switched_on", "trial"]

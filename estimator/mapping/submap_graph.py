"""The map as submaps and what joins them, and the work on it that is under way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from estimator.mapping.constraints import Constraints
from estimator.mapping.graph_sparsification import handed_on, thinned
from estimator.mapping.keyframe import ANYWHERE, Keyframe, Settled, Submap
from estimator.mapping.loop_verification import Found
from estimator.mapping.submap import SIZE, settle
from estimator.measurements import Answer, Job
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation.hypothesis_tracking import Seek, Watch
from estimator.result import Loop

FLOOR: Final = np.diag((0.005**2, 0.005**2, math.radians(0.1) ** 2))
"""What a keyframe's place loses against the one before, beyond what the matches know of: 5 mm and 0.1 deg."""

NEAR_M, NEAR_RAD, KEPT = 1.5, 0.25 * math.pi, 2
"""So many submaps are kept that begin so near each other, with the robot looking the same way. In a grid of places they
would go on filling up for hours, because no lap begins its submaps where the last one did."""

OWN: Final = 12
"""Submaps of this session kept on top of a restored map that is only used."""

LOST: Final = 100
"""Keyframes after which a job that has not answered never will: one that failed does not."""

LOOK, SOLVE, SETTLE = 3, 2, 1
"""Priorities of the jobs, lowest first."""

Apply = Callable[[object], None]


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A loop that would move the pose far, until a second one agrees: the same stretch of the way, found again.

    Attributes:
        T_found_odom: where the odom frame would lie, seen from the submap that was found.
    """

    found: Found
    frame: Keyframe
    T_found_odom: Array


@dataclass(slots=True, eq=False)
class Aside:
    """A stored map in a frame of its own in which the robot has not been found yet; see `unaligned_map`.

    Attributes:
        submaps, constraints: as of `Atlas`. frames: its keyframes by ID. kept: as of `Atlas`, for when it is found.
        first: key of the first submap that is no part of it, since: ID of the first such keyframe.
        begun_m: way driven when it was first put aside. seek: the search for the place in it.
    """

    submaps: dict[int, Submap]
    constraints: Constraints
    frames: dict[int, Keyframe]
    kept: int
    first: int
    since: int
    begun_m: float
    seek: Seek


@dataclass(slots=True, eq=False)
class Atlas:
    """Submaps, constraints, and work under way.

    Attributes:
        submaps: by key, oldest first. frames: keyframes of the newest one. constraints: between them.
        C: covariance (odom axes) of the newest keyframe's place relative to the newest submap's, T_odom_last its place.
        marginal: covariance (odom axes) of the newest submap's place in the map.
        strayed: covariance that the way has added since the start, about the odom frame's origin (see
            :meth:`strayed_since`).
        ties: covariance (odom axes) of submap ``tied``'s place relative to others, by key, as the graph has it.
        way_m: driven between keyframes. laid: how many keyframes; since_look: since the last look.
        waiting: loops without support. jobs: to be handed out. asked: when, in keyframes laid, and what to do with the
            answer, by job ID. look, solution: IDs of the latest jobs of these kinds.
        stale: whether the graph has changed since it was solved. own: ID of a keyframe that begins a submap, 0: any.
        adrift: key of the first submap whose place in the map is not known, None where the robot's place is: it and all
            later ones are a part of the graph that nothing joins to the older one. since: ID of their first keyframe, 0
            where nothing is adrift. bridge: the way across that break, if there was one: key of the submap before,
            T_submap_adrift and its covariance in the latter's axes. seek: the search for the place; watch: of one
            that was found.
        kept: ID of this session's first keyframe, where the map is one that was restored; else 0. held: that map is
            only used; see `Settings.localise`. foreign: that map does not lie in the light survey's frame, and the
            robot's place in it has not been found yet. askew: covariance (m, m, rad; map axes) of the place that light
            had told, and so of that map, in the survey's frame before the place was lost; T_askew: the pose then. See
            `Absolute.kept`. aside: such a foreign map while light tells the place, None: there is none.
        closures: loops accepted so far. news: the latest, until it was reported.
    """

    submaps: dict[int, Submap] = field(default_factory=dict)
    frames: list[Keyframe] = field(default_factory=list)
    constraints: Constraints = field(default_factory=Constraints)
    C: Array = field(default_factory=lambda: np.zeros((3, 3)))
    T_odom_last: Array = field(default_factory=se2.identity)
    marginal: Array = field(default_factory=lambda: np.zeros((3, 3)))
    strayed: Array = field(default_factory=lambda: np.zeros((3, 3)))
    ties: dict[int, Array] = field(default_factory=dict)
    tied: Submap | None = None
    way_m: float = 0.0
    laid: int = 0
    since_look: int = 0
    waiting: list[Waiting] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    asked: dict[int, tuple[int, Apply]] = field(default_factory=dict)
    next_job: int = 1
    look: int = 0
    solution: int = 0
    stale: bool = False
    own: int = 0
    adrift: int | None = None
    since: int = 0
    bridge: tuple[int, Array, Array] | None = None
    seek: Seek = field(default_factory=Seek)
    watch: Watch | None = None
    kept: int = 0
    held: bool = False
    foreign: bool = False
    askew: Array = field(default_factory=lambda: np.zeros((3, 3)))
    T_askew: Array = field(default_factory=se2.identity)
    aside: Aside | None = None
    closures: int = 0
    news: Loop | None = None

    @property
    def newest(self) -> Submap | None:
        """The submap being driven through."""
        return next(reversed(self.submaps.values()), None)

    @property
    def unproved(self) -> int | None:
        """Key of the first submap that is no part of the stored map, while that is undecided; None: it is decided."""
        if self.aside is not None:
            return self.aside.first
        if self.watch is not None and self.watch.foreign_m is not None:
            return self.watch.first
        return self.adrift

    @property
    def looking(self) -> bool:
        """Whether a look is under way."""
        return self.look in self.asked

    @property
    def solving(self) -> bool:
        """Whether a solution of the graph is under way."""
        return self.solution in self.asked

    def ask(self, priority: int, run: Callable[[], object], then: Apply) -> int:
        """Hand out a job; its ID."""
        job_id = self.next_job
        self.jobs.append(Job(job_id, priority, run))
        self.asked[job_id] = self.laid, then
        self.next_job += 1
        return job_id

    def of_part(self, submap: Submap) -> list[Submap]:
        """The submaps whose place relative to this one is known: all, or those that are (not) adrift as it is."""
        if self.adrift is None:
            return list(self.submaps.values())
        adrift = submap.key >= self.adrift
        return [other for other in self.submaps.values() if (other.key >= self.adrift) == adrift]

    def settled(self) -> list[Submap]:
        """The submaps in which the place can be looked for: finished, and not adrift."""
        return [
            submap
            for submap in self.submaps.values()
            if submap.settled is not None and (self.adrift is None or submap.key < self.adrift)
        ]

    def cut(self, since: int) -> None:
        """Say that from keyframe ``since`` on, the next one, the place in the map is not known; there must be a map.

        What was adrift already, and has never been placed, is forgotten.
        """
        if self.adrift is not None:
            kept = [key for key in self.submaps if key < self.adrift]
            self.constraints.keep(np.asarray(np.isin(self.constraints.between, kept).all(axis=1)))
            self.submaps = {key: self.submaps[key] for key in kept}
            self.frames = []
        self.waiting = []  # no loop of another part can support them
        newest = self.newest
        assert newest is not None
        self.adrift, self.since, self.bridge = newest.key + 1, since, None

    def give_up(self) -> None:
        """Wait no longer for jobs that must have failed; the graph is then still to be solved."""
        for job_id in [job_id for job_id, (laid, _) in self.asked.items() if self.laid - laid > LOST]:
            del self.asked[job_id]
            self.stale |= job_id == self.solution

    def take_jobs(self) -> tuple[Job, ...]:
        """The jobs to be handed out now."""
        jobs = tuple(self.jobs)
        self.jobs.clear()
        return jobs

    def take_news(self) -> Loop | None:
        """The latest loop, once."""
        news, self.news = self.news, None
        return news

    def renewed(self) -> Atlas:
        """An empty one; answers to what this one has asked will mean nothing to it."""
        return Atlas(next_job=self.next_job, closures=self.closures)

    def answer(self, answer: Answer) -> None:
        """Take an answer in; one that nobody waits for any more is dropped."""
        _, then = self.asked.pop(answer.job_id, (0, None))
        if then is not None:
            then(answer.payload)

    def add(self, frame: Keyframe, P: Array, sigma: float, anew: bool) -> None:
        """Hang a keyframe, with its covariance relative to the one before (odom axes), on the newest submap.

        ``sigma``: range noise. ``anew``: the laser had lost its map before it, so that the two may lie anywhere in a
        common submap: it begins its own.
        """
        newest, T = self.newest, frame.T_odom_keyframe
        x, y, _ = (T - self.T_odom_last).tolist()
        F = se2.lever_matrix(T - self.T_odom_last)
        self.C = F @ self.C @ F.T
        self.loosen(P + FLOOR, T)
        self.way_m += math.hypot(x, y) if newest is not None else 0.0
        self.T_odom_last = T
        cut = newest is not None and self.adrift is not None and newest.key < self.adrift
        if newest is None or anew or cut or len(self.frames) >= SIZE or frame.key == self.own:
            self.strayed = self.strayed + ANYWHERE * (anew or cut)
            self._begin(frame, newest, sigma)
        frame.submap = next(reversed(self.submaps.values()))
        self.frames.append(frame)
        self.laid += 1
        self.since_look += 1
        self.give_up()
        if frame.virtual is not None:
            frame.submap.lamps |= frame.virtual.accepted
            T_keyframe_submap = se2.between(T, frame.submap.T_odom_submap)
            P_map = se2.carry(frame.virtual.T_map_base, T_keyframe_submap, frame.virtual.covariance)
            if frame.submap.light is None or np.trace(P_map) < np.trace(frame.submap.light[1]):
                frame.submap.light = se2.compose(frame.virtual.T_map_base, T_keyframe_submap), P_map

    def _begin(self, frame: Keyframe, before: Submap | None, sigma: float) -> None:
        """A new submap at this keyframe; the one before is settled."""
        key = 1 if before is None else before.key + 1
        T = frame.T_odom_keyframe
        if before is not None:
            R = se2.rotation(-T[2])
            way = se2.between(before.T_odom_submap, T), R @ self.C @ R.T
            if key == self.adrift:
                self.bridge = (before.key, *way) if self.frames else None
                self.marginal = np.zeros((3, 3))
            else:
                self.constraints.add(before.key, key, *way, False)
                self.marginal = self.spread(T)
            if self.frames:
                self._settle(before, tuple(self.frames), sigma)
        self.submaps[key] = Submap(key, frame.key, frame.T_map_keyframe, T, self.way_m, strayed=self.strayed)
        self.C = np.zeros((3, 3))
        self.frames = []

    def spread(self, T_odom: Array) -> Array:
        """Covariance (odom axes, of the map's oldest submap) of a place reached from the newest submap."""
        return self.reached(self.marginal, T_odom)

    def reached(self, P_newest: Array, T_odom: Array) -> Array:
        """The same, with ``P_newest`` for that of the newest submap."""
        newest = self.newest
        assert newest is not None
        F = se2.lever_matrix(T_odom - newest.T_odom_submap)
        return np.asarray(F @ P_newest @ F.T + self.C)

    def loosen(self, P: Array, T_odom: Array) -> None:
        """Add to what the way has lost, at a place: covariance ``P`` in odom axes."""
        self.C += P
        A = se2.lever_matrix(-T_odom)
        self.strayed = self.strayed + A @ P @ A.T

    def strayed_since(self, since: Submap, T_odom: Array) -> Array:
        """Covariance (odom axes) of a place relative to a submap by the way between them alone: a bound from above.

        Each step of the way adds its own, swung out by the lever from there to here; summed up about one origin, the
        sums of two instants can be subtracted.
        """
        A = se2.lever_matrix(T_odom)
        return np.asarray(A @ (self.strayed - since.strayed) @ A.T)

    def apart(self, other: Submap, T_odom: Array) -> Array:
        """Covariance (odom axes) of a place relative to an earlier submap: by the way since, or by a loop since."""
        way = self.strayed_since(other, T_odom)
        tie = self.ties.get(other.key)
        if tie is None or self.tied is None:
            return way
        A = se2.lever_matrix(T_odom - self.tied.T_odom_submap)
        loop = np.asarray(A @ tie @ A.T + self.strayed_since(self.tied, T_odom))
        return loop if np.trace(loop) < np.trace(way) else way

    def _settle(self, submap: Submap, frames: tuple[Keyframe, ...], sigma: float) -> None:
        def then(payload: object) -> None:
            assert isinstance(payload, Settled)
            submap.settled = payload
            self.thin_out(submap)

        self.ask(SETTLE, lambda: settle(frames, submap.T_odom_submap, sigma), then)

    def thin_out(self, latest: Submap) -> None:
        """Bound what is kept per area: of the submaps of one place and heading the newest few stay."""
        first = 0 if self.watch is None else self.watch.first  # what is watched takes the place of nothing older
        part = [other for other in self.of_part(latest) if (other.key < first) == (latest.key < first)]
        here = [other for other in part if alike(other, latest) and not self.is_held(other)]
        for submap in here[:-KEPT]:
            self.let_go(submap)
        self.constraints.keep(thinned(np.array(list(self.submaps)), self.constraints))
        if self.held:
            own = [submap for submap in self.submaps.values() if not self.is_held(submap)]
            for submap in own[:-OWN]:
                self.let_go(submap)

    def is_held(self, submap: Submap) -> bool:
        """Whether a submap is one of a restored map that is only used."""
        return self.held and submap.first < self.kept

    def let_go(self, submap: Submap) -> None:
        """Take a submap out of the graph; what hangs on it goes on hanging, on the neighbour that is surest of it."""
        rows = handed_on(np.array(list(self.submaps)), self.constraints, submap.key)
        joined = [self.constraints.seen_from(submap.key, row) for row in rows]
        if not joined:
            return
        key, T, P = min(joined, key=lambda one: float(np.trace(one[2])))
        hub, A = self.submaps[key], se2.adjoint(T)
        self.constraints.reroute(submap.key, key, se2.inverse(T), A @ P @ A.T, rows)
        submap.hang_on(hub, se2.between(hub.T_map_submap, submap.T_map_submap))
        submap.settled = None
        del self.submaps[submap.key]


def alike(one: Submap, other: Submap) -> bool:
    """Whether two submaps begin in one place and look the same way."""
    x, y, yaw = (one.T_map_submap - other.T_map_submap).tolist()
    return math.hypot(x, y) < NEAR_M and abs(se2.wrap(yaw)) < NEAR_RAD

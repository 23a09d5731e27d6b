"""The submap graph: submaps with their edges, and the covariances of their poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np

from estimator.job_queue import SETTLE, JobQueue, Owner, job_function
from estimator.mapping.constraints import Constraints
from estimator.mapping.graph_sparsification import handed_on, thinned
from estimator.mapping.keyframe import ANYWHERE, SIZE, Keyframe, Settled, Submap, settle
from estimator.mapping.loop_verification import Found
from estimator.mapping.map_parts import MapParts
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import SURPRISE, Loop

FLOOR: Final = np.diag((0.005**2, 0.005**2, math.radians(0.1) ** 2))
"""Covariance that a keyframe's pose relative to the previous one has beyond that of the matches: 5 mm and 0.1 deg."""

NEAR_M, NEAR_RAD, KEPT = 1.5, 0.25 * math.pi, 2
"""Distance (m) and heading difference (rad) of submaps of one area, and how many of these are kept.

A grid of positions would fill up for hours instead, because each lap begins its submaps at other positions.
"""

OWN: Final = 12
"""Submaps of this session kept on top of a restored map that is only used."""


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A loop with a large correction, until a second one agrees: a match of the same segment of the path.

    Attributes:
        found: the match.
        frame: its keyframe.
        T_found_odom: resulting pose of the odom frame in the matched submap.
    """

    found: Found
    frame: Keyframe
    T_found_odom: Array


@dataclass(slots=True, eq=False)
class SubmapGraph:
    """Submaps and their edges.

    Attributes:
        jobs: the estimator's queue.
        parts: which submaps are restored, detached, on trial or unaligned.
        submaps: by key, oldest first.
        frames: keyframes of the newest one.
        constraints: edges between them.
        C: covariance (odom axes) of the newest keyframe's pose relative to the newest submap's.
        T_odom_last: pose of the newest keyframe.
        marginal: covariance (odom axes) of the newest submap's pose in the map.
        strayed: accumulated covariance of the path since the start, about the odom frame's origin (see
            :meth:`strayed_since`).
        ties: relative covariance (odom axes) of submap ``tied`` and others, by key, from the graph.
        tied: that submap.
        way_m: path length between keyframes.
        since_look: keyframes since the last search for a loop.
        waiting: loops without consensus.
        stale: whether the graph has changed since it was solved.
        cut_at: ID of a keyframe that begins a submap, 0: any.
        broken: key of the latest submap that no match joins to the one before, 0: none.
        closures: number of loops accepted so far.
        news: the latest, until it is reported.
    """

    jobs: JobQueue = field(default_factory=JobQueue)
    parts: MapParts = field(default_factory=MapParts)
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
    since_look: int = 0
    waiting: list[Waiting] = field(default_factory=list)
    stale: bool = False
    cut_at: int = 0
    broken: int = 0
    closures: int = 0
    news: Loop | None = None

    @property
    def newest(self) -> Submap | None:
        """The submap under construction."""
        return next(reversed(self.submaps.values()), None)

    def of_part(self, submap: Submap) -> list[Submap]:
        """The submaps with a known pose relative to this one: all, or those in the same part, detached or not."""
        first = self.parts.detached
        if first is None:
            return list(self.submaps.values())
        detached = submap.key >= first
        return [other for other in self.submaps.values() if (other.key >= first) == detached]

    def settled(self) -> list[Submap]:
        """The submaps for a search of the pose: finished, and not detached."""
        first = self.parts.detached
        return [
            submap
            for submap in self.submaps.values()
            if submap.settled is not None and (first is None or submap.key < first)
        ]

    def detach(self, since: int) -> None:
        """Detach what is created from keyframe ``since``, the next one, on: its pose is not known. There must be a map.

        Submaps that were detached already, and never attached, are removed.
        """
        first = self.parts.detached
        if first is not None:
            kept = [key for key in self.submaps if key < first]
            self.constraints.keep(np.asarray(np.isin(self.constraints.between, kept).all(axis=1)))
            self.submaps = {key: self.submaps[key] for key in kept}
            self.frames = []
        self.waiting = []  # no loop of another part can confirm them
        newest = self.newest
        assert newest is not None
        self.parts.detached, self.parts.detached_since, self.parts.bridge = newest.key + 1, since, None

    def take_news(self) -> Loop | None:
        """The latest loop, returned once."""
        news, self.news = self.news, None
        return news

    def renewed(self) -> SubmapGraph:
        """An empty graph; results of the jobs of this one are dropped."""
        self.jobs.clear()
        return SubmapGraph(self.jobs, closures=self.closures)

    def add(self, frame: Keyframe, P: Array, sigma: float, anew: bool) -> None:
        """Add a keyframe, with its covariance relative to the previous one (odom axes), to the newest submap.

        ``sigma``: range noise. ``anew``: the local map was lost before it, so it begins its own submap. ``P`` then
        contains the whole prediction since the last match. Where the robot may have been carried off as well, the graph
        is detached (`relocalisation.begin`), and the two keyframes may lie anywhere relative to each other.
        """
        newest, T = self.newest, frame.T_odom_keyframe
        x, y, _ = (T - self.T_odom_last).tolist()
        F = se2.lever_matrix(T - self.T_odom_last)
        self.C = F @ self.C @ F.T
        self.loosen(P + FLOOR, T)
        self.way_m += math.hypot(x, y) if newest is not None else 0.0
        self.T_odom_last = T
        cut = newest is not None and self.parts.detached is not None and newest.key < self.parts.detached
        if newest is None or anew or cut or len(self.frames) >= SIZE or frame.key == self.cut_at:
            self.strayed = self.strayed + ANYWHERE * cut
            self.broken = newest.key + 1 if newest is not None and anew else self.broken
            self._begin(frame, newest, sigma)
        frame.submap = next(reversed(self.submaps.values()))
        self.frames.append(frame)
        self.since_look += 1
        self.stale |= Owner.SOLUTION in self.jobs.count_keyframe()
        if frame.virtual is not None:
            frame.submap.lamps |= frame.virtual.accepted
            T_keyframe_submap = se2.between(T, frame.submap.T_odom_submap)
            P_map = se2.carry(frame.virtual.T_map_base, T_keyframe_submap, frame.virtual.covariance)
            if frame.submap.light is None or np.trace(P_map) < np.trace(frame.submap.light[1]):
                frame.submap.light = se2.compose(frame.virtual.T_map_base, T_keyframe_submap), P_map

    def _begin(self, frame: Keyframe, before: Submap | None, sigma: float) -> None:
        """Begin a new submap at this keyframe; the previous one is finished."""
        key = 1 if before is None else before.key + 1
        T = frame.T_odom_keyframe
        if before is not None:
            R = se2.rotation(-T[2])
            way = se2.between(before.T_odom_submap, T), R @ self.C @ R.T
            if key == self.parts.detached:
                self.parts.bridge = (before.key, *way) if self.frames else None
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
        """Covariance (odom axes, relative to the map's oldest submap) of a pose reached from the newest submap."""
        return self.reached(self.marginal, T_odom)

    def reached(self, P_newest: Array, T_odom: Array) -> Array:
        """The same, with ``P_newest`` for that of the newest submap."""
        newest = self.newest
        assert newest is not None
        F = se2.lever_matrix(T_odom - newest.T_odom_submap)
        return np.asarray(F @ P_newest @ F.T + self.C)

    def loosen(self, P: Array, T_odom: Array) -> None:
        """Add covariance ``P`` (odom axes) at a pose to the accumulated covariance of the path."""
        self.C += P
        A = se2.lever_matrix(-T_odom)
        self.strayed = self.strayed + A @ P @ A.T

    def strayed_since(self, since: Submap, T_odom: Array) -> Array:
        """Upper bound on the covariance (odom axes) of a pose relative to a submap: that of the path between them.

        Each step of the path adds its own, transformed by the lever arm from there to here. Summed about one origin,
        the sums of two instants can be subtracted.
        """
        A = se2.lever_matrix(T_odom)
        return np.asarray(A @ (self.strayed - since.strayed) @ A.T)

    def apart(self, other: Submap, T_odom: Array) -> Array:
        """Covariance (odom axes) of a pose relative to an earlier submap: by the path since, or by a loop since."""
        way = self.strayed_since(other, T_odom)
        tie = self.ties.get(other.key)
        if tie is None or self.tied is None:
            return way
        A = se2.lever_matrix(T_odom - self.tied.T_odom_submap)
        loop = np.asarray(A @ tie @ A.T + self.strayed_since(self.tied, T_odom))
        return loop if np.trace(loop) < np.trace(way) else way

    def _settle(self, submap: Submap, frames: tuple[Keyframe, ...], sigma: float) -> None:
        self.jobs.ask(SETTLE, partial(settle, frames, submap.T_odom_submap, sigma), partial(take_settled, self, submap))

    def thin_out(self, latest: Submap) -> None:
        """Limit the stored data per area: of the submaps at one position and heading the newest few stay."""
        trial = self.parts.trial
        first = 0 if trial is None else trial.first  # a submap on trial replaces no older one
        part = [other for other in self.of_part(latest) if (other.key < first) == (latest.key < first)]
        here = [other for other in part if alike(other, latest) and not self.is_held(other)]
        for submap in here[:-KEPT]:
            self.drop(submap)
        self.constraints.keep(thinned(np.array(list(self.submaps)), self.constraints))
        if self.parts.fixed:
            own = [submap for submap in self.submaps.values() if not self.is_held(submap)]
            for submap in own[:-OWN]:
                self.drop(submap)

    def is_held(self, submap: Submap) -> bool:
        """Whether a submap belongs to a restored map that is only used."""
        return self.parts.fixed and submap.first < self.parts.session_start

    def drop(self, submap: Submap) -> None:
        """Remove a submap from the graph; its keyframes refer to the neighbour of smallest relative covariance.

        Its pose there is that of the map, or that of the edge where the map has not been solved with the edge yet.
        """
        rows = handed_on(np.array(list(self.submaps)), self.constraints, submap.key)
        joined = [self.constraints.seen_from(submap.key, row) for row in rows]
        if not joined:
            return
        key, T, P = min(joined, key=lambda one: float(np.trace(one[2])))
        hub, A = self.submaps[key], se2.adjoint(T)
        self.constraints.reroute(submap.key, key, se2.inverse(T), A @ P @ A.T, rows)
        in_map = se2.between(hub.T_map_submap, submap.T_map_submap)
        off = se2.between(T, se2.inverse(in_map))
        solved = float(off @ invert3(P) @ off) <= SURPRISE
        submap.hang_on(hub, in_map if solved else se2.inverse(T))
        submap.settled = None
        del self.submaps[submap.key]


@job_function
def take_settled(graph: SubmapGraph, submap: Submap, payload: object) -> None:
    """Apply the result of finishing a submap."""
    assert isinstance(payload, Settled)
    submap.settled = payload
    graph.thin_out(submap)


def alike(one: Submap, other: Submap) -> bool:
    """Whether two submaps begin at one position with the same heading."""
    x, y, yaw = (one.T_map_submap - other.T_map_submap).tolist()
    return math.hypot(x, y) < NEAR_M and abs(se2.wrap(yaw)) < NEAR_RAD

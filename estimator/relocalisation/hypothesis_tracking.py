"""Pose hypotheses during relocalisation: found by searches of the map, predicted by odometry, confirmed or rejected.

A hypothesis is a pose of the odom frame. Every later keyframe tests each hypothesis where odometry predicts it. A new
pose has to fit the earlier keyframes too. The lidar alone decides when one hypothesis of a complete search is left. It
must be confirmed from positions far enough apart. It never decides while two are left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from estimator.mapping.keyframe import Keyframe
from estimator.mapping.map_parts import SetAside, Trial
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation.global_scan_match import Fit, Looked, Terrain, Verdict, same
from estimator.relocalisation.scene_change import Leap
from estimator.scan_matching.branch_and_bound import Around

HELD, HELD_M = 3, 1.0
"""Confirmations required of the lidar alone, and distance (m) between their positions."""

PAST, PAST_M = 4, 0.6
"""Number of earlier keyframes that a new pose has to fit, and their distance (m)."""

IDLE: Final = 8
"""Most consecutive searches without confirmation; a true pose returns with the next search."""

WATCH_M: Final = 20.0
"""Path length (m) of the trial after acceptance."""

MOST: Final = 32
"""Most hypotheses."""

BEHIND: Final = 0.15
"""Smallest lead of the confirmed hypothesis over an unconfirmed one, in score, so that the latter does not compete."""

NEARLY, NEARLY_M, NEARLY_RAD = 0.75, 0.1, 0.03
"""Inlier share and sigma (m, rad) at which another sensor may confirm an unconfirmed pose."""

STEADY, HALF = 3, 0.5
"""Searches with the same pose, and the smaller inlier share that then suffices."""

LOST: Final = 2
"""Consecutive searches that lost a pose while they confirmed another one; it then no longer competes."""

MOVED_M, MOVED_RAD = 1.0, 0.5
"""Distance (m, rad) from the stored pose above which the robot has been moved: it rolls on by less when unsteered."""

AGAIN_M, AGAIN_RAD = 1.0, 1.0
"""Path length (m) or rotation (rad) between two searches of the map."""

WORK_PER_S, SAVED_S = 1e5, 10.0
"""Nodes of searches per second: 5 % of a core (`global_scan_match.FIT_NODES`); and the time (s) of their mean."""

SOONER: Final = 0.45
"""Factor on these while no pose, or too many, have been found."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A pose that is not excluded.

    Attributes:
        T_map_odom: pose of the odom frame, by the latest search that confirmed it.
        held: those searches, oldest first.
        looks: number of searches so far.
        idle: number of latest consecutive ones without confirmation.
        share: mean inlier share.
        latest: the latest search, with any result.
        holds: number of confirmations.
    """

    T_map_odom: Array
    held: tuple[tuple[Keyframe, Fit], ...] = ()
    looks: int = 0
    idle: int = 0
    share: float = 0.0
    latest: tuple[Keyframe, Fit] | None = None
    holds: int = 0

    def after(self, frame: Keyframe, fit: Fit) -> Hypothesis:
        """The hypothesis after one more search."""
        share = (self.share * self.looks + fit.share) / (self.looks + 1)
        if fit.verdict is not Verdict.HOLDS:
            return replace(self, looks=self.looks + 1, idle=self.idle + 1, share=share, latest=(frame, fit))
        held = (*self.held[:1], *self.held[1:][-HELD:], (frame, fit))
        return Hypothesis(carried(frame, fit), held, self.looks + 1, 0, share, (frame, fit), self.holds + 1)

    def worth(self) -> float:
        """Score: mean inlier share, less the free-space violation in the latest search."""
        return self.share - (0.0 if self.latest is None else self.latest[1].against)

    def apart(self) -> float:
        """Distance (m) between the positions of its confirmations."""
        at = np.array([frame.T_odom_keyframe[:2] for frame, _ in self.held]).reshape(-1, 2)
        return float(np.hypot(*np.ptp(at, axis=0))) if len(at) else 0.0

    def firm(self) -> bool:
        """Whether it has enough confirmations, from positions far enough apart."""
        return len(self.held) >= HELD and self.apart() >= HELD_M


@dataclass(slots=True, eq=False)
class Seek:
    """The hypothesis set of a relocalisation.

    Attributes:
        alive: remaining hypotheses.
        past: some earlier keyframes that were searched.
        complete: whether the latest search was complete; then no pose outside ``alive`` is possible.
        searched: its position (odom frame).
        terrain: search map of the latest search.
        looks: number of searches so far.
        hint: T_map_odom of an operator pose, and the number of searches without a match there.
        lit: ID of the keyframe of the latest search.
        around: light's windows in it.
        t_begin: instant of the first keyframe.
        way_begin: path length when light was first valid, m.
        t_paid: instant up to which the searches so far have used up their share of a core, s.
        remembered: T_map_odom of the stored pose, if the robot has not been moved since; None: not available.
    """

    alive: tuple[Hypothesis, ...] = ()
    past: tuple[Keyframe, ...] = ()
    complete: bool = False
    searched: Array | None = None
    terrain: Terrain | None = None
    looks: int = 0
    hint: tuple[Array, int] | None = field(default=None)
    lit: int = 0
    around: tuple[Around, ...] = ()
    t_begin: float = math.inf
    way_begin: float = math.inf
    remembered: Array | None = None
    t_paid: float = -math.inf

    def pay(self, t_mono: float, work: float) -> None:
        """Charge the work of a search, in nodes, that ended at ``t_mono``."""
        self.t_paid = max(self.t_paid, t_mono - SAVED_S) + work / WORK_PER_S

    def due(self, frame: Keyframe) -> bool:
        """Whether a keyframe needs a search of the map, beyond tests of the hypotheses."""
        if self.searched is None:
            return True
        x, y, yaw = se2.between(self.searched, frame.T_odom_keyframe).tolist()
        part = 1.0 if self.alive and self.complete else SOONER
        return math.hypot(x, y) > part * AGAIN_M or abs(yaw) > part * AGAIN_RAD

    def elsewhere(self, around: tuple[Around, ...]) -> bool:
        """Whether light's windows differ from those that were searched."""
        if len(around) != len(self.around):
            return True
        return not all(any(within(one, other) for other in self.around) for one in around)

    def take(self, frame: Keyframe, asked: tuple[Hypothesis, ...], looked: Looked) -> None:
        """Apply the result of a search for ``frame``, which tested the hypotheses ``asked``."""
        fits = zip(asked, looked.guesses, strict=True)
        alive = [one.after(frame, fit) for one, fit in fits if fit.verdict is not Verdict.NO]
        for fit, earlier in looked.fresh:
            found = Hypothesis(carried(frame, fit))
            for before, past in zip(self.past, earlier, strict=True):
                found = found if past.verdict is Verdict.NO else found.after(before, past)
            alive.append(replace(found, T_map_odom=carried(frame, fit)).after(frame, fit))
        alive = distinct([one for one in alive if one.idle < IDLE], frame)
        self.alive, self.terrain, self.looks = tuple(alive[:MOST]), looked.terrain, self.looks + 1
        if looked.complete is not None:
            self.complete, self.searched = looked.complete, frame.T_odom_keyframe
        self.complete &= len(alive) <= MOST
        if not self.past or math.hypot(*(frame.T_odom_keyframe - self.past[-1].T_odom_keyframe)[:2].tolist()) > PAST_M:
            self.past = (*self.past, frame)[-PAST:]

    def favourite(self) -> Hypothesis | None:
        """The only hypothesis with a confirmation, or nearly one, if all others have clearly lower scores."""
        held = [one for one in self.alive if one.held]
        held = [one for one in held if not outdone(one, held)]
        if len(held) > 1 or not self.alive:
            return None
        best = held[0] if held else max(self.alive, key=Hypothesis.worth)
        behind = [one.worth() < best.worth() - BEHIND for one in self.alive if one is not best]
        if not all(behind):
            return None
        return best if held and not best.idle else nearly(best)

    def sure(self, one: Hypothesis, witnessed: bool) -> bool:
        """Whether to accept a hypothesis; ``witnessed``: another sensor or the operator confirms it.

        The lidar alone decides only where no other hypothesis is left.
        """
        if not self.complete or one.idle:
            return False
        most = 2 * one.holds > one.looks
        return witnessed or (len(self.alive) == 1 and most and one.firm())

    def recalled(self) -> Hypothesis | None:
        """The hypothesis at the stored pose, if the lidar confirms it, and no other one in the whole map.

        Neither suffices by itself. A kidnapped robot may be where the surroundings look alike. Of two poses that fit,
        the stored one may be wrong.
        """
        here = [one for one in self.alive if self.remembered is not None and near(self.remembered, one.T_map_odom)]
        if len(here) != 1 or not self.complete or not here[0].held or here[0].idle:
            return None
        rivals = [one for one in self.alive if one is not here[0]]
        return None if any(one.held or one.share >= here[0].share for one in rivals) else here[0]


def within(one: Around, other: Around) -> bool:
    """Whether the centre of a window lies in another one."""
    x, y, _ = (one.T_map_lidar - other.T_map_lidar).tolist()
    return math.hypot(x, y) < other.reach_m


def near(remembered: Array, T_map_odom: Array) -> bool:
    """Whether a robot at a pose may have stayed at the stored pose."""
    x, y, yaw = se2.between(remembered, T_map_odom).tolist()
    return math.hypot(x, y) < MOVED_M and abs(yaw) < MOVED_RAD


def outdone(one: Hypothesis, held: list[Hypothesis]) -> bool:
    """Whether searches no longer confirm a hypothesis while they still confirm another one often enough."""
    return one.idle >= LOST and any(not other.idle and other.holds >= HELD for other in held if other is not one)


def nearly(one: Hypothesis) -> Hypothesis | None:
    """An unconfirmed hypothesis as if confirmed, where only recent changes contradict it; else None.

    A person beside the robot leaves most of the beams. Where furniture was moved, search after search has to fit there.
    """
    if one.latest is None:
        return None
    frame, fit = one.latest
    x, y, yaw = np.sqrt(np.diag(fit.P)).tolist()
    if math.hypot(x, y) > NEARLY_M or yaw > NEARLY_RAD:
        return None
    x, y, yaw = se2.between(se2.compose(one.T_map_odom, frame.T_odom_keyframe), fit.T_map_keyframe).tolist()
    steady = one.looks >= STEADY and math.hypot(x, y) < NEARLY_M and abs(yaw) < NEARLY_RAD
    if fit.share < (HALF if steady else NEARLY):
        return None
    return replace(one, T_map_odom=carried(frame, fit), held=((frame, fit),), idle=0)


@dataclass(slots=True, eq=False, kw_only=True)
class Watch(Trial):
    """Trial of an accepted pose: later keyframes confirm or reject it while the robot drives on.

    Attributes:
        until_m: path length at its end, m.
        strikes: rejections since the last confirmation.
        terrain: search map of the latest check.
        expected: whether dead reckoning had led to that pose, without any sign of a kidnapping.
    """

    until_m: float
    expected: bool = False
    strikes: int = 0
    terrain: Terrain | None = None


@dataclass(slots=True, eq=False, kw_only=True)
class SearchedAside(SetAside):
    """An unaligned map with the hypothesis set of the search in it, ``search``."""

    search: Seek


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Question of a kidnap search.

    Attributes:
        jumped: whether the pose jumped.
        holds: whether the pose is confirmed in the local map.
        again: whether an earlier search ended at its cap.
        leapt: whether the scene changed.
        opportunity: whether there was an opportunity for a kidnapping (`kidnap_opportunity`).
        share: inlier share in the local map.
        odd: whether a match moved the pose by more than the prediction allows.
    """

    jumped: bool
    holds: bool
    again: bool
    leapt: bool = False
    opportunity: bool = True
    share: float = 0.0
    odd: bool = True

    def moved(self) -> bool:
        """Whether a jump, a surprising match or a changed scene shows that the robot was moved."""
        return self.jumped or self.leapt or self.odd


@dataclass(slots=True, eq=False)
class Contradiction:
    """Mean share of the local map in view that the scans since the last match see through; ``count`` of them."""

    count: int = 0
    mean: float = 0.0

    def add(self, share: float) -> None:
        """Add a scan that did not match; a negative share is no evidence."""
        if share >= 0.0:
            self.count += 1
            self.mean += (share - self.mean) / self.count


@dataclass(slots=True, eq=False)
class Suspicion:
    """State of kidnap detection (`kidnap_detection`).

    Attributes:
        fitted: number of scans that have matched since the trigger, 0: no trigger.
        jumped: whether the pose jumped.
        odd: whether a match has moved it by more than the prediction allows.
        share: usual inlier share.
        t_still, moved: begin of the wheels' rest, by the readings since the last match, and their motion since (x, y,
            yaw).
        unwatched_s: longest rest since that match that ended with motion.
        t_rest, rested: begin of the wheels' rest, with or without matches, and their motion since.
        through: share seen through when they stopped, negative before the first scan.
        gone: motion of the wheels since then.
        strange_s: total duration of a larger share since.
        t_strange: latest instant of it.
        contradiction: of the scans since the last match.
        period_s: usual time between two matches, 0 before it is known.
        question: question of the running search, None: there is none.
        t_asked: instant of its start.
        again: whether the next one may open more nodes.
        since: ID of the first keyframe that may be of another position, 0: none.
        leap: state of the scene change detection.
        t_leap: instant of a scene change that has not been judged yet.
        leapt: whether the scene has changed.
        opportunity: whether there was an opportunity for a kidnapping that nothing has resolved.
    """

    fitted: int = 0
    jumped: bool = False
    odd: bool = False
    share: float = 0.0
    t_still: float = -math.inf
    moved: Array = field(default_factory=lambda: np.zeros(3))
    unwatched_s: float = 0.0
    t_rest: float = math.inf
    rested: Array = field(default_factory=lambda: np.zeros(3))
    through: float = -1.0
    gone: Array = field(default_factory=lambda: np.zeros(3))
    strange_s: float = 0.0
    t_strange: float = -math.inf
    period_s: float = 0.0
    question: Question | None = None
    t_asked: float = -math.inf
    again: bool = False
    since: int = 0
    leap: Leap = field(default_factory=Leap)
    t_leap: float = -math.inf
    leapt: bool = False
    opportunity: bool = False
    contradiction: Contradiction = field(default_factory=Contradiction)

    def settle(self) -> None:
        """Clear the trigger, when its search has been asked for."""
        self.fitted, self.jumped, self.odd, self.again = 0, False, False, False
        self.leapt = self.opportunity = False

    def end(self) -> None:
        """Clear the trigger and abandon the search."""
        self.settle()
        self.question, self.since = None, 0


def carried(frame: Keyframe, fit: Fit) -> Array:
    """``T_map_odom`` that puts a keyframe at its matched pose."""
    return se2.compose(fit.T_map_keyframe, se2.inverse(frame.T_odom_keyframe))


def distinct(found: list[Hypothesis], frame: Keyframe) -> list[Hypothesis]:
    """Of hypotheses with the same robot pose, the one with the most confirmations."""
    kept: list[Hypothesis] = []
    for one in sorted(found, key=lambda one: (-len(one.held), -one.share)):
        T = se2.compose(one.T_map_odom, frame.T_odom_keyframe)
        if not any(same(T, se2.compose(other.T_map_odom, frame.T_odom_keyframe)) for other in kept):
            kept.append(one)
    return kept

"""Hypotheses of the pose during relocalisation: found by searches of the map, predicted by odometry, ruled out.

A place is a hypothesis of where the odom frame lies. Every look at a later keyframe tests each of them where odometry
says that the robot must be by now; a place that is found later has to be true of the earlier keyframes too. The laser
alone has decided when one place is left over, of all that a complete search has offered, and has held from places far
enough apart. It never has while two are left.
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
"""So many looks, from places so far apart, have to hold a place before the laser alone is believed."""

PAST, PAST_M = 4, 0.6
"""Earlier keyframes that a new place has to be true of, and how far apart they are."""

IDLE: Final = 8
"""Looks in a row that may leave a place open; one that holds comes back with the next search."""

WATCH_M: Final = 20.0
"""Way for which a place is watched once it was found."""

MOST: Final = 32
"""Hypotheses carried at most."""

BEHIND: Final = 0.15
"""By how much the worth of a place that was never held must be less than that of the one that was, to be no rival."""

NEARLY, NEARLY_M, NEARLY_RAD = 0.75, 0.1, 0.03
"""Share of the beams, and deviations, of a place that another witness may confirm though no look has held it."""

STEADY, HALF = 3, 0.5
"""So many looks have to have found it in the same place, with this share, where less of the beams fit."""

LOST: Final = 2
"""Looks in a row that lost a place while they held another one: it is no rival of that one any more."""

MOVED_M, MOVED_RAD = 1.0, 0.5
"""A robot that is farther from where it was remembered has been moved: more than it rolls on once it is not steered."""

AGAIN_M, AGAIN_RAD = 1.0, 1.0
"""Way or turn after which it is searched again."""

SOONER: Final = 0.45
"""Part of that where nothing has been found yet, or too much."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A place that nothing has ruled out.

    Attributes:
        T_map_odom: where the odom frame then lies, by the latest look that held it. held: those looks, oldest first.
        looks: at it so far; idle: how many of them in a row have left it open. share: mean share of the beams.
        latest: the latest look, whatever it said. holds: how many looks held it.
    """

    T_map_odom: Array
    held: tuple[tuple[Keyframe, Fit], ...] = ()
    looks: int = 0
    idle: int = 0
    share: float = 0.0
    latest: tuple[Keyframe, Fit] | None = None
    holds: int = 0

    def after(self, frame: Keyframe, fit: Fit) -> Hypothesis:
        """The hypothesis after one look more."""
        share = (self.share * self.looks + fit.share) / (self.looks + 1)
        if fit.verdict is not Verdict.HOLDS:
            return replace(self, looks=self.looks + 1, idle=self.idle + 1, share=share, latest=(frame, fit))
        held = (*self.held[:1], *self.held[1:][-HELD:], (frame, fit))
        return Hypothesis(carried(frame, fit), held, self.looks + 1, 0, share, (frame, fit), self.holds + 1)

    def worth(self) -> float:
        """The share of the beams that fit, less that of the evidence which spoke against it at the latest look."""
        return self.share - (0.0 if self.latest is None else self.latest[1].against)

    def apart(self) -> float:
        """Metres between the places it was held from."""
        at = np.array([frame.T_odom_keyframe[:2] for frame, _ in self.held]).reshape(-1, 2)
        return float(np.hypot(*np.ptp(at, axis=0))) if len(at) else 0.0

    def firm(self) -> bool:
        """Whether enough looks have held it, from places far enough apart."""
        return len(self.held) >= HELD and self.apart() >= HELD_M


@dataclass(slots=True, eq=False)
class Seek:
    """What has been found since the robot is being relocalised.

    Attributes:
        alive: places left. past: some earlier keyframes that were looked for. complete: the latest search was; then
            nothing but ``alive`` is left. searched: where that was (odom frame). terrain: of the latest look.
        looks: so far. hint: T_map_odom by a person who has said where the robot is, and
            how many looks have not found it there. lit: keyframe of the latest look. around: light's windows where it
            was searched.
        t_begin: instant of the first keyframe. way_begin: way driven when light was first good.
        remembered: T_map_odom if the robot has not been moved since the run before; None: nobody knows.
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

    def due(self, frame: Keyframe) -> bool:
        """Whether a keyframe is to be searched for, and not only looked at where it should be."""
        if self.searched is None:
            return True
        x, y, yaw = se2.between(self.searched, frame.T_odom_keyframe).tolist()
        part = 1.0 if self.alive and self.complete else SOONER
        return math.hypot(x, y) > part * AGAIN_M or abs(yaw) > part * AGAIN_RAD

    def elsewhere(self, around: tuple[Around, ...]) -> bool:
        """Whether light's windows are others than those that were searched."""
        if len(around) != len(self.around):
            return True
        return not all(any(within(one, other) for other in self.around) for one in around)

    def take(self, frame: Keyframe, asked: tuple[Hypothesis, ...], looked: Looked) -> None:
        """Take in a look at ``frame``, which was asked for the hypotheses ``asked``."""
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
        """The only place that a look has held, or nearly, if there is one and all others are well behind it."""
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
        """Whether a place is the robot's; ``witnessed``: something else than the laser says so.

        The laser alone is believed only where nothing else is left.
        """
        if not self.complete or one.idle:
            return False
        most = 2 * one.holds > one.looks
        return witnessed or (len(self.alive) == 1 and most and one.firm())

    def recalled(self) -> Hypothesis | None:
        """The place where the robot stood last, if the laser holds it, and no other one in the whole map.

        Neither is enough by itself: a robot that was carried off may stand where it looks alike, and of two places
        that fit the remembered one may be the wrong one.
        """
        here = [one for one in self.alive if self.remembered is not None and near(self.remembered, one.T_map_odom)]
        if len(here) != 1 or not self.complete or not here[0].held or here[0].idle:
            return None
        rivals = [one for one in self.alive if one is not here[0]]
        return None if any(one.held or one.share >= here[0].share for one in rivals) else here[0]


def within(one: Around, other: Around) -> bool:
    """Whether the middle of a window lies in another one."""
    x, y, _ = (one.T_map_lidar - other.T_map_lidar).tolist()
    return math.hypot(x, y) < other.reach_m


def near(remembered: Array, T_map_odom: Array) -> bool:
    """Whether a robot that is found there may have been left where it is remembered."""
    x, y, yaw = se2.between(remembered, T_map_odom).tolist()
    return math.hypot(x, y) < MOVED_M and abs(yaw) < MOVED_RAD


def outdone(one: Hypothesis, held: list[Hypothesis]) -> bool:
    """Whether looks have lost a place that they once held while they went on holding another one, and surely."""
    return one.idle >= LOST and any(not other.idle and other.holds >= HELD for other in held if other is not one)


def nearly(one: Hypothesis) -> Hypothesis | None:
    """A place that no look has held, as if the latest had, where only what has changed since spoke against it.

    Somebody who stands about leaves most of the beams; where furniture was moved, look after look has to fit there.
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
    """A place that was found is confirmed, or refuted, by looks while the robot drives on.

    Attributes:
        until_m: way until which it is watched, m. strikes: looks that have spoken against it since one held it.
        terrain: of the latest look.
    """

    until_m: float
    strikes: int = 0
    terrain: Terrain | None = None


@dataclass(slots=True, eq=False, kw_only=True)
class SearchedAside(SetAside):
    """A stored map that is set aside while the robot is looked for in it; ``search``: so far."""

    search: Seek


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """What a look is to decide: whether the robot was carried off.

    Attributes:
        jumped: the pose did. holds: the place does, in the local map. again: an earlier search had to be ended.
        leapt: what is seen did.
    """

    jumped: bool
    holds: bool
    again: bool
    leapt: bool = False


@dataclass(slots=True, eq=False)
class Suspicion:
    """What is remembered from scan to scan of whether the robot was carried off (`kidnap_detection`).

    Attributes:
        fitted: scans that have fitted since something else raised the suspicion, 0: nothing has. jumped: the pose did.
        odd: a match has moved it by more than the prediction allowed. share: of the beams that fits usually.
        t_still: since when the wheels stand, as far as they have told since the last match; moved: by what they have
            turned meanwhile (x, y, yaw). unwatched_s: the longest time since that match for which they stood, and
            turned then.
        t_rest: since when the wheels stand, whether matches come or not; rested: by what they have turned meanwhile.
        through: share of what should be in view that was looked through when they stopped, negative before the first
            scan; gone: how far they have turned since then. strange_s: for so long more of it has been since;
            t_strange: when it last was.
        period_s: usual time between two matches, 0 before it is known.
        question: what the look under way decides, None: there is none. t_asked: when it was asked for.
        again: the next one may search more.
        since: ID of the first keyframe that may be of another place, 0: none.
        leap: what is remembered of the latest scans. t_leap: instant of one that nobody has judged yet. leapt: what is
            seen has changed all at once.
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

    def end(self) -> None:
        """Suspect nothing, and wait for no answer."""
        self.leapt = False
        self.fitted, self.jumped, self.odd, self.question, self.again, self.since = 0, False, False, None, False, 0


def carried(frame: Keyframe, fit: Fit) -> Array:
    """``T_map_odom`` that puts a keyframe where it was found."""
    return se2.compose(fit.T_map_keyframe, se2.inverse(frame.T_odom_keyframe))


def distinct(found: list[Hypothesis], frame: Keyframe) -> list[Hypothesis]:
    """Of those that put the robot into the same place the one that was held most."""
    kept: list[Hypothesis] = []
    for one in sorted(found, key=lambda one: (-len(one.held), -one.share)):
        T = se2.compose(one.T_map_odom, frame.T_odom_keyframe)
        if not any(same(T, se2.compose(other.T_map_odom, frame.T_odom_keyframe)) for other in kept):
            kept.append(one)
    return kept

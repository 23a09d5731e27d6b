"""Scan to map (Sect. 4.3): whether a keyframe has been at the place of an earlier submap before, and how sure that is.

Step 2 of the paper, where enough links are clear: the lamps in view must be known in the submap (`IDS`; the paper asks
for all of them), and what light alone said of both places must agree with the match (`LIGHT`). Where they are not,
registration is by laser only.
Step 3: data association by the matcher, and then the threshold on the residual (`SSE`), the share of beams that fit
(`OVERLAP`), what speaks against it (`AGAINST`: beams that look through the map, points that hang in free space), no
axis left open (`RANK`), and the place where it was expected (`PLACE`). Where the pose is vague a wide search offers
several places: if two of them pass, nothing is closed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from estimator.mapping.keyframe import Keyframe, Settled, Submap, points_of_frame
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import LoopReason, MatchResult
from estimator.scan_matching.branch_and_bound import Around, SearchSettings, field_of, search
from estimator.scan_matching.deskew import oriented
from estimator.scan_matching.local_map import LocalMap, contradicted
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, View, match

DOUBT: Final = 2.0
"""By how much the variance of a position from light is raised: its errors hang together farther than it knows."""

BLURRED: Final = np.diag((0.05**2, 0.05**2, 0.02**2))
"""Covariance of what stamps, lever arms and the bending of a submap make of the difference of two places by light."""


class Condition(Enum):
    """A judgement that a loop has to pass; any subset may be asked for (`LoopSettings.conditions`)."""

    IDS = "the lamps in view are known in the submap"
    LIGHT = "what light alone said of both places agrees with the match"
    PLACE = "it lies within five deviations of where it was expected"
    SSE = "the beams that fit, fit closely"
    OVERLAP = "most of the beams fit"
    AGAINST = "next to nothing speaks against it"
    RANK = "no axis is left open"


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """When a loop is one.

    Attributes:
        conditions: which judgements are made at all; what follows says how strict each is. `IDS` is left out: where
            every lamp in view must be known in one submap, every fifth right loop is lost and none that is wrong.
        links: how many links must be clear for light to have a say (Link_n).
        light: largest squared Mahalanobis distance (3 degrees of freedom; 16.3 is 99.9 %) between the match and what
            light alone says. place: the same between the match and the expected place.
        shared: least share of the lamps in view that must be known in the submap (the paper: 1).
        sse_m: largest root mean square distance of the fitting beams from the map's surfaces (the paper's threshold).
        share: least share of the beams that fit. against: largest share of the evidence that speaks against.
        extra_m, extra_rad: errors of a match that its own covariance does not know: bent submaps, moved furniture.
        recent_m: way back over which a submap is no loop but the way just driven.
        reach_m: how near, beyond three deviations, a submap must be to be looked at; most_m: however uncertain.
        candidates: submaps looked at for one keyframe. turned_m: half by how much nearer one that looks the same way is
            than one that looks the other way. every: a look for every so many keyframes.
        sure_m, sure_rad: deviations of the expected place up to which the matcher finds it by itself.
        points: of a scan, at most. places: that a wide search may offer; two of them that fit close nothing.
        supported_m, supported_rad: a loop that moves the pose by more than this waits for others that agree within half
            of this, over as much way as it moves the pose (or a turn); one in between that is off by more refutes them.
    """

    conditions: frozenset[Condition] = frozenset(Condition) - {Condition.IDS}
    links: int = 4
    shared: float = 1.0
    light: float = 16.3
    place: float = 25.0
    sse_m: float = 0.06
    share: float = 0.7
    against: float = 0.05
    extra_m: float = 0.02
    extra_rad: float = 0.007
    recent_m: float = 10.0
    reach_m: float = 3.0
    most_m: float = 12.0
    candidates: int = 2
    turned_m: float = 2.0
    every: int = 3
    sure_m: float = 0.5
    sure_rad: float = 0.15
    points: int = 180
    places: int = 3
    supported_m: float = 0.3
    supported_rad: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What light alone, at keyframe and submap, says of the one seen from the other.

    Attributes:
        T_submap_keyframe, P: where, with the covariance (3x3, axes of the submap). shared: share of the lamps in view
            of the keyframe that are known in the submap.
    """

    T_submap_keyframe: Array
    P: Array
    shared: float


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A submap in which the keyframe may be seen again: where, with the covariance of that guess (3x3, its axes).

    ``told``: by light, None where it is paused or has never seen the submap.
    """

    key: int
    submap: Settled
    T_submap_keyframe: Array
    P: Array
    told: Told | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A keyframe found again in submap ``key``.

    Attributes:
        T_submap_keyframe: where; P: covariance (3x3, axes of the submap). share, against, residual_m: how well.
        moved: (x, y, yaw) from where it was expected, in the keyframe's axes. reason: which conditions it passed.
        known: whether no axis is open. off: squared Mahalanobis distance from the expected place; light: from what
            light says, None where it says nothing. shared: as of `Told`. alone: whether no other place passed too;
            where one did it is no loop, but says that the surroundings repeat.
    """

    key: int
    T_submap_keyframe: Array
    P: Array
    share: float
    against: float
    residual_m: float
    moved: Array
    reason: LoopReason = LoopReason.NEAR
    known: bool = True
    off: float = 0.0
    light: float | None = None
    shared: float = 1.0
    alone: bool = True


def look(frame: Keyframe, candidates: tuple[Candidate, ...], settings: LoopSettings) -> tuple[Found, ...]:
    """Look for a keyframe in each of the candidates."""
    found = (look_in(frame, candidate, settings) for candidate in candidates)
    return tuple(one for one in found if one is not None)


def look_in(frame: Keyframe, candidate: Candidate, settings: LoopSettings) -> Found | None:
    """Look for a keyframe in one submap; what is found is a loop only if it is ``alone``."""
    found = foremost([one for one in judged(frame, candidate, settings) if passed(one, settings)], settings)
    if found is None or not found.alone:
        return found
    if found.light is not None and Condition.LIGHT in settings.conditions:
        return replace(found, reason=LoopReason.LIT)
    return replace(found, reason=LoopReason.SEARCHED) if unsure(candidate.P, settings) else found


def judged(frame: Keyframe, candidate: Candidate, settings: LoopSettings) -> list[Found]:
    """All places of a submap that a matcher takes the keyframe to, with what is known about each: not yet loops."""
    sigma = candidate.submap.sigma
    points = points_of_frame(frame, sigma)
    if len(points.xy) < MatchSettings().min_points or len(candidate.submap.elements) < MatchSettings().min_points:
        return []
    starts = [candidate.T_submap_keyframe]
    if unsure(candidate.P, settings):
        starts += wide(frame, points.xy, candidate, settings)
    local = candidate.submap.local()
    view = View(oriented(points, settings.points), frame.T_base_lidar, frame.beams(), sigma)
    loose = np.diag((settings.sure_m**-2, settings.sure_m**-2, settings.sure_rad**-2))
    results = [match(view, local, Prior(start, loose), 60, MatchSettings()) for start in starts]
    return [judgement(view, local, result, candidate, settings) for result in results if result.ok]


def unsure(P: Array, settings: LoopSettings) -> bool:
    """Whether a guess is too vague for the matcher alone."""
    deviation = np.sqrt(np.diag(P))
    return bool(np.hypot(*deviation[:2]) > settings.sure_m or deviation[2] > settings.sure_rad)


def foremost(fit: list[Found], settings: LoopSettings) -> Found | None:
    """The best of several that passed; not ``alone`` where another is a different place: which one cannot be told."""
    if not fit:
        return None
    found = max(fit, key=lambda one: one.share)
    for other in fit:
        x, y, yaw = se2.between(found.T_submap_keyframe, other.T_submap_keyframe).tolist()
        if np.hypot(x, y) > settings.supported_m or abs(yaw) > settings.supported_rad:
            return replace(found, alone=False)
    return found


def judgement(view: View, local: LocalMap, result: MatchResult, candidate: Candidate, settings: LoopSettings) -> Found:
    """What there is to say about a match."""
    T, told = result.T_odom_base, candidate.told
    against = contradicted(local, se2.compose(T, view.T_base_lidar), view.beams, view.noise_m)
    extra = np.diag((settings.extra_m**2, settings.extra_m**2, settings.extra_rad**2))
    P = invert3(result.information) + extra
    return Found(
        candidate.key,
        T,
        P,
        result.inliers / max(1, result.queries),
        against,
        result.residual_m,
        se2.between(candidate.T_submap_keyframe, T),
        known=bool(result.known_axes.all()),
        off=distance(candidate.T_submap_keyframe, T, candidate.P + P),
        light=None if told is None else distance(told.T_submap_keyframe, T, told.P + P),
        shared=1.0 if told is None else told.shared,
    )


def distance(T_from: Array, T_to: Array, P: Array) -> float:
    """Squared Mahalanobis distance of two places, ``P`` in the axes that both are given in."""
    off = se2.rotation(T_from[2]) @ se2.between(T_from, T_to)
    return float(off @ invert3(P) @ off)


def passed(found: Found, settings: LoopSettings) -> bool:
    """Whether a judgement makes a loop."""
    verdict = {
        Condition.IDS: found.shared >= settings.shared,
        Condition.LIGHT: found.light is None or found.light <= settings.light,
        Condition.PLACE: found.off <= settings.place,
        Condition.SSE: found.residual_m <= settings.sse_m,
        Condition.OVERLAP: found.share >= settings.share,
        Condition.AGAINST: found.against <= settings.against,
        Condition.RANK: found.known,
    }
    return all(verdict[condition] for condition in settings.conditions)


def told_by_light(frame: Keyframe, submap: Submap, settings: LoopSettings) -> Told | None:
    """Step 2 of Sect. 4.3: None where too few links are clear, which leaves the registration to the laser."""
    virtual = frame.virtual
    if virtual is None or submap.light is None or len(virtual.accepted) < max(1, settings.links):
        return None
    T_map_submap, P_submap = submap.light
    T = se2.between(T_map_submap, virtual.T_map_base)
    # an error of the submap's heading moves the keyframe sideways, seen from the submap
    R = se2.rotation(-T_map_submap[2])
    lever = np.array(((1.0, 0.0, -T[1]), (0.0, 1.0, T[0]), (0.0, 0.0, 1.0)))
    P = R @ virtual.covariance @ R.T + lever @ R @ P_submap @ R.T @ lever.T
    shared = len(virtual.accepted & submap.lamps) / len(virtual.accepted)
    return Told(T, DOUBT * P + BLURRED, shared)


def wide(frame: Keyframe, points: Array, candidate: Candidate, settings: LoopSettings) -> list[Array]:
    """The places within three deviations where a scan fits best."""
    deviation = 3.0 * np.sqrt(np.diag(candidate.P))
    at = se2.compose(candidate.T_submap_keyframe, frame.T_base_lidar)
    reach = min(float(deviation[:2].max()), settings.most_m), min(float(deviation[2]), np.pi)
    around = Around(at, *reach)
    seen = se2.apply(se2.inverse(frame.T_base_lidar), points)
    field = field_of(candidate.submap.elements[:, :2].astype(np.float64), 0.1, 0.1, 0.5, around)
    asked = SearchSettings(least=0.4, hits=settings.places, nodes=400_000, points=settings.points, around=around)
    lidar_base = se2.inverse(frame.T_base_lidar)
    return [se2.compose(hit.T_map_lidar, lidar_base) for hit in search(field, seen, asked).hits]

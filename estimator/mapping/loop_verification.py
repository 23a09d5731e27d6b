"""Loop verification (Sect. 4.3): match of a keyframe to an earlier submap, and the conditions of a loop closure.

Step 2 of the paper applies where enough links are clear. The lamps in view must be known in the submap (`IDS`; the
paper requires all of them). The light solutions at both positions must agree with the match (`LIGHT`). Otherwise
registration is by lidar only.
Step 3 is data association by the matcher, followed by thresholds. They limit the residual (`SSE`), the share of beams
that fit (`OVERLAP`) and the free-space violation (`AGAINST`). They require all axes (`RANK`), and the expected position
(`PLACE`). Where the predicted pose is uncertain, a wide search gives several positions. If two of them pass, no loop is
closed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from estimator.job_queue import job_function
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
"""Inflation of the variance of a light position: its errors are correlated over longer times than it assumes."""

BLURRED: Final = np.diag((0.05**2, 0.05**2, 0.02**2))
"""Covariance of stamp errors, lever arms and submap deformation in the difference of two light solutions."""


class Condition(Enum):
    """A condition of a loop; any subset may be in use (`LoopSettings.conditions`)."""

    IDS = "the lamps in view are known in the submap"
    LIGHT = "what light alone said of both places agrees with the match"
    PLACE = "it lies within five deviations of where it was expected"
    SSE = "the beams that fit, fit closely"
    OVERLAP = "most of the beams fit"
    AGAINST = "next to nothing speaks against it"
    RANK = "no axis is left open"


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """Thresholds of loop closure.

    Attributes:
        conditions: conditions in use; the other fields are their thresholds. `IDS` is not used by default. With
            all lamps in view required in one submap, every fifth correct loop is lost and no wrong one.
        links: fewest clear links for the use of light (Link_n).
        light: largest squared Mahalanobis distance (3 degrees of freedom; 16.3 is 99.9 %) between the match and the
            light solution.
        place: the same between the match and the expected pose.
        shared: smallest share of the lamps in view that must be known in the submap (the paper: 1).
        sse_m: largest root mean square distance of the fitting beams from the map's surfaces (the paper's threshold).
        share: smallest inlier share.
        against: largest free-space violation.
        extra_m, extra_rad: errors of a match outside its covariance: deformed submaps, moved furniture.
        recent_m: path length back to the newest submap that can give a loop.
        reach_m: largest distance of a candidate, beyond three sigma.
        most_m: largest distance, however uncertain.
        candidates: most submaps searched for one keyframe.
        turned_m: half of the distance by which a submap with the opposite heading ranks behind one with the same.
        every: keyframes between two searches.
        sure_m, sure_rad: sigma of the expected pose up to which the matcher needs no wide search.
        points: of a scan, at most.
        places: most positions of a wide search; two of them that fit close no loop.
        supported_m, supported_rad: correction above which a loop waits for others that agree within half of it. These
            must cover a path as long as the correction (or a rotation); one in between that differs by more refutes
            them.
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
    """Relative pose of a keyframe and a submap by the light solutions at both.

    Attributes:
        T_submap_keyframe, P: the pose, with the covariance (3x3, axes of the submap).
        shared: share of the lamps in view of the keyframe that are known in the submap.
    """

    T_submap_keyframe: Array
    P: Array
    shared: float


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A submap that may contain the keyframe: expected pose there, with its covariance (3x3, its axes).

    ``told``: the pose by light, None where light is paused or has never seen the submap.
    """

    key: int
    submap: Settled
    T_submap_keyframe: Array
    P: Array
    told: Told | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A match of a keyframe in submap ``key``.

    Attributes:
        T_submap_keyframe, P: the pose and its covariance (3x3, axes of the submap).
        share, against, residual_m: inlier share, free-space violation and residual.
        moved: (x, y, yaw) from the expected pose, in the keyframe's axes.
        reason: conditions that it passed.
        known: whether every axis is known.
        off: squared Mahalanobis distance from the expected pose.
        light: the same from the light solution, None without one.
        shared: as of `Told`.
        alone: whether no other position passed. Otherwise it is no loop, but shows that the surroundings repeat.
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


@job_function
def look(frame: Keyframe, candidates: tuple[Candidate, ...], settings: LoopSettings) -> tuple[Found, ...]:
    """Search a keyframe in each of the candidates."""
    found = (look_in(frame, candidate, settings) for candidate in candidates)
    return tuple(one for one in found if one is not None)


def look_in(frame: Keyframe, candidate: Candidate, settings: LoopSettings) -> Found | None:
    """Search a keyframe in one submap; the result is a loop only if it is ``alone``."""
    found = foremost([one for one in judged(frame, candidate, settings) if passed(one, settings)], settings)
    if found is None or not found.alone:
        return found
    if found.light is not None and Condition.LIGHT in settings.conditions:
        return replace(found, reason=LoopReason.LIT)
    return replace(found, reason=LoopReason.SEARCHED) if unsure(candidate.P, settings) else found


def judged(frame: Keyframe, candidate: Candidate, settings: LoopSettings) -> list[Found]:
    """All matches of the keyframe in a submap, with their figures; none is a loop yet."""
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
    """Whether an expected pose is too uncertain for the matcher without a wide search."""
    deviation = np.sqrt(np.diag(P))
    return bool(np.hypot(*deviation[:2]) > settings.sure_m or deviation[2] > settings.sure_rad)


def foremost(fit: list[Found], settings: LoopSettings) -> Found | None:
    """The best of several that passed; not ``alone`` where another one lies at a different position."""
    if not fit:
        return None
    found = max(fit, key=lambda one: one.share)
    for other in fit:
        x, y, yaw = se2.between(found.T_submap_keyframe, other.T_submap_keyframe).tolist()
        if np.hypot(x, y) > settings.supported_m or abs(yaw) > settings.supported_rad:
            return replace(found, alone=False)
    return found


def judgement(view: View, local: LocalMap, result: MatchResult, candidate: Candidate, settings: LoopSettings) -> Found:
    """Figures of a match."""
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
    """Squared Mahalanobis distance of two poses, ``P`` in the axes of both."""
    off = se2.rotation(T_from[2]) @ se2.between(T_from, T_to)
    return float(off @ invert3(P) @ off)


def passed(found: Found, settings: LoopSettings) -> bool:
    """Whether a match passes all conditions of a loop."""
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
    """Step 2 of Sect. 4.3: relative pose by light; None where too few links are clear."""
    virtual = frame.virtual
    if virtual is None or submap.light is None or len(virtual.accepted) < max(1, settings.links):
        return None
    T_map_submap, P_submap = submap.light
    T = se2.between(T_map_submap, virtual.T_map_base)
    # an error of the submap's heading moves the keyframe sideways in the submap's frame
    R = se2.rotation(-T_map_submap[2])
    lever = np.array(((1.0, 0.0, -T[1]), (0.0, 1.0, T[0]), (0.0, 0.0, 1.0)))
    P = R @ virtual.covariance @ R.T + lever @ R @ P_submap @ R.T @ lever.T
    shared = len(virtual.accepted & submap.lamps) / len(virtual.accepted)
    return Told(T, DOUBT * P + BLURRED, shared)


def wide(frame: Keyframe, points: Array, candidate: Candidate, settings: LoopSettings) -> list[Array]:
    """The positions within three sigma where a scan fits best."""
    deviation = 3.0 * np.sqrt(np.diag(candidate.P))
    at = se2.compose(candidate.T_submap_keyframe, frame.T_base_lidar)
    reach = min(float(deviation[:2].max()), settings.most_m), min(float(deviation[2]), np.pi)
    around = Around(at, *reach)
    seen = se2.apply(se2.inverse(frame.T_base_lidar), points)
    field = field_of(candidate.submap.elements[:, :2].astype(np.float64), 0.1, 0.1, 0.5, around)
    asked = SearchSettings(least=0.4, hits=settings.places, nodes=400_000, points=settings.points, around=around)
    lidar_base = se2.inverse(frame.T_base_lidar)
    return [se2.compose(hit.T_map_lidar, lidar_base) for hit in search(field, seen, asked).hits]

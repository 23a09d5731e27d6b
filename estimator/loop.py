"""Scan to map (Sect. 4.3): whether a keyframe has been at the place of an earlier submap before, and how sure that is.

A loop is accepted on overlap (the share of beams that fit), on what speaks against it (beams that look through the
map, points that hang in free space), on rank (no axis may be left open) and on the residual. Where the pose is vague a
wide search offers several places: if two of them are accepted, nothing is closed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator import se2
from estimator.globalsearch import Around, SearchSettings, field_of, search
from estimator.keyframe import Keyframe
from estimator.linear3 import invert3
from estimator.localmap import LocalMap, contradicted
from estimator.matching import MatchSettings, Prior, View, match
from estimator.records import Array
from estimator.result import LoopReason, MatchResult
from estimator.scanpoints import oriented
from estimator.submap import Settled, points_of_frame


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """When a loop is one.

    Attributes:
        sse_m: largest root mean square distance of the fitting beams from the map's surfaces (the paper's threshold).
        share: least share of the beams that fit. against: largest share of the evidence that speaks against.
        extra_m, extra_rad: errors of a match that its own covariance does not know: bent submaps, moved furniture.
        recent_m: way back over which a submap is no loop but the way just driven.
        reach_m: how near, beyond three deviations, a submap must be to be looked at; most_m: however uncertain.
        candidates: submaps looked at for one keyframe. every: a look for every so many keyframes.
        sure_m, sure_rad: deviations of the expected place up to which the matcher finds it by itself.
        points: of a scan, at most. places: that a wide search may offer; two of them that fit close nothing.
        supported_m, supported_rad: a loop that moves the pose by more than this waits for a second one that agrees as
            well as this.
    """

    sse_m: float = 0.06
    share: float = 0.7
    against: float = 0.05
    extra_m: float = 0.02
    extra_rad: float = 0.007
    recent_m: float = 10.0
    reach_m: float = 3.0
    most_m: float = 12.0
    candidates: int = 2
    every: int = 3
    sure_m: float = 0.5
    sure_rad: float = 0.15
    points: int = 180
    places: int = 3
    supported_m: float = 0.3
    supported_rad: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A submap in which the keyframe may be seen again: where, with the covariance of that guess (3x3, its axes)."""

    key: int
    submap: Settled
    T_submap_keyframe: Array
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A keyframe found again in submap ``key``.

    Attributes:
        T_submap_keyframe: where; P: covariance (3x3, axes of the submap). share, against, residual_m: how well.
        moved: (x, y, yaw) from where it was expected, in the keyframe's axes. reason: which conditions it passed.
    """

    key: int
    T_submap_keyframe: Array
    P: Array
    share: float
    against: float
    residual_m: float
    moved: Array
    reason: LoopReason = LoopReason.NEAR


def look(frame: Keyframe, candidates: tuple[Candidate, ...], settings: LoopSettings) -> tuple[Found, ...]:
    """Look for a keyframe in each of the candidates."""
    found = (look_in(frame, candidate, settings) for candidate in candidates)
    return tuple(one for one in found if one is not None)


def look_in(frame: Keyframe, candidate: Candidate, settings: LoopSettings) -> Found | None:
    """Look for a keyframe in one submap."""
    sigma = candidate.submap.sigma
    points = points_of_frame(frame, sigma)
    if len(points.xy) < MatchSettings().min_points or len(candidate.submap.elements) < MatchSettings().min_points:
        return None
    starts = [candidate.T_submap_keyframe]
    deviation = np.sqrt(np.diag(candidate.P))
    if float(np.hypot(*deviation[:2])) > settings.sure_m or deviation[2] > settings.sure_rad:
        starts += wide(frame, points.xy, candidate, settings)
    local = candidate.submap.local()
    view = View(oriented(points, settings.points), frame.T_base_lidar, frame.beams(), sigma)
    loose = np.diag((settings.sure_m**-2, settings.sure_m**-2, settings.sure_rad**-2))
    results = [match(view, local, Prior(start, loose), 60, MatchSettings()) for start in starts]
    found = the_one([judged(view, local, result, candidate, settings) for result in results], settings)
    return found if found is None or len(starts) == 1 else replace(found, reason=LoopReason.SEARCHED)


def the_one(judgements: list[Found | None], settings: LoopSettings) -> Found | None:
    """The best of several that fit, None where two of them are different places: which one cannot be told."""
    fit = [found for found in judgements if found is not None]
    if not fit:
        return None
    best = max(fit, key=lambda found: found.share)
    for other in fit:
        x, y, yaw = se2.between(best.T_submap_keyframe, other.T_submap_keyframe).tolist()
        if np.hypot(x, y) > settings.supported_m or abs(yaw) > settings.supported_rad:
            return None
    return best


def judged(
    view: View, local: LocalMap, result: MatchResult, candidate: Candidate, settings: LoopSettings
) -> Found | None:
    """The match as a loop, if it is one."""
    share = result.inliers / max(1, result.queries)
    if not result.ok or not result.known_axes.all() or share < settings.share or result.residual_m > settings.sse_m:
        return None
    T = result.T_odom_base
    against = contradicted(local, se2.compose(T, view.T_base_lidar), view.beams, view.noise_m)
    if against > settings.against:
        return None
    extra = np.diag((settings.extra_m**2, settings.extra_m**2, settings.extra_rad**2))
    P = invert3(result.information) + extra
    moved = se2.between(candidate.T_submap_keyframe, T)
    R = se2.rotation(candidate.T_submap_keyframe[2])
    off = R @ moved
    if float(off @ invert3(candidate.P + P) @ off) > 25.0:
        return None
    return Found(candidate.key, T, P, share, against, result.residual_m, moved)


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

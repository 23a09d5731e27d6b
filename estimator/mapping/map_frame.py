"""The map frame: corrections of it, and how surely it lies in the light survey's frame.

A correction moves the robot by ``T_map_odom`` and what was laid since by the same; :func:`apply_correction` does both.

What the pose knew when a map was left says much of that place and little of one far away: a heading that is sure to
2 deg swings by half a metre over 15 m. But light has given the place of nearly every submap, and the pose graph has
weighed all that. So the map as a whole lies as surely as all of them together say, each carried here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from estimator.fusion.map_pose import MapPose
from estimator.mapping.keyframe import Submap, square_of
from estimator.mapping.map_state import MapState
from estimator.mapping.relative_covariance import inverse3
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3, swing

APART: Final = 4.0
"""By how much the variance of what light said is raised: its errors hang together over several submaps."""

BENT: Final = np.diag((0.1**2, 0.1**2, 0.02**2))
"""What a map may be off at one place while it lies well as a whole: what the pose graph leaves of bends."""


def apply_correction(map_: MapState, pose: MapPose, T_map_odom: Array, since: int, T_odom_base: Array) -> None:
    """Correct the map frame: move the robot to ``T_map_odom``, and with it what was laid from keyframe ``since`` on."""
    shift_map(map_, se2.compose(T_map_odom, se2.inverse(pose.T_map_odom)), since)
    pose.move(T_map_odom, T_odom_base)


def shift_map(map_: MapState, moved: Array, since: int) -> None:
    """Move the submaps that begin with keyframe ``since`` or later, 0 being the start, as one piece; and the newest."""
    parts = map_.parts
    if since in (0, parts.session_start):  # all that was laid since the start
        map_.T_map_start = se2.compose(moved, map_.T_map_start)
    for anchor in reversed(map_.light_anchors.values()):
        if anchor.first < since:
            break
        anchor.T_map_submap = se2.compose(moved, anchor.T_map_submap)
    newest, detached = map_.graph.newest, parts.detached
    for submap in map_.graph.submaps.values():
        driven = submap is newest and (detached is None or submap.key >= detached)
        if submap.first >= since or driven:
            submap.T_map_submap = se2.compose(moved, submap.T_map_submap)


def unlist(map_: MapState, since: int) -> None:
    """Take the keyframes from ``since`` on off the lists by place, and lists that are empty then."""
    kept = {place: [key for key in keys if key < since] for place, keys in map_.places.items()}
    map_.places = {place: keys for place, keys in kept.items() if keys}


def relist(map_: MapState, since: int) -> None:
    """List the keyframes from ``since`` on, 0 being all, by the places that they have come to."""
    unlist(map_, since)
    for key, frame in map_.keyframes.items():
        if key >= since:
            map_.places.setdefault(square_of(frame.T_map_keyframe), []).append(key)


def alignment_covariance(
    submaps: Iterable[Submap], T_map_base: Array, first: int | None, left: tuple[Array, Array]
) -> Array:
    """Covariance (m, m, rad; map axes) of the map in the survey's frame at a place of it.

    By light at the submaps or by what was known when the map was left, whichever is surer here.

    Args:
        submaps: of the map.
        T_map_base: the place.
        first: key of the first submap that is no part of that map, if there is one.
        left: the pose when the map was left, and its covariance in the survey's frame (3, 3) then.
    """
    off, P_left = T_map_base - left[0], left[1].copy()
    swing(float(off[0]), float(off[1]), P_left)
    lit = [one for one in submaps if one.light is not None and (first is None or one.key < first)]
    if not lit:
        return P_left
    whole = as_a_whole(lit, T_map_base) + BENT
    return P_left if np.trace(P_left) < np.trace(whole) else whole


def as_a_whole(lit: list[Submap], T_map_base: Array) -> Array:
    """Covariance by light at each of these submaps, carried to a place; wider where map and light disagree."""
    told = [one.light for one in lit if one.light is not None]
    P = APART * np.array([P for _, P in told])
    at = np.array([one.T_map_submap for one in lit])
    off = np.array([T for T, _ in told]) - at
    off[:, 2] = se2.wrap(off[:, 2])
    misfit = np.einsum("ki,kij,kj->k", off, inverse3(P), off)
    F = np.tile(np.eye(3), (len(lit), 1, 1))
    F[:, 0, 2], F[:, 1, 2] = at[:, 1] - T_map_base[1], T_map_base[0] - at[:, 0]
    L = inverse3(F @ P @ F.transpose(0, 2, 1)).sum(axis=0)
    return np.asarray(invert3(L) * max(1.0, float(misfit.mean()) / 3.0))

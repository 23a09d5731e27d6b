"""The map frame: corrections of T_map_odom together with the submaps, and the covariance of the map in the survey.

A correction moves the robot by ``T_map_odom`` and the submaps created since by the same transform;
:func:`apply_correction` does both.

The last pose of a run determines the map near it, but not far away: a heading sigma of 2 deg means half a metre over 15
m. But light has given the position of nearly every submap, and the pose graph has combined them. So the covariance of
the whole map combines them all, each propagated to the present position.
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
"""Inflation of the variance of light at a submap: its errors are correlated over several submaps."""

BENT: Final = np.diag((0.1**2, 0.1**2, 0.02**2))
"""Local deformation of a map that is aligned as a whole (m, m, rad): what the pose graph leaves."""


def apply_correction(map_: MapState, pose: MapPose, T_map_odom: Array, since: int, T_odom_base: Array) -> None:
    """Correct the map frame: move the robot to ``T_map_odom``, and the map from keyframe ``since`` on with it."""
    shift_map(map_, se2.compose(T_map_odom, se2.inverse(pose.T_map_odom)), since)
    pose.move(T_map_odom, T_odom_base)


def shift_map(map_: MapState, moved: Array, since: int) -> None:
    """Move the submaps that begin with keyframe ``since`` or later (0: the start) as one body, and the newest one."""
    parts = map_.parts
    if since in (0, parts.session_start):  # everything created since the start
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
    """Remove the keyframes from ``since`` on from the lists by position, and empty lists."""
    kept = {place: [key for key in keys if key < since] for place, keys in map_.places.items()}
    map_.places = {place: keys for place, keys in kept.items() if keys}


def relist(map_: MapState, since: int) -> None:
    """List the keyframes from ``since`` on (0: all) by their present positions."""
    unlist(map_, since)
    for key, frame in map_.keyframes.items():
        if key >= since:
            map_.places.setdefault(square_of(frame.T_map_keyframe), []).append(key)


def alignment_covariance(
    submaps: Iterable[Submap], T_map_base: Array, first: int | None, left: tuple[Array, Array]
) -> Array:
    """Covariance (m, m, rad; map axes) of the map in the survey frame at a position of it.

    It comes from light at the submaps or from the last pose of the earlier run, whichever is smaller here.

    Args:
        submaps: of the map.
        T_map_base: the position.
        first: key of the first submap that is no part of that map, if there is one.
        left: last pose of the earlier run, and its covariance in the survey frame (3, 3) then.
    """
    off, P_left = T_map_base - left[0], left[1].copy()
    swing(float(off[0]), float(off[1]), P_left)
    lit = [one for one in submaps if one.light is not None and (first is None or one.key < first)]
    if not lit:
        return P_left
    whole = as_a_whole(lit, T_map_base) + BENT
    return P_left if np.trace(P_left) < np.trace(whole) else whole


def as_a_whole(lit: list[Submap], T_map_base: Array) -> Array:
    """Combined covariance by light at these submaps, propagated to a position; wider where map and light disagree."""
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

"""Keyframes: when one is laid, what it does to the local map, and which are let go again."""

from __future__ import annotations

import math

import numpy as np

from estimator import absolute, keyframe, localmap, se2
from estimator.closing import keyframe_laid
from estimator.fusion import covariance, noise_of
from estimator.keyframe import Keyframe, Submap
from estimator.lines import lines_of
from estimator.records import Array, Scan
from estimator.result import MatchResult
from estimator.scanpoints import ScanPoints
from estimator.state import State

PATIENCE = 3
"""Scans in a row that may fail to match before the local map is begun anew from the present one."""

NOTHING = 1e-9 * np.eye(3)


def keyframe_due(state: State, points: ScanPoints, match: MatchResult) -> bool:
    """Whether the robot has left its newest keyframe, sees something else, or is lost; never from next to nothing."""
    settings = state.settings
    if len(points.xy) < settings.matching.min_points:
        return False
    if state.local is None or not match.ok:
        return state.local is None or state.failures >= PATIENCE
    x, y, yaw = se2.between(state.T_odom_anchor, state.fused.T_odom_base).tolist()
    changed = match.inliers < settings.keyframe_share * match.queries and state.since_keyframe >= PATIENCE
    return changed or math.hypot(x, y) > settings.keyframe_m or abs(yaw) > settings.keyframe_rad


def lay_keyframe(state: State, scan: Scan, points: ScanPoints) -> int:
    """Keep this scan and hang the coming poses on it; returns its ID."""
    moving, key = state.fused, state.next_key
    T = moving.T_odom_base
    frame = keyframe.keep(key, se2.compose(state.T_map_odom, T), T, scan, points.turned_rad)
    newest = state.keyframes.get(state.anchor)
    if newest is not None and np.array_equal(newest.bearing_rad, frame.bearing_rad):
        frame.bearing_rad = newest.bearing_rad
    state.P_anchor = turned_back(state, covariance(state))
    P, moving.P = moving.P, NOTHING.copy()
    if state.absolute is not None:
        state.absolute.X = np.zeros((3, 3))
        frame.virtual = absolute.virtual(state)
    keyframe_laid(state, frame, P, noise_of(state, scan))
    state.keyframes[key] = frame
    state.anchor, state.T_odom_anchor, state.next_key, state.since_keyframe = key, T, key + 1, 0
    return key


def lay_anchor(state: State) -> None:
    """Without a laser there is nothing to keep; every stretch of the way still hangs on a place that light has told."""
    tie, T = state.absolute, state.fused.T_odom_base
    x, y, yaw = se2.between(state.T_odom_anchor, T).tolist()
    settings = state.settings
    near = math.hypot(x, y) <= settings.keyframe_m and abs(yaw) <= settings.keyframe_rad
    if tie is None or not tie.placed or not absolute.blind(state) or near:
        return
    if settings.history:
        state.lone[state.next_key] = Submap(0, state.next_key, se2.compose(state.T_map_odom, T), T)
    state.anchor, state.T_odom_anchor, state.next_key = state.next_key, T, state.next_key + 1


def turned_back(state: State, P_map: Array) -> Array:
    """A covariance of the map frame in the axes of the odom frame."""
    R = se2.rotation(-state.T_map_odom[2])
    return np.asarray(R @ P_map @ R.T)


def update_map(state: State, scan: Scan, points: ScanPoints) -> None:
    """Merge the newest keyframe into the local map, or begin a new one where the old one is lost."""
    newest = state.keyframes[state.anchor]
    lost = state.local is None or state.failures >= PATIENCE
    if lost and state.absolute is not None:
        state.absolute.broken = True
    local = localmap.empty(newest.T_odom_keyframe[:2]) if lost or state.local is None else state.local
    state.local = localmap.update(local, newest, lines_of(points), state.settings.map, noise_of(state, scan))
    state.failures = 0
    retire(state, newest)


def retire(state: State, newest: Keyframe) -> None:
    """Bound what is kept per area: of the keyframes of one place and heading, the newest few stay."""
    x, y, yaw = newest.T_map_keyframe.tolist()
    place = (math.floor(2.0 * x), math.floor(2.0 * y), math.floor((yaw + math.pi) * 4.0 / math.pi) % 8)
    here = [key for key in state.places.get(place, ()) if key in state.keyframes]
    here.append(newest.key)
    while len(here) > state.settings.keep:
        gone = state.keyframes.pop(here.pop(0))
        if state.settings.history:
            state.retired[gone.key] = gone.submap, se2.between(gone.submap.T_odom_submap, gone.T_odom_keyframe)
    state.places[place] = here

"""Keyframes: when one is laid, what it does to the local map, and which are let go again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.fusion.pose_update import covariance, noise_of
from estimator.mapping import keyframe
from estimator.mapping.keyframe import Keyframe, Submap, near, square_of, squares_about
from estimator.mapping.loop_closure import keyframe_laid
from estimator.mapping.submap import SIZE
from estimator.mapping.submap_graph import OWN
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation import relocalisation, relocalisation_check, unaligned_map
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.matcher_choice import Matcher
from estimator.state import State

PATIENCE = 3
"""Scans in a row that may fail to match before the local map is begun anew from the present one."""

PATIENCE_S = 1.0
"""With wheels it goes on for at least so long: they bridge it, and who steps in front of the robot steps away again."""

NEAR = 0.4
"""Keyframes nearer together than this, in steps, are not laid: a robot that stands and trembles lays none."""

PASS = SIZE
"""So many keyframes later the robot has come by again: 3 m of way or half a turn, well beyond what is near."""

AGAIN = 8
"""Squares that are looked at anew with each keyframe."""

NOTHING = 1e-9 * np.eye(3)


def keyframe_due(state: State, points: ScanPoints, match: MatchResult) -> bool:
    """Whether the robot has left its newest keyframe, sees something else, or is lost; never from next to nothing."""
    settings = state.settings
    if len(points.xy) < settings.matching.min_points:
        return False
    if state.local is None or not match.ok:
        return lost(state)
    changed = match.inliers < settings.keyframe_share * match.queries and state.since_keyframe >= PATIENCE
    if settings.matcher is not Matcher.LINE:  # the newest keyframe is all their map, and its error is kept for good
        return changed or away(state) > 1.0
    paces = math.floor(state.way)
    due = changed or (paces != state.paces and away(state) > NEAR)
    state.paces = paces if due else state.paces
    return due


def lost(state: State) -> bool:
    """Whether there is no local map, or none of the scans that have seen something has fitted it for long enough."""
    if state.local is None:
        return True
    waited = state.fused.t_mono - state.t_match
    return state.failures >= PATIENCE and (not state.fused.odometry or waited >= PATIENCE_S)


def away(state: State) -> float:
    """How far the robot is from its newest keyframe, in keyframes: the larger one of its way and its turn."""
    x, y, yaw = se2.between(state.T_odom_anchor, state.fused.T_odom_base).tolist()
    return float(max(math.hypot(x, y) / state.settings.keyframe_m, abs(yaw) / state.settings.keyframe_rad))


def walk(state: State) -> None:
    """Count the way since the last scan, by the prediction.

    Keyframes are laid where this count passes a whole number, and not at a distance from the last one: so a hair's
    breadth in one match does not choose other scans for all keyframes to come, and with them another map.
    """
    x, y, yaw = se2.between(state.T_odom_scan, state.fused.T_odom_base).tolist()
    state.way += math.hypot(x, y) / state.settings.keyframe_m + abs(yaw) / state.settings.keyframe_rad


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
        frame.virtual = map_odom_filter.virtual(state)
    anew = lost(state)
    if anew and state.local is not None:
        relocalisation.local_map_lost(state)
    keyframe_laid(state, frame, P, noise_of(state, scan), anew)
    relocalisation.keyframe_laid(state, frame)
    relocalisation_check.keyframe_laid(state, frame)
    unaligned_map.keyframe_laid(state, frame)
    state.keyframes[key] = frame
    state.anchor, state.T_odom_anchor, state.next_key, state.since_keyframe = key, T, key + 1, 0
    return key


def lay_anchor(state: State) -> None:
    """Without a laser there is nothing to keep; every stretch of the way still hangs on a place that light has told."""
    tie, T = state.absolute, state.fused.T_odom_base
    settings = state.settings
    near = away(state) <= 1.0
    if tie is None or not tie.placed or not map_odom_filter.blind(state) or near:
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
    local = state.local
    if local is None or lost(state):
        state.anew += local is not None
        local = local_map.empty(newest.T_odom_keyframe[:2])
        if state.absolute is not None:
            state.absolute.broken = True
    state.local = local_map.update(local, newest, lines_of(points), state.settings.map, noise_of(state, scan))
    state.failures = 0
    retire(state, newest)


def retire(state: State, newest: Keyframe) -> None:
    """Bound what is kept per area: near one place, with one heading, the newest few of earlier passes stay.

    This pass's own are left alone: in a curve, or where the robot sways, they lie close together. Were all counted by
    the squares that list them, squares that a lap only touches would go on filling up for hours.
    """
    T, atlas = newest.T_map_keyframe, state.atlas
    # what is adrift, or watched, may lie elsewhere: it takes the place of nothing older
    since = max(atlas.since, atlas.kept if atlas.held else 0, 0 if atlas.watch is None else atlas.watch.since)
    here = sorted(key for key, T_key in listed(state, T, newest.key) if since <= key and near(T, T_key))
    earlier = [key for key in here if key <= newest.key - PASS]
    for key in earlier[: max(0, len(earlier) + 1 - state.settings.keep)]:
        drop(state, key)
    if atlas.held:
        own = [key for key in state.keyframes if key >= atlas.kept]
        for key in own[: -OWN * SIZE]:
            drop(state, key)


def listed(state: State, T_map: Array, newest: int) -> Iterator[tuple[int, Array]]:
    """The newest keyframe and those about its place, with theirs; who has moved along with the map is listed anew.

    So are a few of those that have not been looked at for longest: a map that turns a little moves its far end by
    metres, where else they would be missed on the next pass.
    """
    about = [newest]
    for square in (*squares_about(T_map), *islice(state.places, AGAIN)):
        about += state.places.pop(square, ())
    for key in about:
        frame = state.keyframes.get(key)
        if frame is not None:
            T_key = frame.T_map_keyframe
            state.places.setdefault(square_of(T_key), []).append(key)
            yield key, T_key


def drop(state: State, key: int) -> None:
    """Let go of a keyframe's scan."""
    gone = state.keyframes.pop(key)
    if state.settings.history:
        state.retired[key] = gone.submap, se2.between(gone.submap.T_odom_submap, gone.T_odom_keyframe)

"""Moving the map frame: the correction T_map_odom, whose jumps are counted, and what hangs on it."""

from __future__ import annotations

import math

from estimator.mapping.keyframe import square_of
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.state import State

JUMP_M, JUMP_RAD = 0.05, math.radians(1.0)


def move_map(state: State, T_map_odom: Array) -> None:
    """Correct the pose; what was laid stays where it is. The robot's own move tells whether it was a jump."""
    was = se2.compose(state.T_map_odom, state.fused.T_odom_base)
    x, y, yaw = se2.between(was, se2.compose(T_map_odom, state.fused.T_odom_base)).tolist()
    state.jumps += int(math.hypot(x, y) > JUMP_M or abs(yaw) > JUMP_RAD)
    state.T_map_odom = T_map_odom


def shift_map(state: State, moved: Array, since: int) -> None:
    """Move the submaps that begin with keyframe ``since`` or later, 0 being the start, as one piece; and the newest."""
    if since in (0, state.atlas.kept):  # all that was laid since the start
        state.T_map_start = se2.compose(moved, state.T_map_start)
    for lone in reversed(state.lone.values()):
        if lone.first < since:
            break
        lone.T_map_submap = se2.compose(moved, lone.T_map_submap)
    newest, adrift = state.atlas.newest, state.atlas.adrift
    for submap in state.atlas.submaps.values():
        driven = submap is newest and (adrift is None or submap.key >= adrift)
        if submap.first >= since or driven:
            submap.T_map_submap = se2.compose(moved, submap.T_map_submap)


def unlist(state: State, since: int) -> None:
    """Take the keyframes from ``since`` on off the lists by place, and lists that are empty then."""
    kept = {place: [key for key in keys if key < since] for place, keys in state.places.items()}
    state.places = {place: keys for place, keys in kept.items() if keys}


def rehang(state: State, since: int) -> None:
    """List the keyframes from ``since`` on, 0 being all, by the places that they have come to."""
    unlist(state, since)
    for key, frame in state.keyframes.items():
        if key >= since:
            state.places.setdefault(square_of(frame.T_map_keyframe), []).append(key)

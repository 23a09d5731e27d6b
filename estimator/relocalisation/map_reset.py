"""Forgetting the map, when it is ordered or when the map may be of two places."""

from __future__ import annotations

from estimator.mapping.keyframe_selection import NOTHING
from estimator.relocalisation.owners import Owners


def forget_map(state: Owners) -> None:
    """Drop the map; the pose now hangs on the start."""
    pose, motion, matching = state.pose, state.motion, state.matching
    matching.local_map, matching.failures = None, 0
    state.map.clear()
    state.time_offset.forget()
    state.relocalisation.forget()
    pose.P_anchor, motion.P = NOTHING.copy(), NOTHING.copy()
    pose.anchor, pose.T_odom_anchor = 0, motion.T_odom_base
    state.map.T_map_start = pose.here(motion.T_odom_base)

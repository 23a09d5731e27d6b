"""Map reset: clears the map and all state that refers to it, after a command or a kidnapping without a usable map."""

from __future__ import annotations

from estimator.mapping.keyframe_selection import NOTHING
from estimator.relocalisation.owners import Owners


def forget_map(state: Owners) -> None:
    """Clear the map; the start becomes the anchor of the pose."""
    pose, motion, matching = state.pose, state.motion, state.matching
    matching.local_map, matching.failures = None, 0
    state.map.clear()
    state.time_offset.forget()
    state.relocalisation.forget()
    pose.P_anchor, motion.P = NOTHING.copy(), NOTHING.copy()
    pose.anchor, pose.T_odom_anchor = 0, motion.T_odom_base
    state.map.T_map_start = pose.here(motion.T_odom_base)

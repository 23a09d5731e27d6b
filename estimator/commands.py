"""Operator commands: set the pose, reset the map, relocalise, or use the stored pose of the previous run."""

from __future__ import annotations

import numpy as np

from estimator.mapping.map_frame import apply_correction
from estimator.measurements import Command, Order
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation import relocalisation
from estimator.relocalisation.map_reset import forget_map
from estimator.state import State


def obey(state: State, command: Command) -> None:
    """Execute a command.

    SET_POSE moves the whole map so that the robot has that pose; RESET clears the map and starts at that pose. Only
    this pose connects a map of this session to the world, so the map moves as one body. While the robot's pose in it is
    not known, only what is detached moves. A restored map stays as it is, and the search for the robot starts about
    that pose. A non-finite pose is ignored; RESET without a pose starts at the origin. RELOCALISE searches the robot
    everywhere in the map. It restarts the local map, because the old one may be of another position. REMEMBERED passes
    the stored pose to a robot that starts in a stored map. It is accepted there without driving if the robot fits
    nowhere else. ``T_odom_base`` stays as it is.
    """
    T_map_base = command.T_map_base
    if T_map_base is not None and not np.isfinite(T_map_base).all():
        return
    if command.order is Order.REMEMBERED:
        remember(state, T_map_base)
        return
    if command.order is Order.RELOCALISE:
        if relocalisation.begin(state):
            look_at_once(state)
        return
    if command.order is Order.RESET:
        forget_map(state)
        T_map_base = se2.identity() if T_map_base is None else T_map_base
    if T_map_base is not None:
        if state.map.parts.session_start and state.map.parts.detached is None:
            relocalisation.begin(state)
        place(state, T_map_base)
        if state.map.parts.detached is not None:
            relocalisation.hinted(state)
            look_at_once(state)


def remember(state: State, T_map_base: Array | None) -> None:
    """Use the stored pose as unconfirmed pose; no effect where the pose is known, or a search has started since."""
    parts, search = state.map.parts, state.relocalisation.search
    if T_map_base is None or parts.detached is None or not parts.session_start or search.hint is not None:
        return
    place(state, T_map_base)
    search.remembered = state.pose.T_map_odom


def look_at_once(state: State) -> None:
    """Restart the local map: the next scan then becomes its first keyframe, and is searched."""
    state.matching.local_map, state.matching.failures = None, 0


def place(state: State, T_map_base: Array) -> None:
    """Move the map frame so that the robot's pose is ``T_map_base``, and the detached map with the robot."""
    T_odom_base = state.motion.T_odom_base
    T_map_odom = se2.compose(T_map_base, se2.inverse(T_odom_base))
    apply_correction(state.map, state.pose, T_map_odom, state.map.parts.detached_since, T_odom_base)

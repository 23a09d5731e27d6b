"""What a person or a PLC may order: set the pose, forget the map, or look for the place in it."""

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
    """SET_POSE moves the whole map so that the robot stands there; RESET forgets the map and begins at that pose.

    A map of this session has no other tie to the world than what it is told, so it moves as one piece; where the place
    in it is not known, only what is detached moves. A map that was restored stays as it is, and the robot is looked for
    in it about that pose. A pose that is no number is ignored; RESET without a pose begins at the origin. RELOCALISE
    looks for the robot everywhere in the map, and begins a new local map, because the old one may be that of another
    place. REMEMBERED tells a robot that has been switched on in a stored map where it was last: it is believed there
    without driving if it fits nowhere else. ``T_odom_base`` stays as it is.
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
    """Guess that the robot stands where it stood; of no use where its place is known, or was looked for anew since."""
    parts, search = state.map.parts, state.relocalisation.search
    if T_map_base is None or parts.detached is None or not parts.session_start or search.hint is not None:
        return
    place(state, T_map_base)
    search.remembered = state.pose.T_map_odom


def look_at_once(state: State) -> None:
    """Begin a new local map: its first keyframe is laid with the next scan, and looked for."""
    state.matching.local_map, state.matching.failures = None, 0


def place(state: State, T_map_base: Array) -> None:
    """Move the map frame so that the robot's pose is ``T_map_base``, and everything in the map with the robot."""
    T_odom_base = state.motion.T_odom_base
    T_map_odom = se2.compose(T_map_base, se2.inverse(T_odom_base))
    apply_correction(state.map, state.pose, T_map_odom, state.map.parts.detached_since, T_odom_base)

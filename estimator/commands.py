"""What a person or a PLC may order: set the pose, forget the map, or look for the place in it."""

from __future__ import annotations

import numpy as np

from estimator.mapping.keyframe_selection import NOTHING
from estimator.mapping.map_frame import move_map, shift_map
from estimator.measurements import Command, Order
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation import relocalisation
from estimator.relocalisation.hypothesis_tracking import Suspicion
from estimator.state import State


def obey(state: State, command: Command) -> None:
    """SET_POSE moves the whole map so that the robot stands there; RESET forgets the map and begins at that pose.

    A map of this session has no other tie to the world than what it is told, so it moves as one piece; where the place
    in it is not known, only what is adrift moves. A map that was restored stays as it is, and the robot is looked for
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
        forget(state)
        T_map_base = se2.identity() if T_map_base is None else T_map_base
    if T_map_base is not None:
        if state.atlas.kept and state.atlas.adrift is None:
            relocalisation.begin(state)
        place(state, T_map_base)
        if state.atlas.adrift is not None:
            relocalisation.hinted(state)
            look_at_once(state)


def remember(state: State, T_map_base: Array | None) -> None:
    """Guess that the robot stands where it stood; of no use where its place is known, or was looked for anew since."""
    atlas = state.atlas
    if T_map_base is None or atlas.adrift is None or not atlas.kept or atlas.seek.hint is not None:
        return
    place(state, T_map_base)
    atlas.seek.remembered = state.T_map_odom


def look_at_once(state: State) -> None:
    """Begin a new local map: its first keyframe is laid with the next scan, and looked for."""
    state.local, state.failures = None, 0


def forget(state: State) -> None:
    """Drop the map; the pose now hangs on the start."""
    state.keyframes, state.places, state.retired, state.lone, state.local = {}, {}, {}, {}, None
    state.atlas = state.atlas.renewed()
    if state.live is not None:
        state.live.clear()
    state.lag.forget()
    state.suspicion = Suspicion()  # of a map that there is no more
    state.P_anchor, state.fused.P = NOTHING.copy(), NOTHING.copy()
    state.anchor, state.T_odom_anchor, state.failures = 0, state.fused.T_odom_base, 0
    state.T_map_start = se2.compose(state.T_map_odom, state.fused.T_odom_base)


def place(state: State, T_map_base: Array) -> None:
    """Move the map frame so that the robot's pose is ``T_map_base``, and everything in the map with the robot."""
    T_map_odom = se2.compose(T_map_base, se2.inverse(state.fused.T_odom_base))
    shift_map(state, se2.compose(T_map_odom, se2.inverse(state.T_map_odom)), state.atlas.since)
    move_map(state, T_map_odom)

"""The map as a witness of the pose that light holds: what it knows better is taken from it.

Light ties the odom frame to the survey, epoch by epoch; where it is blind (across a row of lamps, where none are lit)
the tie grows vague, though the robot may drive through what it has mapped many times. There the graph knows more: by
its loops, and by what light said of all the submaps. What it says without the tie is compared with the tie, and in each
direction only what it knows *more* is added: the two have much in common, and a robot that hears the same map again
learns nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.fusion.motion_history import positive
from estimator.mapping.map_frame import move_map, shift_map
from estimator.mapping.pose_graph import Graph, Solution, optimise
from estimator.mapping.relative_covariance import UNTIED
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import hang
from estimator.numerics.symmetric3 import invert3
from estimator.result import SURPRISE
from estimator.state import State

NARROWEST = 1e-12
"""Share of the largest eigenvalue below which one of an information is taken for nothing but rounding."""

LED_M, LED_RAD = 0.15, 0.05
"""A map that has moved the robot farther may have been wrong: light that contradicts it then is believed at once."""

SETTLED_M = 0.01
"""A robot (m, rad) that has been moved by more has the graph solved about its new place."""


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """Where the map has its newest submap, were that not tied to the survey itself.

    Attributes:
        T_map_newest: (3,) as what light has said of the other submaps has it: it does not move along with them.
        P: (3, 3) covariance (m, m, rad) in the submap's axes.
    """

    T_map_newest: Array
    P: Array


def said(graph: Graph, solution: Solution, ties: Array, how: tuple[int, float, float]) -> Said | None:
    """What the graph says of its last pose without the last anchor, which is the tie; None without another anchor.

    Args:
        graph: whose last anchor is of the last pose.
        solution: of it.
        ties: (n, 3, 3) of `tied` to the last pose.
        how: most iterations, when it has settled, and phi, as `optimise` takes them.
    """
    last = len(graph.poses) - 1
    others = graph.anchored[:-1]
    if len(graph.anchored) < 2 or graph.anchored[-1] != last or not (ties[others, 0, 0] < UNTIED).any():
        return None
    alone = replace(graph, poses=solution.poses, anchored=others, at=graph.at[:-1], certainty=graph.certainty[:-1])
    freed = optimise(alone, *how, covariance_of=last)
    if not positive(freed.covariance):
        return None
    R = se2.rotation(-freed.poses[-1, 2])
    return Said(freed.poses[-1], R @ freed.covariance @ R.T)


def take(state: State, word: Said) -> None:
    """Add to the tie what the map knows more of the newest submap's place; that moves the robot and this submap alone.

    Nothing is taken while light and pose disagree, while the robot is adrift or its place is being watched: then it may
    be the map that is wrong.
    """
    atlas, tie, moving = state.atlas, state.absolute, state.fused
    newest = atlas.newest
    assert newest is not None
    assert tie is not None
    doubtful = tie.odd_since is not None or atlas.adrift is not None or atlas.watch is not None
    if doubtful or not positive(tie.P):
        return
    R = se2.rotation(newest.T_odom_submap[2])
    P_anchor, P_map = atlas.reached(R @ word.P @ R.T, state.T_odom_anchor), np.empty((3, 3))
    hang(state.T_odom_anchor, moving.T_odom_base, P_anchor, moving.P, 0.0, P_map)
    T_map_base = se2.compose(state.T_map_odom, moving.T_odom_base)
    T_map_odom = se2.compose(word.T_map_newest, se2.inverse(newest.T_odom_submap))
    off = se2.compose(T_map_odom, moving.T_odom_base) - T_map_base
    off[2] = se2.wrap(float(off[2]))
    R = se2.rotation(state.T_map_odom[2])
    off = R.T @ off
    if not (np.isfinite(P_map).all() and off @ invert3(P_map + tie.P + map_odom_filter.TOLERANCE) @ off <= SURPRISE):
        return  # light has the last word
    L_before = invert3(tie.P)
    G = surplus(invert3(P_map), L_before)
    if not G.any():
        return
    tie.P = invert3(L_before + G)
    map_odom_filter.leave(state, tie.P @ L_before)
    made = tie.P @ (G @ off)
    T_map_odom = se2.compose(T_map_base + R @ made, se2.inverse(moving.T_odom_base))
    shift_map(state, se2.compose(T_map_odom, se2.inverse(state.T_map_odom)), newest.first)
    move_map(state, T_map_odom)
    way, turn = float(np.hypot(made[0], made[1])), abs(float(made[2]))
    tie.broken |= way > LED_M or turn > LED_RAD
    atlas.stale |= max(way, turn) > SETTLED_M


def surplus(L: Array, than: Array) -> Array:
    """By how much one information (3, 3) exceeds another: the part of ``L - than`` that is positive.

    Positive as seen with ``than`` for a measure, so that it does not depend on units.
    """
    size, V = np.linalg.eigh(than)
    size = np.sqrt(np.maximum(size, NARROWEST * size[-1]))  # never singular, whatever rounding has left
    K = (V / size).T @ L @ (V / size)
    more, U = np.linalg.eigh(0.5 * (K + K.T))
    V = (V * size) @ U
    return np.asarray(V * np.maximum(more - 1.0, 0.0) @ V.T)

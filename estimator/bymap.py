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

from estimator import absolute, se2
from estimator.linear3 import invert3
from estimator.moving import hang
from estimator.posegraph import Graph, Solution, optimise
from estimator.records import Array
from estimator.result import SURPRISE
from estimator.state import State
from estimator.tied import UNTIED

NARROWEST = 1e-12
"""Share of the largest eigenvalue below which one of an information is taken for nothing but rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """Where the map has its newest submap, were that not tied to the survey itself.

    Attributes:
        T_newest_said: (3,) seen from where the graph's solution has it. P: (3, 3) covariance (m, m, rad) in the
            submap's axes.
    """

    T_newest_said: Array
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
    R = se2.rotation(-freed.poses[-1, 2])
    return Said(se2.between(solution.poses[-1], freed.poses[-1]), R @ freed.covariance @ R.T)


def take(state: State, T_map_newest: Array, P_newest: Array) -> None:
    """Add to the tie what the map knows more of the newest submap's place.

    Args:
        state: with a tie and a newest submap.
        T_map_newest: where the map has it.
        P_newest: its covariance in the submap's axes.
    """
    atlas, tie, moving = state.atlas, state.absolute, state.fused
    newest = atlas.newest
    assert newest is not None
    assert tie is not None
    R = se2.rotation(newest.T_odom_submap[2])
    P_anchor, P_map = atlas.reached(R @ P_newest @ R.T, state.T_odom_anchor), np.empty((3, 3))
    hang(state.T_odom_anchor, moving.T_odom_base, P_anchor, moving.P, 0.0, P_map)
    T_map_base = se2.compose(state.T_map_odom, moving.T_odom_base)
    off = se2.compose(se2.compose(T_map_newest, se2.inverse(newest.T_odom_submap)), moving.T_odom_base) - T_map_base
    off[2] = se2.wrap(float(off[2]))
    R = se2.rotation(state.T_map_odom[2])
    off = R.T @ off
    if not np.isfinite(P_map + tie.P).all() or off @ invert3(P_map + tie.P + absolute.TOLERANCE) @ off > SURPRISE:
        return  # light has the last word
    L_before = invert3(tie.P)
    G = surplus(invert3(P_map), L_before)
    if not G.any():
        return
    tie.P = invert3(L_before + G)
    absolute.leave(state, tie.P @ L_before)
    absolute.correct(state, T_map_base + R @ (tie.P @ (G @ off)), moving.T_odom_base)


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

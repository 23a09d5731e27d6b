"""Pose prior from the pose graph: adds the map's additional information to the alignment by light.

Light aligns the odom frame with the survey, epoch by epoch. Across collinear lamps, or without lamps, the covariance of
the alignment grows. The robot may then drive where it has mapped many times. There the graph has more information: from
its loops, and from light at all the submaps. The pose by the graph without the alignment is compared with the
alignment. In each direction only the *additional* information of the graph is added. The two are largely correlated,
and the same map seen again adds nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_history import positive
from estimator.fusion.motion_model import Motion
from estimator.mapping.map_frame import apply_correction
from estimator.mapping.map_state import MapState
from estimator.mapping.pose_graph import Graph, Solution, optimise
from estimator.mapping.relative_covariance import UNTIED
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import hang
from estimator.numerics.symmetric3 import invert3
from estimator.result import SURPRISE

NARROWEST = 1e-12
"""Share of the largest eigenvalue of an information below which another one is rounding."""

LED_M, LED_RAD = 0.15, 0.05
"""Correction by the map (m, rad) above which the map may have been wrong.

Light that then disagrees is followed at once.
"""

SETTLED_M = 0.01
"""Correction of the robot (m, rad) above which the graph is solved again about its new pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """Pose of the newest submap by the map, without its own prior by the survey.

    Attributes:
        T_map_newest: (3,) by the light at the other submaps; it does not move along with them.
        P: (3, 3) covariance (m, m, rad) in the submap's axes.
    """

    T_map_newest: Array
    P: Array


def said(graph: Graph, solution: Solution, ties: Array, how: tuple[int, float, float]) -> Said | None:
    """The graph's last pose without its last prior, the alignment; None without another prior.

    Args:
        graph: its last prior is that of the last pose.
        solution: of the graph.
        ties: (n, 3, 3) of `tied` to the last pose.
        how: most iterations, convergence threshold, and phi, as arguments of `optimise`.
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


def take(map_: MapState, pose: MapPose, motion: Motion, word: Said) -> None:
    """Add the map's additional information on the newest submap's pose to the alignment.

    That moves the robot and this submap alone.

    Nothing is added while light and pose disagree, or while a part of the map is detached or on trial: then the map may
    be wrong.
    """
    graph, alignment = map_.graph, pose.alignment
    newest = graph.newest
    assert newest is not None
    assert alignment is not None
    parts = graph.parts
    doubtful = alignment.odd_since is not None or parts.detached is not None or parts.trial is not None
    if doubtful or not positive(alignment.P):
        return
    R = se2.rotation(newest.T_odom_submap[2])
    P_anchor, P_map = graph.reached(R @ word.P @ R.T, pose.T_odom_anchor), np.empty((3, 3))
    hang(pose.T_odom_anchor, motion.T_odom_base, P_anchor, motion.P, 0.0, P_map)
    T_map_base = pose.here(motion.T_odom_base)
    T_map_odom = se2.compose(word.T_map_newest, se2.inverse(newest.T_odom_submap))
    off = se2.compose(T_map_odom, motion.T_odom_base) - T_map_base
    off[2] = se2.wrap(float(off[2]))
    R = se2.rotation(pose.T_map_odom[2])
    off = R.T @ off
    P = P_map + alignment.P + map_odom_filter.TOLERANCE
    if not (np.isfinite(P_map).all() and off @ invert3(P) @ off <= SURPRISE):
        return  # where they disagree, light counts
    L_before = invert3(alignment.P)
    G = surplus(invert3(P_map), L_before)
    if not G.any():
        return
    alignment.P = invert3(L_before + G)
    map_odom_filter.leave(pose, motion, alignment.P @ L_before)
    made = alignment.P @ (G @ off)
    T_map_odom = se2.compose(T_map_base + R @ made, se2.inverse(motion.T_odom_base))
    apply_correction(map_, pose, T_map_odom, newest.first, motion.T_odom_base)
    way, turn = float(np.hypot(made[0], made[1])), abs(float(made[2]))
    alignment.broken |= way > LED_M or turn > LED_RAD
    graph.stale |= max(way, turn) > SETTLED_M


def surplus(L: Array, than: Array) -> Array:
    """Positive part of the difference ``L - than`` of two informations (3, 3).

    Its sign is relative to ``than`` as the metric, so that it does not depend on units.
    """
    size, V = np.linalg.eigh(than)
    size = np.sqrt(np.maximum(size, NARROWEST * size[-1]))  # never singular, whatever the rounding
    K = (V / size).T @ L @ (V / size)
    more, U = np.linalg.eigh(0.5 * (K + K.T))
    V = (V * size) @ U
    return np.asarray(V * np.maximum(more - 1.0, 0.0) @ V.T)

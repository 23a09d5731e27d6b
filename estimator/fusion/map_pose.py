"""The published pose in the map: T_map_odom, its anchor keyframe, and the alignment with the lamp survey."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from estimator.fusion.heading_stability import Swing
from estimator.fusion.map_odom_history import MapOdomHistory
from estimator.light_filter.collinear_lamps import Lately
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import hang, turn
from estimator.numerics.pose_history import PoseHistory

MEMORY_S = 1.0
"""Largest delay of a light epoch, s."""

JUMP_M, JUMP_RAD = 0.05, math.radians(1.0)


@dataclass(slots=True, eq=False)
class SurveyAlignment:
    """Alignment of the odom frame with the survey frame, from light and matches.

    Attributes:
        placed: light has given the alignment.
        proved: it did so with a valid fix, or an operator gave the pose.
        broken: since then lidar tracking has had a gap or a local map restart.
        P, X: covariances of `estimator.fusion.map_odom_filter`, both 3x3, odom-aligned axes.
        kept: T_map_base, and P in map axes, at the latest match, or when light or an operator gave the alignment.
            Growth of P since then belongs to the motion, not to the map.
        gap: squared Mahalanobis distance between the pose and the light solution at the latest epoch, None: one is
            unknown.
        apart: at the latest epoch with a position they disagreed, or one was still converging to the other.
        by_map: the pose comes from a match in the map, not from light.
        odd_since: instant since which they disagree, s.
        doubted_at: latest instant at which the disagreement gave no reason to follow light, s.
        unheard: the lidar has found the pose while the light filter had another one, and they have not agreed since.
        elsewhere_since: instant since which the links do not fit the pose, s.
        aside_since: instant since which no single epoch fits it either, s.
        way: path length so far, m.
        way_young: path length at which light last began to find its position, m.
        way_start: `way_start` of the light filter when the two last agreed.
        fresh: usable share of the information from light, 0 to 1; grows with path length and time.
        since: ID of the first keyframe created after the pose was last known.
        t_match: instant of the latest match, s.
        scan_s: its distance from the previous scan, s.
        t_light: instant of the latest epoch, with or without links, s.
        light_s: its distance from the previous one, s.
        poses: T_odom_base of the last second.
        swing: heading of the odom frame by light over the last segment of the path.
        row: extra covariance of collinear lamps.
        mended: instants of the latest corrections by light, each with the remaining part (3x3, odom axes) of the error.
    """

    placed: bool = False
    proved: bool = False
    broken: bool = False
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    X: Array = field(default_factory=lambda: np.zeros((3, 3)))
    kept: tuple[Array, Array] = field(default_factory=lambda: (se2.identity(), np.zeros((3, 3))))
    gap: float | None = None
    apart: bool = False
    by_map: bool = False
    odd_since: float | None = None
    doubted_at: float = -math.inf
    elsewhere_since: float | None = None
    aside_since: float | None = None
    unheard: bool = False
    way: float = 0.0
    way_young: float = 0.0
    way_start: float = -math.inf
    fresh: float = 0.0
    since: int = 0
    t_match: float = -math.inf
    scan_s: float = 0.0
    t_light: float = -math.inf
    light_s: float = 0.0
    poses: PoseHistory = field(default_factory=lambda: PoseHistory(MEMORY_S, first=False))
    swing: Swing = field(default_factory=Swing)
    row: Lately = field(default_factory=Lately)
    mended: deque[tuple[float, Array]] = field(default_factory=deque)


@dataclass(slots=True, eq=False)
class MapPose:
    """The pose in the map, apart from the motion in the odom frame.

    Attributes:
        T_map_odom: absolute correction; changed by :meth:`move` alone.
        jumps: see `StepResult`.
        alignment: with the survey frame, None without a photodiode.
        history: earlier T_map_odom, for solution separation.
        anchor, T_odom_anchor: newest keyframe and its pose when created; 0 and the origin at the start.
        P_anchor: covariance (3, 3; odom axes) of its position in the map.
    """

    T_map_odom: Array = field(default_factory=se2.identity)
    jumps: int = 0
    alignment: SurveyAlignment | None = None
    history: MapOdomHistory = field(default_factory=MapOdomHistory)
    anchor: int = 0
    T_odom_anchor: Array = field(default_factory=se2.identity)
    P_anchor: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def move(self, T_map_odom: Array, T_odom_base: Array) -> None:
        """Set the map frame with the robot at ``T_odom_base``; counts a jump by the displacement of the robot."""
        was = se2.compose(self.T_map_odom, T_odom_base)
        x, y, yaw = se2.between(was, se2.compose(T_map_odom, T_odom_base)).tolist()
        self.jumps += int(math.hypot(x, y) > JUMP_M or abs(yaw) > JUMP_RAD)
        self.T_map_odom = T_map_odom

    def here(self, T_odom_base: Array) -> Array:
        """``T_map_base`` of the robot at ``T_odom_base``."""
        return se2.compose(self.T_map_odom, T_odom_base)

    def covariance(self, T_odom_base: Array, P_odom: Array) -> Array:
        """3x3 covariance of T_map_base: of the anchor, propagated to here, and of the pose relative to it, ``P_odom``.

        Once light has given the alignment it is that of the pose in the survey frame instead.
        """
        out, yaw = np.empty((3, 3)), float(self.T_map_odom[2])
        if self.alignment is not None and self.alignment.placed:
            turn(self.alignment.P, yaw, out)
        else:
            hang(self.T_odom_anchor, T_odom_base, self.P_anchor, P_odom, yaw, out)
        return out

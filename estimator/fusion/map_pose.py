"""The published pose in the map: T_map_odom, the anchor that the pose hangs on, and the alignment with the survey."""

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
"""How late a light epoch may come."""

JUMP_M, JUMP_RAD = 0.05, math.radians(1.0)


@dataclass(slots=True, eq=False)
class SurveyAlignment:
    """Where the odom frame lies in the light survey's frame, by light and by matches.

    Attributes:
        placed: light has told where the map lies. proved: it was sure of that, or a person said so. broken: the laser
            has let go of the pose since, or begun its map anew.
        P, X: see above, both 3x3, odom-aligned axes. kept: T_map_base, and P in map axes, at the latest match, or
            when light or a person said where the map lies; what P has grown by since is of the way, not of the map.
        gap: squared Mahalanobis distance between the pose and the lights' at the latest epoch, None: either is unknown.
        apart: at the latest epoch that told the place they did not agree, or one was on its way to the other.
        by_map: the pose comes from the map that the robot was found in, not from light.
        odd_since: since when they disagree. doubted_at: when that was last no reason to follow light. unheard: the
            laser has found the place while the `lights` filter held another one, and they have not agreed since.
        elsewhere_since: since when what is received does not fit the place. aside_since: nor each epoch alone.
        way, way_young: driven so far, and when light last began to find the place. way_start: of the `lights` filter,
            the start that has led to the place on which the two last agreed.
        fresh: how much of the lights' information may be taken, 0 to 1; grows with way and time.
        since: ID of the first keyframe laid after the pose was known for the last time.
        t_match: instant of the latest match; scan_s: what had passed since the scan before it.
        t_light: instant of the latest epoch, whatever was in it; light_s: what had passed since the one before it.
        poses: T_odom_base of the last second.
        swing: the heading of the odom frame by light over the last stretch of way. row: what a row of lamps leaves.
        mended: when light has mended the pose in the last seconds, and what part (3x3, odom axes) of its error is left.
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
        T_map_odom: absolute correction; changed by :meth:`move` alone. jumps: see `StepResult`.
        alignment: with the survey's frame, None where there is no photodiode.
        history: T_map_odom of a while ago, that light is compared with.
        anchor, T_odom_anchor, P_anchor: newest keyframe, where it was laid, and the covariance (3, 3; odom axes) of its
            place in the map; 0 and the origin at the start.
    """

    T_map_odom: Array = field(default_factory=se2.identity)
    jumps: int = 0
    alignment: SurveyAlignment | None = None
    history: MapOdomHistory = field(default_factory=MapOdomHistory)
    anchor: int = 0
    T_odom_anchor: Array = field(default_factory=se2.identity)
    P_anchor: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def move(self, T_map_odom: Array, T_odom_base: Array) -> None:
        """Correct the map frame under the robot at ``T_odom_base``; the robot's own move says whether it was a jump."""
        was = se2.compose(self.T_map_odom, T_odom_base)
        x, y, yaw = se2.between(was, se2.compose(T_map_odom, T_odom_base)).tolist()
        self.jumps += int(math.hypot(x, y) > JUMP_M or abs(yaw) > JUMP_RAD)
        self.T_map_odom = T_map_odom

    def here(self, T_odom_base: Array) -> Array:
        """``T_map_base`` of the robot at ``T_odom_base``."""
        return se2.compose(self.T_map_odom, T_odom_base)

    def covariance(self, T_odom_base: Array, P_odom: Array) -> Array:
        """3x3 covariance of T_map_base: of the anchor, carried to here, and of the pose relative to it, ``P_odom``.

        Once light has told where the map lies it is that of the place in the survey's frame instead.
        """
        out, yaw = np.empty((3, 3)), float(self.T_map_odom[2])
        if self.alignment is not None and self.alignment.placed:
            turn(self.alignment.P, yaw, out)
        else:
            hang(self.T_odom_anchor, T_odom_base, self.P_anchor, P_odom, yaw, out)
        return out

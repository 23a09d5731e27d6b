"""What `step` returns: a pose never comes without what is known about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from estimator.records import Array, Job


class Reason(Enum):
    """Why a match is, or is not, a result."""

    CONVERGED = "converged"
    ITERATION_CAP = "iteration cap reached before convergence"
    OSCILLATING = "oscillates between two sets of pairs"
    TOO_FEW_POINTS = "too few valid beams"
    TOO_FEW_PAIRS = "too few beams found a partner in the map"
    NO_MAP = "nothing to match against yet"
    REJECTED = "residual or correction implausible"


@dataclass(frozen=True, slots=True, eq=False)
class MatchResult:
    """Outcome of matching one scan against the local map.

    Attributes:
        T_odom_base: matched pose (the prediction where ``reason`` is not a result).
        information: 3x3 Fisher information of that pose, base-centred (x, y in m, yaw in rad).
        inliers, queries: pairs used and beams tried.
        iterations: used. residual_m: RMS of the inliers' point-to-line distance.
        known_axes: 3 booleans as floats (x, y, yaw) in the odom frame; 0 where this match says nothing.
        correction: (dx, dy, dyaw) by which the match moved the prediction.
    """

    T_odom_base: Array
    information: Array
    inliers: int
    queries: int
    iterations: int
    residual_m: float
    known_axes: Array
    correction: Array
    reason: Reason

    @property
    def ok(self) -> bool:
        """Whether the pose may be used."""
        return self.reason in (Reason.CONVERGED, Reason.ITERATION_CAP)


@dataclass(frozen=True, slots=True)
class Loop:
    """An accepted loop closure between two keyframes."""

    counter: int
    keyframe_new: int
    keyframe_old: int
    residual_m: float


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """The estimate after one `step`.

    Attributes:
        t_mono: the instant the pose is true for (the scan's last beam, or the last record's end).
        T_odom_base: smooth pose, never jumps. T_map_odom: absolute correction, may jump.
        covariance: 3x3 of T_map_base (m, rad).
        velocity: (v_x, v_y, yaw rate) in the base frame.
        known_axes: (x, y, yaw) 1 known, 0 unknown, in the map frame.
        match: the scan match, None in a step without a scan.
        keyframe: ID of a keyframe laid in this step, or -1. loop: accepted in this step, or None.
        anchor, T_anchor_base: keyframe this pose hangs on and the pose relative to it (0 is the start), so that a
            trajectory kept as anchors follows every later correction of the map.
        jumps: how often T_map_odom moved by more than 5 cm or 1 deg at once, since the start.
        jobs: work for the background worker; each answer comes back as a record of a later step.
    """

    t_mono: float
    T_odom_base: Array
    T_map_odom: Array
    covariance: Array
    velocity: Array
    known_axes: Array
    match: MatchResult | None
    keyframe: int
    loop: Loop | None
    anchor: int
    T_anchor_base: Array
    jumps: int
    jobs: tuple[Job, ...] = ()

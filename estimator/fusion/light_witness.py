"""Light solution at the present pose: virtual components for keyframes, availability and convergence of light."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from estimator.fusion.light_inflation import BESIDE_M, TRUST, across_the_row, doubted_covariance, without_heading
from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion
from estimator.light_filter.filter_state import SILENT_S
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import Fix, LightsResult, Virtual

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel

BLIND_S, BLIND_PERIODS, SLOWEST_S = 0.5, 1.5, 3.0
"""Time (s, or scan periods of a slow lidar) without a match, after which there is no lidar update.

SLOWEST_S limits the learned scan period, s.
"""
KNOWN = np.array((0.15**2, 0.15**2, 0.1**2))
"""Variances (m^2, m^2, rad^2) below which an axis of the pose in the survey frame is known."""
SILENT_PERIODS = 2.5
"""Epoch periods after which light without used links is timed out, where epochs come slowly; see `SILENT_S`."""


def virtual(pose: MapPose, motion: Motion, light: LightChannel | None) -> Virtual | None:
    """Light solution at the present instant, as far as the map may rely on it; None where it is not valid.

    Unknown directions get a large covariance. Otherwise collinear lamps would rotate the map back and forth. Its far
    end would move by metres between two laps. Without odometry the heading may have converged to the opposite
    direction.
    """
    alignment = pose.alignment
    if alignment is None or light is None or light.result.fix is not Fix.GOOD:
        return None
    wheels = light.has_motion
    lights = across_the_row(alignment.row.left, light.result)
    _, factor = doubted_covariance(lights, alignment.way - alignment.way_young, wheels, alignment.row.narrow(BESIDE_M))
    T_odom_base = pose_at(pose, motion, max(lights.t_mono, lights.t_pose))
    T_map_base = lights.T_map_base.copy()
    if not wheels:  # the pose's heading is more accurate; the submap's origin is found with it
        lights = without_heading(lights)
        T_map_base[2] = se2.compose(pose.T_map_odom, T_odom_base)[2]
    T_map_base = se2.compose(T_map_base, se2.between(T_odom_base, motion.T_odom_base))
    return Virtual(T_map_base, factor / TRUST * lights.covariance, lights.accepted)


def restarting(light: LightChannel, lights: LightsResult) -> bool:
    """Whether light has only begun to find its position, so that gains are not known yet.

    Gains stay known while only the heading has become uncertain, or between two lamps. An example is a robot at rest
    without odometry.
    """
    if lights.fix in (Fix.GOOD, Fix.HELD):
        return False
    known = lights.fix is Fix.STARTING and len(light.filter.tracks) == 1 and not light.filter.lost
    return not (known and lights.covariance[0, 0] + lights.covariance[1, 1] < KNOWN[0] + KNOWN[1])


def holds_heading(pose: MapPose, motion: Motion, light: LightChannel | None) -> bool:
    """Whether the lidar tracks a heading that light has confirmed, and the light filter has no odometry.

    Without odometry the light filter assumes that the robot drives forwards. At low speed its heading may converge to
    the opposite direction. The lidar does not have that ambiguity.
    """
    alignment = pose.alignment
    assert alignment is not None
    return (
        alignment.proved
        and not alignment.broken
        and not blind(pose, motion)
        and not (light is not None and light.has_motion)
    )


def blind(pose: MapPose, motion: Motion) -> bool:
    """Whether matches are overdue, though a scan was due."""
    alignment = pose.alignment
    assert alignment is not None
    return motion.t_mono - alignment.t_match > max(BLIND_S, BLIND_PERIODS * alignment.scan_s)


def light_holds(pose: MapPose, motion: Motion, light: LightChannel | None) -> bool:
    """Whether light has given the position and still has used links; lamps that went out determine nothing."""
    alignment = pose.alignment
    if alignment is None or light is None or not alignment.placed:
        return False
    return motion.t_mono - light.filter.t_used <= max(SILENT_S, SILENT_PERIODS * alignment.light_s)


def last_used(light: LightChannel | None) -> float:
    """Instant (s) of the last use of a link; -inf without a photodiode."""
    return -math.inf if light is None else light.filter.t_used


def pose_at(pose: MapPose, motion: Motion, t_mono: float) -> Array:
    """T_odom_base at an instant of the last second: at constant twist between predictions, constant beyond the ends."""
    assert pose.alignment is not None
    poses, after = pose.alignment.poses, (motion.t_mono, motion.T_odom_base)
    if poses.poses and poses.poses[-1][0] > after[0]:  # during a late scan the pose lies in the past
        after = poses.poses[-1]
    return after[1] if t_mono >= after[0] else poses.at(t_mono, after)

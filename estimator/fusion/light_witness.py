"""Light as a witness of the pose: whether it holds the place now, and what it says of it by itself."""

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
"""Without a match for so long, or so many scan periods (of a slow laser), light and odometry are all there is."""
KNOWN = np.array((0.15**2, 0.15**2, 0.1**2))
"""Variances (m^2, m^2, rad^2) below which an axis of the pose in the survey's frame counts as known."""
SILENT_PERIODS = 2.5
"""Nor does light that has been silent for so many epochs, where these come slowly; see `SILENT_S`."""


def virtual(pose: MapPose, motion: Motion, light: LightChannel | None) -> Virtual | None:
    """What light alone says of the place just now, as far as the map may rely on it; None where it says nothing good.

    What it does not know it must not say: a row of lamps would turn the map to and fro, so that its far end moved by
    metres between two laps; and without wheels the heading may have settled the wrong way round.
    """
    alignment = pose.alignment
    if alignment is None or light is None or light.result.fix is not Fix.GOOD:
        return None
    wheels = light.has_motion
    lights = across_the_row(alignment.row.left, light.result)
    _, factor = doubted_covariance(lights, alignment.way - alignment.way_young, wheels, alignment.row.narrow(BESIDE_M))
    T_odom_base = pose_at(pose, motion, max(lights.t_mono, lights.t_pose))
    T_map_base = lights.T_map_base.copy()
    if not wheels:  # the pose's heading is the better guess, by which the submap's origin is found from here
        lights = without_heading(lights)
        T_map_base[2] = se2.compose(pose.T_map_odom, T_odom_base)[2]
    T_map_base = se2.compose(T_map_base, se2.between(T_odom_base, motion.T_odom_base))
    return Virtual(T_map_base, factor / TRUST * lights.covariance, lights.accepted)


def restarting(light: LightChannel, lights: LightsResult) -> bool:
    """Whether light is only just finding its place, so that gains are not known yet.

    A heading that has become vague since, as that of a robot that stands where no wheels say so, and a stretch between
    two lamps leave the gains known.
    """
    if lights.fix in (Fix.GOOD, Fix.HELD):
        return False
    known = lights.fix is Fix.STARTING and len(light.filter.tracks) == 1 and not light.filter.lost
    return not (known and lights.covariance[0, 0] + lights.covariance[1, 1] < KNOWN[0] + KNOWN[1])


def holds_heading(pose: MapPose, motion: Motion, light: LightChannel | None) -> bool:
    """Whether the laser holds a heading that light has proved, and light has nothing as good.

    Without wheels the `lights` filter takes a robot to drive the way it faces, and its heading may settle the wrong way
    round whenever the robot is slow; the laser does not turn round.
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
    """Whether the laser has not told anything lately, though a scan was due."""
    alignment = pose.alignment
    assert alignment is not None
    return motion.t_mono - alignment.t_match > max(BLIND_S, BLIND_PERIODS * alignment.scan_s)


def light_holds(pose: MapPose, motion: Motion, light: LightChannel | None) -> bool:
    """Whether light has told the place and goes on telling; lamps that went out hold nobody where they once did."""
    alignment = pose.alignment
    if alignment is None or light is None or not alignment.placed:
        return False
    return motion.t_mono - light.filter.t_used <= max(SILENT_S, SILENT_PERIODS * alignment.light_s)


def last_used(light: LightChannel | None) -> float:
    """When a link was used for the last time; -inf without a photodiode."""
    return -math.inf if light is None else light.filter.t_used


def pose_at(pose: MapPose, motion: Motion, t_mono: float) -> Array:
    """T_odom_base at an instant of the last second, at constant twist between two predictions; the ends are held."""
    assert pose.alignment is not None
    poses, after = pose.alignment.poses, (motion.t_mono, motion.T_odom_base)
    if poses.poses and poses.poses[-1][0] > after[0]:  # at a late scan, the pose is taken back
        after = poses.poses[-1]
    return after[1] if t_mono >= after[0] else poses.at(t_mono, after)

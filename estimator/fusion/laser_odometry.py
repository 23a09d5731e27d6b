"""Lidar odometry for the light filter on robots without wheel odometry: relative motion only, never a position.

A filter of lamps alone has to estimate speed and heading; errors in them distort the meaning of each RSS. Matches give
the motion from scan to scan to a millimetre. The light filter receives that motion with the uncertainty of wheel
odometry. With a smaller one it would soon average errors that all epochs share. So the light solution stays independent
of the map and of the matched position. The motion is used only where matches determine every axis. Elsewhere, as in a
corridor, the filter estimates it again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from estimator.fusion.motion_model import Motion, too_far
from estimator.fusion.pose_update import BLIND, loose_direction
from estimator.light_filter.motion_update import CARRY_S
from estimator.measurements import Odometry
from estimator.numerics import se2
from estimator.result import MatchResult

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel

WHEELS_GONE_S: Final = 5.0
"""Time without wheel odometry, s, after which the lidar replaces it; the learned odometry scale is then discarded."""


def guide(light: LightChannel | None, motion: Motion, match: MatchResult) -> None:
    """Move the light filter by the motion since the previous scan, after ``match`` has been fused."""
    if light is None:
        return
    if motion.t_mono - motion.t_odometry < WHEELS_GONE_S:
        light.guided = None
        return
    if match.reason in BLIND:  # the next match covers the motion since
        return
    before, light.guided = light.guided, None
    if not (match.ok and match.known_axes.all() and loose_direction(match.information) is None):
        light.left_alone()
        return
    light.guided = now, T = motion.t_mono, motion.T_odom_base
    if before is None:
        return
    dt, made = now - before[0], se2.between(before[1], T)
    if dt >= CARRY_S or too_far(made, dt):  # no robot drives so fast: it was carried
        light.left_alone()
    else:
        light.move(Odometry(before[0], now, made), motion.velocity)

"""Where no wheels tell how the robot moves the laser does: `lights` then hears of its way, and never of its place.

A filter that sees lamps alone has to guess at the speed and at the direction in which the robot faces; what it takes a
strength to mean is then as wrong as the guess. Matches tell the way from scan to scan to a millimetre. They are given
to it as wheels would be, with the uncertainty of wheels: with less it would soon believe what all epochs are wrong by
alike. So it stays what it is with wheels, a witness of the place that no map and no match has told. The way is taken
where matches hold every axis; where they do not, as in a corridor, the filter guesses again.
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
"""Wheels that have been silent for longer are not waited for: what lamps said of their scale is given up."""


def guide(light: LightChannel | None, motion: Motion, match: MatchResult) -> None:
    """Move the light filter by the way since the scan before, after ``match`` has been fused."""
    if light is None:
        return
    if motion.t_mono - motion.t_odometry < WHEELS_GONE_S:
        light.guided = None
        return
    if match.reason in BLIND:  # the next one tells of the way since
        return
    before, light.guided = light.guided, None
    if not (match.ok and match.known_axes.all() and loose_direction(match.information) is None):
        light.left_alone()
        return
    light.guided = now, T = motion.t_mono, motion.T_odom_base
    if before is None:
        return
    dt, made = now - before[0], se2.between(before[1], T)
    if dt >= CARRY_S or too_far(made, dt):  # then it was carried
        light.left_alone()
    else:
        light.move(Odometry(before[0], now, made), motion.velocity)

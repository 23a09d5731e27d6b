"""Where no wheels tell how the robot moves the laser does: `lights` then hears of its way, and never of its place.

A filter that sees lamps alone has to guess at the speed and at the direction in which the robot faces; what it takes a
strength to mean is then as wrong as the guess. Matches tell the way from scan to scan to a millimetre. They are given
to it as wheels would be, with the uncertainty of wheels: with less it would soon believe what all epochs are wrong by
alike. So it stays what it is with wheels, a witness of the place that no map and no match has told. The way is taken
where matches hold every axis; where they do not, as in a corridor, the filter guesses again.
"""

from __future__ import annotations

from typing import Final

from estimator import se2
from estimator.fusion import BLIND, loose_direction
from estimator.records import Odometry
from estimator.result import MatchResult
from estimator.state import State
from estimator.suspicion import too_far

WHEELS_GONE_S: Final = 5.0
"""Wheels that have been silent for longer are not waited for: what lamps said of their scale is given up."""
STOOD_S: Final = 1.0
"""A robot that has stayed where it is for so long stands: what matches move it by is their noise."""


def guide(state: State, match: MatchResult) -> None:
    """Tell `lights` how the robot has moved since the scan before, after ``match`` has been fused."""
    light, moving = state.light, state.fused
    if light is None or match.reason in BLIND:
        return
    before, light.guided = light.guided, None
    if moving.t_mono - moving.t_odometry < WHEELS_GONE_S:
        return
    held = match.ok and bool(match.known_axes.all()) and loose_direction(match.information) is None
    made = se2.identity() if before is None else se2.between(before[1], moving.T_odom_base)
    if not held or (before is not None and too_far(made, moving.t_mono - before[0])):  # else it was carried
        light.left_alone()
        return
    stands = before is not None and moving.t_mono - moving.t_stood > STOOD_S
    light.guided = moving.t_mono, before[1] if before is not None and stands else moving.T_odom_base
    if before is not None:
        light.move(Odometry(before[0], moving.t_mono, se2.identity() if stands else made))

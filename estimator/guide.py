"""Where no wheels tell how the robot moves the laser does: `lights` then hears of its way, and never of its place.

A filter that sees lamps alone has to guess at the speed and at the direction in which the robot faces; what it takes a
strength to mean is then as wrong as the guess. Matches tell the way from scan to scan to a millimetre. They are given
to it as wheels would be, with the uncertainty of wheels: with less it would soon believe what all epochs are wrong by
alike. So it stays what it is with wheels, a witness of the place that no map and no match has told. Way and turn are
taken where a match holds every axis; where it does not, as in a corridor, the turn alone.
"""

from __future__ import annotations

import math

from estimator import se2
from estimator.fusion import loose_direction
from estimator.records import Odometry
from estimator.result import MatchResult
from estimator.state import State
from estimator.suspicion import too_far


def guide(state: State, match: MatchResult) -> None:
    """Tell `lights` how the robot has moved since the scan before, after ``match`` has been fused."""
    light, now, T = state.light, state.fused.t_mono, state.fused.T_odom_base
    if light is None:
        return
    before, light.guided = light.guided, None
    if state.fused.odometry:
        return
    turn_known = match.ok and bool(match.known_axes[2])
    if match.ok and bool(match.known_axes.all()) and loose_direction(match.information) is None:
        light.guided = now, T
        if before is not None:
            made = se2.between(before[1], T)
            if too_far(made, now - before[0]):
                turn_known = False  # it was carried
            else:
                light.move(Odometry(before[0], now, made))
    light.turn(now, float(T[2]) if turn_known else math.nan)

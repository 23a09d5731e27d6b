"""Opportunity for a kidnapping: how long nothing has shown that the robot drives on its own wheels.

A robot that is lifted is at rest on its wheels, or nothing is received from it. While wheels roll, or scans match, it
drives. The prior probability of a kidnapping is then of the order of 1e-5 per second, and no gap in the matches changes
that. So every decision against the present pose asks first whether there was an opportunity.
"""

from __future__ import annotations

from typing import Final

from estimator.relocalisation.owners import Owners

LIFT_S, MISSED = 0.5, 4.0
"""Time (s) that suffices to lift the robot and put it down, also in scan periods: a few lost scans are normal."""
ROLLS_S: Final = 0.25
"""Time (s) after the last motion of the wheels for which the robot may still roll."""


def unwatched_s(state: Owners) -> float:
    """Longest time (s) since the last match for which wheels were at rest, or no odometry arrived."""
    doubt, now = state.relocalisation.suspicion, state.motion.t_mono
    return min(now - state.matching.t_match, max(doubt.unwatched_s, now - doubt.t_still))


def since_match(state: Owners) -> bool:
    """Whether there was an opportunity since the last match."""
    usual = state.relocalisation.suspicion.period_s
    return unwatched_s(state) >= max(LIFT_S, MISSED * usual)


def unresolved(state: Owners) -> bool:
    """Whether there was an opportunity since the last match, or an earlier one that no match or search has resolved."""
    doubt = state.relocalisation.suspicion
    return since_match(state) or doubt.opportunity or (doubt.question is not None and doubt.question.opportunity)


def at_rest(state: Owners) -> bool:
    """Whether the wheels are at rest, or there is no odometry."""
    return state.motion.t_mono - state.relocalisation.suspicion.t_rest >= ROLLS_S or not state.motion.odometry

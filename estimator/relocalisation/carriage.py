"""Opportunity to carry the robot off: how long nothing has shown that it drives on its own wheels.

A robot that was lifted is at rest on its wheels, or nothing is received from it. While wheels roll, or scans match, it
drives: the prior odds of being carried off are of the order of 1e-5 per second then, and no gap in the matches changes
them. So the search for another place, and the restart of a map, ask first whether there was an opportunity.
"""

from __future__ import annotations

from estimator.relocalisation.owners import Owners

LIFT_S, MISSED = 0.5, 4.0
"""Time (s) that suffices to lift the robot and put it down, also in scan periods: a few lost scans are normal."""


def unwatched_s(state: Owners) -> float:
    """Longest time (s) since the last match for which wheels were at rest, or no odometry arrived."""
    doubt, now = state.relocalisation.suspicion, state.motion.t_mono
    return min(now - state.matching.t_match, max(doubt.unwatched_s, now - doubt.t_still))


def open_question(state: Owners) -> bool:
    """Whether the robot may have been carried off since the last match, or before matches that have not refuted it."""
    doubt = state.relocalisation.suspicion
    return possible(state) or doubt.alone or (doubt.question is not None and doubt.question.alone)


def possible(state: Owners) -> bool:
    """Whether the robot may have been carried off since the last match."""
    usual = state.relocalisation.suspicion.period_s
    return unwatched_s(state) >= max(LIFT_S, MISSED * usual)

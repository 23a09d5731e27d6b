"""Opportunity for a kidnapping, and evidence of one: what odometry and scans show since the last match.

A robot that is lifted is at rest on its wheels, or nothing is received from it. While wheels roll, or scans match, it
drives. The prior probability of a kidnapping is then of the order of 1e-5 per second, and scans that do not match do
not change that: people and glass hide the map. Only scans that see through the map do. No object explains those.
"""

from __future__ import annotations

from typing import Final

from estimator.relocalisation.global_scan_match import POSSIBLE
from estimator.relocalisation.owners import Owners

LIFT_S, MISSED = 0.5, 4.0
"""Time (s) that suffices to lift the robot and put it down, also in scan periods: a few lost scans are normal."""
MOST: Final = 0.5
"""Share of the map in view that is seen through, above which the place or the lidar is wrong: not the surroundings."""
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


def contradicted(state: Owners) -> bool:
    """Whether the scans since the last match see through more of the map than a right pose permits."""
    return state.relocalisation.suspicion.contradiction.mean > POSSIBLE


def mostly_excluded(state: Owners) -> bool:
    """Whether the scans since the last match see through most of the map in view."""
    return state.relocalisation.suspicion.contradiction.mean > MOST


def blocked(state: Owners) -> bool:
    """Whether objects before the map explain the scans since the last match, of a robot whose wheels are at rest."""
    usable = state.relocalisation.suspicion.contradiction.count > 0
    return state.motion.odometry and at_rest(state) and usable and not contradicted(state)


def unresolved(state: Owners) -> bool:
    """Whether the robot may have been kidnapped: now, or earlier and no match or search has resolved that.

    Without odometry nothing but matches shows that it drives.
    """
    doubt = state.relocalisation.suspicion
    earlier = doubt.opportunity or (doubt.question is not None and doubt.question.opportunity)
    unseen = since_match(state) and not state.relocalisation.suspicion.contradiction.count
    return not state.motion.odometry or earlier or unseen or mostly_excluded(state)


def at_rest(state: Owners) -> bool:
    """Whether the wheels are at rest, or there is no odometry."""
    return state.motion.t_mono - state.relocalisation.suspicion.t_rest >= ROLLS_S or not state.motion.odometry

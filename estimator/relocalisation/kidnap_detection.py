"""Kidnap detection: signs that the robot was lifted and carried although scans match, and the deciding map search.

The lidar tracks the robot from scan to scan, and in repeating surroundings it tracks the wrong pose. Kidnapping is
possible where something other than driving has happened:

* A match moves the pose farther than any driving can in that time.
* The robot was at rest without data (no match, and no wheel turned), or no scan matched for a while. What it sees
  afterwards differs from before.
* The scene changes from one scan to the next (`scene_change`).
* The wheels are at rest, and for a while scans see through much of the map around (`was_strange`).

One search of the whole map then decides. If another pose fits nearly as well, relocalisation starts. It does not where
the map confirms the pose, and neither a jump, a surprising match nor a changed scene shows a motion. After a scene
change it also starts if the pose itself is excluded and another one fits. After a jump it also starts where the pose is
not confirmed, there or in the local map. All other causes may be a door, a table that was carried away, or a person who
has left. Until the result arrives no keyframe is created. While light gives the pose, light decides instead, see
`relocalisation.doubt`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np

from estimator.fusion import light_witness
from estimator.fusion.light_witness import light_holds
from estimator.fusion.motion_model import too_far
from estimator.fusion.pose_update import BLIND, noise_of
from estimator.job_queue import SEARCH, job_function
from estimator.mapping import keyframe
from estimator.measurements import Odometry, Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation import global_scan_match, kidnap_opportunity, relocalisation
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, Verdict
from estimator.relocalisation.hypothesis_tracking import BEHIND, Contradiction, Question
from estimator.relocalisation.kidnap_opportunity import ROLLS_S
from estimator.relocalisation.map_reset import forget_map
from estimator.relocalisation.owners import Owners
from estimator.relocalisation.scene_change import glance
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints, unturned

SURPRISE: Final = 25.0
"""Squared Mahalanobis distance of a correction that no driving explains; as in `scan_matcher.demand_on`."""
ROW: Final = 3
"""Consecutive scans that do not match; also the scans that match again before the search.

The first that matches may be from two positions, or blurred.
"""
CHANGED: Final = 0.1
"""Decrease of the inlier share that means another view."""
LEARNING: Final = 0.1
"""Share of the latest match in the usual values: the time between two, and the inlier share."""
STILL_M, STILL_RAD = 0.005, 0.005
"""Largest motion of the wheels (m, rad) at rest, over any number of readings: 0.01 m/s for `LIFT_S`."""
RESTED_S: Final = 0.5
"""Time (s) after the last motion of the wheels until which the usual value is measured, from `ROLLS_S` on.

It is also the time without odometry after which rest is unknown.
"""
GONE_M, GONE_RAD = 0.05, 0.05
"""Motion of the wheels (m, rad) that invalidates the value measured when they stopped.

A robot that is shaken while it is lifted, or drifts, moves them by less.
"""
STRANGE, STRANGE_S, FORGET_S = 0.1, 0.5, 1.0
"""Excess of the share seen through over its value when the wheels stopped, and its total duration (s).

It appears while the robot is carried along a corridor (up to 0.22 in that of
`tests/estimator/relocalisation/test_contradicting_scans.py`). People do not cause it, however many come and go: they
hide walls, and no beam passes through walls for them. FORGET_S: time (s) without it after which it is over.
"""
LASTING_S: Final = 3.0
"""Duration (s) after which it counts although it continues: the robot may now be where the surroundings differ."""
NODES: Final = 1_000_000
"""Most nodes of the first search: a quarter of that of relocalisation, whose queue takes 100 MB.

Kidnapped robots needed 60 to 310 thousand. A search that ends at the cap decides nothing, and is repeated with the full
number. If that is not enough either, the pose is not known to be unique.
"""
PATIENCE_S, GIVEN_UP_S = 2.0, 10.0
"""Time (s) without keyframes while the search runs; then the map continues in a submap of its own.

That submap is removed after a bad result. A result that has not arrived by GIVEN_UP_S is lost: the search is repeated.
"""


def on_odometry(state: Owners, record: Odometry) -> None:
    """Update whether the wheels are at rest; without readings they are not known to turn."""
    doubt = state.relocalisation.suspicion
    moved = doubt.moved + record.delta
    if not all(map(math.isfinite, moved.tolist())):
        return
    doubt.moved = moved
    if turned(moved):
        doubt.unwatched_s = max(doubt.unwatched_s, record.t_begin - doubt.t_still)
        doubt.t_still, doubt.moved = max(doubt.t_still, record.t_end), np.zeros(3)
    doubt.rested, doubt.gone = doubt.rested + record.delta, doubt.gone + record.delta
    if turned(doubt.rested) or not doubt.t_rest <= record.t_end:
        doubt.t_rest, doubt.rested = record.t_end, np.zeros(3)
    if turned(doubt.gone, GONE_M, GONE_RAD):
        doubt.gone, doubt.through = np.zeros(3), -1.0


def turned(moved: Array, most_m: float = STILL_M, most_rad: float = STILL_RAD) -> bool:
    """Whether a motion (x, y, yaw) of the wheels exceeds that at rest."""
    x, y, yaw = moved.tolist()
    return math.hypot(x, y) > most_m or abs(yaw) > most_rad


def waits(state: Owners) -> bool:
    """Whether no keyframe may be created now, because the robot may be elsewhere."""
    doubt = state.relocalisation.suspicion
    looking = doubt.question is not None and state.motion.t_mono - doubt.t_asked < PATIENCE_S
    return looking or doubt.fitted > 0


def raised(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> bool:
    """Whether the search has to start now; called before the match is fused."""
    doubt, graph = state.relocalisation.suspicion, state.map.graph
    strange = was_strange(state, scan, points, match)
    if not match.ok:
        doubt.contradiction.add(excluded_share(state, scan, points, match))
    if not match.ok or state.matching.local_map is None:
        return False
    alone, leapt = unwatched(state), leaps(state, scan, points, match, strange)
    detached = graph.parts.detached is not None
    if light_holds(state.pose, state.motion, state.light) or detached or state.map.settings.loops is None:
        doubt.end()
        graph.cut_at = 0
        return False
    share, odd = match.inliers / max(1, match.queries), surprising(state, match)
    dt = state.motion.t_mono - state.matching.t_match
    made = se2.between(state.matching.T_odom_match, match.T_odom_base)  # wrong odometry moves the prediction alone
    jump = odd and all(too_far(T, dt) for T in (match.correction, made))
    doubt.jumped |= jump
    doubt.leapt |= leapt
    doubt.opportunity |= alone or jump or (leapt and kidnap_opportunity.at_rest(state))
    if doubt.fitted or alone or jump or leapt:
        doubt.odd |= odd
        doubt.fitted = max(doubt.fitted + 1, ROW if leapt else 0)
    else:
        doubt.share += LEARNING * (share - doubt.share) if doubt.share else share
    open_ = doubt.since > 0 and doubt.question is None  # a search has ended without a result
    if doubt.fitted >= ROW and not (doubt.odd or doubt.leapt or open_) and share > doubt.share - CHANGED:
        doubt.fitted, doubt.opportunity = 0, False  # the same view from the same position
    if doubt.question is not None and state.motion.t_mono - doubt.t_asked > GIVEN_UP_S:
        give_up(state, doubt.question)
    return doubt.fitted >= ROW and doubt.question is None


def was_strange(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> bool:
    """Whether the scan has seen through much of the map for a while, with the wheels at rest; returned once.

    That occurs when the robot is carried by hand to a similar position: from one scan to the next little changes.
    Errors of the map there were already seen through when the wheels stopped.
    """
    doubt, now = state.relocalisation.suspicion, state.motion.t_mono
    rests_s, silent = now - doubt.t_rest, now - state.motion.t_odometry >= RESTED_S
    share = looked_through(state, scan, points, match) if rests_s >= ROLLS_S and not silent else -1.0
    if share >= 0.0 and (doubt.through < 0.0 or rests_s < RESTED_S):
        doubt.through = share if doubt.through < 0.0 else min(doubt.through, share)
    if share > doubt.through + STRANGE:
        doubt.strange_s += min(max(0.0, now - state.matching.t_scan), doubt.period_s, STRANGE_S / ROW)
        doubt.t_strange = now
        if doubt.strange_s < LASTING_S or not match.ok:
            return False
        doubt.through = share
    enough = doubt.strange_s >= STRANGE_S
    if enough and not match.ok:
        return False
    if enough or silent or now - doubt.t_strange > FORGET_S:
        doubt.strange_s = 0.0
    return enough


def looked_through(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> float:
    """Share of the local map in view that a scan sees through from its pose; negative without usable data."""
    if state.matching.local_map is None or match.reason in BLIND:
        return -1.0
    eye = se2.compose(match.T_odom_base, scan.T_base_lidar)
    beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
    return local_map.looked_through(state.matching.local_map, eye, beams, noise_of(state.matching, scan))


def excluded_share(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> float:
    """Share of the local map that a scan sees through at the predicted pose; negative if the prediction is too vague.

    The test has a margin for range noise. Two sigmas of the prediction, at the median range, must lie within it.
    """
    if not len(points.xy):
        return -1.0
    P, far = state.motion.P, float(np.median(np.hypot(*points.xy.T)))
    sigma_m = math.sqrt(P[0, 0] + P[1, 1] + far * far * P[2, 2])
    if 2.0 * sigma_m > local_map.MARGIN + 5.0 * noise_of(state.matching, scan):
        return -1.0
    return looked_through(state, scan, points, match)


def leaps(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult, strange: bool) -> bool:
    """Whether the scene has changed, or was `strange`: now, or while light gave the pose and not since.

    Where the robot is put down there may be no lamp. The missing light is detected a little later.
    """
    doubt = state.relocalisation.suspicion
    eye = se2.compose(match.T_odom_base, scan.T_base_lidar)
    beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
    doubt.leap.take(glance(scan.t_end, eye, beams), noise_of(state.matching, scan), doubt.period_s)
    if doubt.leap.seen or strange:
        doubt.t_leap = scan.t_end
    if light_holds(state.pose, state.motion, state.light) or not doubt.t_leap > light_witness.last_used(state.light):
        return False
    doubt.t_leap = -math.inf
    return True


def give_up(state: Owners, question: Question) -> None:
    """Abandon a search, which has to be repeated."""
    doubt = state.relocalisation.suspicion
    state.map.graph.jobs.cancel(question)
    doubt.question, doubt.fitted, doubt.odd = None, max(doubt.fitted, ROW), doubt.odd or question.odd
    doubt.jumped, doubt.again = doubt.jumped or question.jumped, question.again
    doubt.leapt |= question.leapt
    doubt.opportunity |= question.opportunity


def unwatched(state: Owners) -> bool:
    """Whether the robot was at rest, or without data, for long without a match; another one has arrived now."""
    doubt, now = state.relocalisation.suspicion, state.motion.t_mono
    usual, since, alone = doubt.period_s, now - state.matching.t_match, kidnap_opportunity.since_match(state)
    doubt.t_still, doubt.moved, doubt.unwatched_s = now, np.zeros(3), 0.0
    doubt.contradiction = Contradiction()
    if math.isfinite(since):
        doubt.period_s = (1.0 - LEARNING) * usual + LEARNING * min(since, 2.0 * usual) if usual else since
    return usual > 0.0 and alone


def surprising(state: Owners, match: MatchResult) -> bool:
    """Whether a match has moved the pose farther than the prediction allows."""
    off = match.correction
    return float(off @ invert3(state.motion.P) @ off) > SURPRISE


def look(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> None:
    """Queue a search of the whole map for the pose, after the match is fused."""
    graph, told, doubt = state.map.graph, state.map.settings.loops, state.relocalisation.suspicion
    assert told is not None
    assert state.matching.local_map is not None
    T = state.motion.T_odom_base
    frame = keyframe.keep(state.map.next_key, state.pose.here(T), T, scan, points.turned_rad)
    noise_m = noise_of(state.matching, scan)
    against = local_map.contradicted(state.matching.local_map, frame.T_odom_lidar, frame.beams(), noise_m)
    share = match.inliers / max(1, match.queries)
    holds = global_scan_match.judged(match, share, against, told) is Verdict.HOLDS
    asked = Question(doubt.jumped, holds, doubt.again, doubt.leapt, doubt.opportunity, share, doubt.odd)
    doubt.settle()
    doubt.since = doubt.since or state.map.next_key
    older = [one for one in graph.settled() if one.first < doubt.since]
    pieces = tuple(Piece(one.key, one.T_map_submap, one.settled) for one in older if one.settled is not None)
    if pieces:
        nodes = global_scan_match.NODES if asked.again else NODES
        query = Query(frame, pieces, state.relocalisation.search.terrain, (frame.T_map_keyframe,), (), nodes=nodes)
        run, then = partial(global_scan_match.look, query, told), partial(answered, state, asked)
        graph.jobs.ask(SEARCH, run, then, owner=asked)
        doubt.question, doubt.t_asked, graph.cut_at = asked, state.motion.t_mono, doubt.since
    elif asked.jumped:  # no finished submap can be searched yet
        carried_off(state)
    else:
        doubt.since = 0


@job_function
def answered(state: Owners, asked: Question, payload: object) -> None:
    """Start relocalisation if the pose is not unique, or is not confirmed after a jump.

    A search that was not complete is repeated.

    A late result counts as well: keyframes created meanwhile belong to the same pose.
    """
    assert isinstance(payload, Looked)
    doubt = state.relocalisation.suspicion
    if doubt.question is not asked:
        return  # light gives the pose, relocalisation runs, or the map has restarted since
    doubt.question = None
    if elsewhere(asked, payload):
        carried_off(state, dead_reckoning=state.motion.odometry and not asked.moved())
    elif payload.complete or not asked.opportunity or confirmed(asked, payload):
        doubt.since = state.map.graph.cut_at = 0
    elif asked.again:  # a search that was cut off is no evidence: the pose is neither given up nor confirmed
        carried_off(state, dead_reckoning=state.motion.odometry)
    else:
        doubt.fitted, doubt.again, doubt.opportunity = ROW, True, True
        doubt.leapt, doubt.odd = doubt.leapt or asked.leapt, doubt.odd or asked.odd


def elsewhere(asked: Question, looked: Looked) -> bool:
    """Whether the search shows that the robot may be at another place.

    After an opportunity for a kidnapping, any place counts that fits nearly as well as the own one. The own place does
    not suffice either if the pose jumped there and nothing confirms it. Without an opportunity the prior is so small
    that all of this is required: the map excludes the own place, the local map does not confirm it, and another place
    fits as a loop does.
    """
    here = looked.guesses[0]
    excluded = here.verdict is Verdict.NO
    if not asked.opportunity:
        return excluded and not asked.holds and any(fit.verdict is Verdict.HOLDS for fit, _ in looked.fresh)
    if confirmed(asked, looked):
        return False
    own = here.share if excluded else max(here.share, asked.share)
    least = 0.0 if asked.leapt and excluded else max(global_scan_match.LEAST, own - BEHIND)
    rivals = any(fit.share >= least for fit, _ in looked.fresh)
    return rivals or (asked.jumped and not asked.holds and here.verdict is not Verdict.HOLDS)


def confirmed(asked: Question, looked: Looked) -> bool:
    """Whether the map confirms the pose, and nothing shows a motion.

    Another place that fits too is then no evidence against the prior, and no further search can show more.
    """
    return looked.guesses[0].verdict is Verdict.HOLDS and not asked.moved()


def carried_off(state: Owners, dead_reckoning: bool = False) -> None:
    """Start relocalisation in the whole map; a map of one scan, which cannot be searched, is cleared.

    ``dead_reckoning``: see `relocalisation.begin`.
    """
    graph, since = state.map.graph, state.relocalisation.suspicion.since
    first = next((one.key for one in graph.submaps.values() if one.first >= since > 0), None)
    if first is not None:
        relocalisation.disown(state, first, since)
    if not relocalisation.afresh(state, dead_reckoning) and graph.parts.detached is None:
        forget_map(state)
        state.matching.restarts += 1

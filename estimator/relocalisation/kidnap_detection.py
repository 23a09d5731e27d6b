"""Whether the robot may have been carried off though scans fit again: then its place has to stand a search of the map.

The laser follows the robot from scan to scan, and where the surroundings repeat it follows it into the wrong place. It
is suspected where physics says that something else than driving has happened:

* a match moves the pose farther than any driving can have in that time;
* the robot stood unwatched (no scan told anything, and no wheel turned), or nothing fitted for a while, and what is
  seen afterwards is not what was seen before;
* what is seen changes from one scan to the next, all at once (`scene_change`);
* the wheels stand, and for a while much of the map is looked through that should be in view (`was_strange`).

One look in the whole map then decides: if another place fits nearly as well the robot is being relocalised, and after a
leap also if its own is ruled out and another fits. So it is after a jump where the place does not hold, there or in the
local map; all else may have been a door, a table that was carried away, or somebody who sat and left. Until the answer
has come nothing is laid into the map. While light tells the place light is the witness, see `relocalisation.doubt`.
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
from estimator.job_queue import SEARCH
from estimator.mapping import keyframe
from estimator.measurements import Odometry, Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation import global_scan_match, relocalisation
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, Verdict
from estimator.relocalisation.hypothesis_tracking import BEHIND, Question
from estimator.relocalisation.map_reset import forget_map
from estimator.relocalisation.owners import Owners
from estimator.relocalisation.scene_change import glance
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints, unturned

SURPRISE: Final = 25.0
"""Squared Mahalanobis distance of a correction that no driving explains; as that of `scan_matcher.demand_on`."""
ROW: Final = 3
"""Scans in a row that do not fit, and then do; so many more, before the place is looked for: the first that fits may be
of two places, or blurred."""
UNWATCHED_S, MISSED = 0.5, 4.0
"""Long enough to be lifted and put down, also counted in scans: a few that are lost are no news."""
CHANGED: Final = 0.1
"""Share of the beams by which what is seen fits worse than before, where it is not the same."""
LEARNING: Final = 0.1
"""Share of the latest match in what is usual: the time between two, and how many beams fit."""
STILL_M, STILL_RAD = 0.005, 0.005
"""Wheels stand that have turned by no more since they stopped, however often they tell it: 0.01 m/s for
`UNWATCHED_S`."""
ROLLS_S, RESTED_S = 0.25, 0.5
"""So long after the wheels have last turned what is seen may be of a robot that still rolls; from then until the second
it is seen what is usual here. So long after they have last told anything it is not known, either, that they stand."""
GONE_M, GONE_RAD = 0.05, 0.05
"""What was seen when the wheels stopped is of another place once they have turned by more: one that is jostled as the
robot is lifted, or that drifts, turns by less."""
STRANGE, STRANGE_S, FORGET_S = 0.1, 0.5, 1.0
"""By so much more of what should be in view than when the wheels stopped is looked through, in all for so long, while
the robot is carried along a corridor (up to 0.22 in that of
`tests/estimator/relocalisation/test_contradicting_scans.py`). People do not show in it, however many step up and leave:
they hide walls, and nobody looks through walls for them. The third: after so long
without any it is over."""
LASTING_S: Final = 3.0
"""After so long it is told though it goes on: the robot may have been put down where not all is alike."""
NODES: Final = 1_000_000
"""A quarter of what a robot that is lost may search, whose queue takes 100 MB. Those that were carried off needed 60 to
310 thousand. One that ends there decides nothing, and is made once more with all of that; where that is not enough
either nobody can say that the place is the only one."""
PATIENCE_S, GIVEN_UP_S = 2.0, 10.0
"""So long nothing is laid until the answer comes; then the map must go on, in a submap of its own, which goes if the
answer is bad. One that has not come by the latter never will: it is asked anew."""


def on_odometry(state: Owners, record: Odometry) -> None:
    """Take in whether the wheels stand; as long as they tell nothing, they are not known to turn."""
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
    """Whether wheels that have moved the robot by so much (x, y, yaw) do not stand."""
    x, y, yaw = moved.tolist()
    return math.hypot(x, y) > most_m or abs(yaw) > most_rad


def waits(state: Owners) -> bool:
    """Whether nothing may be laid into the map now, because the robot may be elsewhere."""
    doubt = state.relocalisation.suspicion
    looking = doubt.question is not None and state.motion.t_mono - doubt.t_asked < PATIENCE_S
    return looking or doubt.fitted > 0


def raised(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> bool:
    """Whether the place is to be looked for now; to be asked before the match is fused."""
    doubt, graph = state.relocalisation.suspicion, state.map.graph
    strange = was_strange(state, scan, points, match)
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
    made = se2.between(state.matching.T_odom_scan, match.T_odom_base)  # wrong wheels move the prediction alone
    jump = odd and all(too_far(T, dt) for T in (match.correction, made))
    doubt.jumped |= jump
    doubt.leapt |= leapt
    if doubt.fitted or alone or jump or state.matching.failures >= ROW or leapt:
        doubt.odd |= odd
        doubt.fitted = max(doubt.fitted + 1, ROW if leapt else 0)
    else:
        doubt.share += LEARNING * (share - doubt.share) if doubt.share else share
    if doubt.fitted >= ROW and not (doubt.odd or doubt.leapt) and share > doubt.share - CHANGED:
        doubt.fitted = 0  # the same picture from the same place
    if doubt.question is not None and state.motion.t_mono - doubt.t_asked > GIVEN_UP_S:
        give_up(state, doubt.question)
    return doubt.fitted >= ROW and doubt.question is None


def was_strange(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> bool:
    """Whether for a while much of the map was looked through, the wheels standing, and is not now, or still is.

    So it is where the robot was carried on by hand to where it looks alike: from one scan to the next little changes.
    What the map has wrong there was looked through already when the wheels stopped. Told once.
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
    """Share of the local map in view that a scan looks through from where it was taken; negative: it shows nothing."""
    if state.matching.local_map is None or match.reason in BLIND:
        return -1.0
    eye = se2.compose(match.T_odom_base, scan.T_base_lidar)
    beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
    return local_map.looked_through(state.matching.local_map, eye, beams, noise_of(state.matching, scan))


def leaps(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult, strange: bool) -> bool:
    """Whether what is seen has changed all at once, or was `strange`: now, or while light told the place and not since.

    Where the robot is put down there may be no lamp, and for a moment nobody knows that it has been one.
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
    """Wait for an answer no longer; what was asked has to be asked again."""
    doubt = state.relocalisation.suspicion
    state.map.graph.jobs.cancel(question)
    doubt.question, doubt.fitted, doubt.odd = None, max(doubt.fitted, ROW), True
    doubt.jumped, doubt.again = doubt.jumped or question.jumped, question.again
    doubt.leapt |= question.leapt


def unwatched(state: Owners) -> bool:
    """Whether the robot has stood, or nobody knows, for long without a match; another one has come now."""
    doubt, now = state.relocalisation.suspicion, state.motion.t_mono
    usual, since = doubt.period_s, now - state.matching.t_match
    alone_s = min(since, max(doubt.unwatched_s, now - doubt.t_still))
    doubt.t_still, doubt.moved, doubt.unwatched_s = now, np.zeros(3), 0.0
    if math.isfinite(since):
        doubt.period_s = (1.0 - LEARNING) * usual + LEARNING * min(since, 2.0 * usual) if usual else since
    return usual > 0.0 and alone_s >= max(UNWATCHED_S, MISSED * usual)


def surprising(state: Owners, match: MatchResult) -> bool:
    """Whether a match has moved the pose farther than the prediction allows."""
    off = match.correction
    return float(off @ invert3(state.motion.P) @ off) > SURPRISE


def look(state: Owners, scan: Scan, points: ScanPoints, match: MatchResult) -> None:
    """Ask whether the place, after the match is fused, stands a search of the whole map."""
    graph, told, doubt = state.map.graph, state.map.settings.loops, state.relocalisation.suspicion
    assert told is not None
    assert state.matching.local_map is not None
    T = state.motion.T_odom_base
    frame = keyframe.keep(state.map.next_key, state.pose.here(T), T, scan, points.turned_rad)
    noise_m = noise_of(state.matching, scan)
    against = local_map.contradicted(state.matching.local_map, frame.T_odom_lidar, frame.beams(), noise_m)
    share = match.inliers / max(1, match.queries)
    holds = global_scan_match.judged(match, share, against, told) is Verdict.HOLDS
    asked = Question(doubt.jumped, holds, doubt.again, doubt.leapt)
    doubt.fitted, doubt.jumped, doubt.odd, doubt.again, doubt.leapt = 0, False, False, False, False
    doubt.since = doubt.since or state.map.next_key
    older = [one for one in graph.settled() if one.first < doubt.since]
    pieces = tuple(Piece(one.key, one.T_map_submap, one.settled) for one in older if one.settled is not None)
    if pieces:
        nodes = global_scan_match.NODES if asked.again else NODES
        query = Query(frame, pieces, state.relocalisation.search.terrain, (frame.T_map_keyframe,), (), nodes=nodes)
        run, then = partial(global_scan_match.look, query, told), partial(answered, state, asked)
        graph.jobs.ask(SEARCH, run, then, owner=asked)
        doubt.question, doubt.t_asked, graph.cut_at = asked, state.motion.t_mono, doubt.since
    elif asked.jumped:  # nothing of the map is finished yet that could be searched
        carried_off(state)
    else:
        doubt.since = 0


def answered(state: Owners, asked: Question, payload: object) -> None:
    """Search the whole map if the place is not the only one, or does not hold after a jump.

    A search that was not complete is repeated.

    An answer that comes late counts as well: what was laid meanwhile is of the place that it is about.
    """
    assert isinstance(payload, Looked)
    doubt = state.relocalisation.suspicion
    if doubt.question is not asked:
        return  # light tells the place, the robot is being relocalised, or the map has been begun anew since
    doubt.question = None
    here = payload.guesses[0]
    least = max(global_scan_match.LEAST, here.share - BEHIND)
    if asked.leapt:  # any place will do that is not ruled out, if its own is; and in a corridor nothing holds a match
        least = 0.0 if here.verdict is Verdict.NO else here.share - BEHIND
    alone = all(fit.share < least for fit, _ in payload.fresh)
    holds = asked.holds or not asked.jumped or here.verdict is Verdict.HOLDS
    if not (alone and holds):
        carried_off(state)
    elif payload.complete:
        doubt.since = state.map.graph.cut_at = 0
    elif asked.jumped or asked.again:
        carried_off(state)
    else:
        doubt.fitted, doubt.odd, doubt.again, doubt.leapt = ROW, True, True, doubt.leapt or asked.leapt


def carried_off(state: Owners) -> None:
    """Search the whole map; a map of one scan, in which nobody can be looked for, is forgotten."""
    graph, since = state.map.graph, state.relocalisation.suspicion.since
    first = next((one.key for one in graph.submaps.values() if one.first >= since > 0), None)
    if first is not None:
        relocalisation.disown(state, first, since)
    if not relocalisation.afresh(state) and graph.parts.detached is None:
        forget_map(state)
        state.matching.restarts += 1

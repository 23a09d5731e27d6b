"""Whether the robot may have been carried off though scans fit again: then its place has to stand a search of the map.

The laser follows the robot from scan to scan, and where the surroundings repeat it follows it into the wrong place. It
is suspected where physics says that something else than driving has happened:

* a match moves the pose farther than any driving can have in that time;
* the robot stood unwatched (no scan told anything, and no wheel turned), or nothing fitted for a while, and what is
  seen afterwards is not what was seen before;
* what is seen changes from one scan to the next, all at once (`leap`);
* the wheels stand, and for a while much of the map is looked through that should be in view (`was_strange`).

One look in the whole map then decides: if another place fits nearly as well the robot is adrift, and after a leap also
if its own is ruled out and another fits. So it is after a jump where the place does not hold, there or in the local
map; all else may have been a door, a table that was carried away, or somebody who sat and left.
Until the answer has come nothing is laid into the map. While light tells the place light is the witness, see
`adrift.doubt`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np

from estimator.commands import forget
from estimator.fusion import map_odom_filter
from estimator.fusion.motion_model import too_far
from estimator.fusion.pose_update import BLIND, noise_of
from estimator.mapping import keyframe
from estimator.mapping.submap_graph import LOOK
from estimator.measurements import Odometry, Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation import global_scan_match, relocalisation
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, Verdict
from estimator.relocalisation.hypothesis_tracking import BEHIND, Question
from estimator.relocalisation.scene_change import glance
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints, unturned
from estimator.state import State

SURPRISE: Final = 25.0
"""Squared Mahalanobis distance of a correction that no driving explains; as that of `matching.demand_on`."""
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


def on_odometry(state: State, record: Odometry) -> None:
    """Take in whether the wheels stand; as long as they tell nothing, they are not known to turn."""
    doubt = state.suspicion
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


def waits(state: State) -> bool:
    """Whether nothing may be laid into the map now, because the robot may be elsewhere."""
    doubt = state.suspicion
    looking = doubt.question is not None and state.fused.t_mono - doubt.t_asked < PATIENCE_S
    return looking or doubt.fitted > 0


def raised(state: State, scan: Scan, points: ScanPoints, match: MatchResult) -> bool:
    """Whether the place is to be looked for now; to be asked before the match is fused."""
    doubt, atlas = state.suspicion, state.atlas
    strange = was_strange(state, scan, points, match)
    if not match.ok or state.local is None:
        return False
    alone, leapt = unwatched(state), leaps(state, scan, points, match, strange)
    if map_odom_filter.tells(state) or atlas.adrift is not None or state.settings.loops is None:
        doubt.end()
        atlas.own = 0
        return False
    share, odd = match.inliers / max(1, match.queries), surprising(state, match)
    made = se2.between(state.T_odom_scan, match.T_odom_base)  # wheels that lie move the prediction, not the robot
    jump = odd and all(too_far(T, state.fused.t_mono - state.t_match) for T in (match.correction, made))
    doubt.jumped |= jump
    doubt.leapt |= leapt
    if doubt.fitted or alone or jump or state.failures >= ROW or leapt:
        doubt.odd |= odd
        doubt.fitted = max(doubt.fitted + 1, ROW if leapt else 0)
    else:
        doubt.share += LEARNING * (share - doubt.share) if doubt.share else share
    if doubt.fitted >= ROW and not (doubt.odd or doubt.leapt) and share > doubt.share - CHANGED:
        doubt.fitted = 0  # the same picture from the same place
    if doubt.question is not None and state.fused.t_mono - doubt.t_asked > GIVEN_UP_S:
        give_up(state, doubt.question)
    return doubt.fitted >= ROW and doubt.question is None


def was_strange(state: State, scan: Scan, points: ScanPoints, match: MatchResult) -> bool:
    """Whether for a while much of the map was looked through, the wheels standing, and is not now, or still is.

    So it is where the robot was carried on by hand to where it looks alike: from one scan to the next little changes.
    What the map has wrong there was looked through already when the wheels stopped. Told once.
    """
    doubt, now = state.suspicion, state.fused.t_mono
    rests_s, silent = now - doubt.t_rest, now - state.fused.t_odometry >= RESTED_S
    share = looked_through(state, scan, points, match) if rests_s >= ROLLS_S and not silent else -1.0
    if share >= 0.0 and (doubt.through < 0.0 or rests_s < RESTED_S):
        doubt.through = share if doubt.through < 0.0 else min(doubt.through, share)
    if share > doubt.through + STRANGE:
        doubt.strange_s += min(max(0.0, now - state.t_scan), doubt.period_s, STRANGE_S / ROW)
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


def looked_through(state: State, scan: Scan, points: ScanPoints, match: MatchResult) -> float:
    """Share of the local map in view that a scan looks through from where it was taken; negative: it shows nothing."""
    if state.local is None or match.reason in BLIND:
        return -1.0
    eye = se2.compose(match.T_odom_base, scan.T_base_lidar)
    beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
    return local_map.looked_through(state.local, eye, beams, noise_of(state, scan))


def leaps(state: State, scan: Scan, points: ScanPoints, match: MatchResult, strange: bool) -> bool:
    """Whether what is seen has changed all at once, or was `strange`: now, or while light told the place and not since.

    Where the robot is put down there may be no lamp, and for a moment nobody knows that it has been one.
    """
    doubt = state.suspicion
    eye = se2.compose(match.T_odom_base, scan.T_base_lidar)
    beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
    doubt.leap.take(glance(scan.t_end, eye, beams), noise_of(state, scan), doubt.period_s)
    if doubt.leap.seen or strange:
        doubt.t_leap = scan.t_end
    if map_odom_filter.tells(state) or not doubt.t_leap > map_odom_filter.told_last(state):
        return False
    doubt.t_leap = -math.inf
    return True


def give_up(state: State, question: Question) -> None:
    """Wait for an answer no longer; what was asked has to be asked again."""
    doubt = state.suspicion
    state.atlas.asked.pop(doubt.job, None)
    doubt.question, doubt.fitted, doubt.odd = None, max(doubt.fitted, ROW), True
    doubt.jumped, doubt.again = doubt.jumped or question.jumped, question.again
    doubt.leapt |= question.leapt


def unwatched(state: State) -> bool:
    """Whether the robot has stood, or nobody knows, for long without a match; another one has come now."""
    doubt, now = state.suspicion, state.fused.t_mono
    usual, since = doubt.period_s, now - state.t_match
    alone_s = min(since, max(doubt.unwatched_s, now - doubt.t_still))
    doubt.t_still, doubt.moved, doubt.unwatched_s = now, np.zeros(3), 0.0
    if math.isfinite(since):
        doubt.period_s = (1.0 - LEARNING) * usual + LEARNING * min(since, 2.0 * usual) if usual else since
    return usual > 0.0 and alone_s >= max(UNWATCHED_S, MISSED * usual)


def surprising(state: State, match: MatchResult) -> bool:
    """Whether a match has moved the pose farther than the prediction allows."""
    off = match.correction
    return float(off @ invert3(state.fused.P) @ off) > SURPRISE


def look(state: State, scan: Scan, points: ScanPoints, match: MatchResult) -> None:
    """Ask whether the place, after the match is fused, stands a search of the whole map."""
    atlas, told, doubt = state.atlas, state.settings.loops, state.suspicion
    assert told is not None
    assert state.local is not None
    T = state.fused.T_odom_base
    frame = keyframe.keep(state.next_key, se2.compose(state.T_map_odom, T), T, scan, points.turned_rad)
    against = local_map.contradicted(state.local, frame.T_odom_lidar, frame.beams(), noise_of(state, scan))
    share = match.inliers / max(1, match.queries)
    holds = global_scan_match.judged(match, share, against, told) is Verdict.HOLDS
    asked = Question(doubt.jumped, holds, doubt.again, doubt.leapt)
    doubt.fitted, doubt.jumped, doubt.odd, doubt.again, doubt.leapt = 0, False, False, False, False
    doubt.since = doubt.since or state.next_key
    older = [one for one in atlas.settled() if one.first < doubt.since]
    pieces = tuple(Piece(one.key, one.T_map_submap, one.settled) for one in older if one.settled is not None)
    if pieces:
        nodes = global_scan_match.NODES if asked.again else NODES
        query = Query(frame, pieces, atlas.seek.terrain, (frame.T_map_keyframe,), (), nodes=nodes)
        doubt.job = atlas.ask(LOOK, partial(global_scan_match.look, query, told), partial(answered, state, asked))
        doubt.question, doubt.t_asked, atlas.own = asked, state.fused.t_mono, doubt.since
    elif asked.jumped:  # nothing of the map is finished yet that could be searched
        carried_off(state)
    else:
        doubt.since = 0


def answered(state: State, asked: Question, payload: object) -> None:
    """Be adrift if the place is not the only one, or does not hold after a jump; look again if that was not found out.

    An answer that comes late counts as well: what was laid meanwhile is of the place that it is about.
    """
    assert isinstance(payload, Looked)
    doubt = state.suspicion
    if doubt.question is not asked:
        return  # light tells the place, the robot is adrift, or the map has been begun anew since
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
        doubt.since = state.atlas.own = 0
    elif asked.jumped or asked.again:
        carried_off(state)
    else:
        doubt.fitted, doubt.odd, doubt.again, doubt.leapt = ROW, True, True, doubt.leapt or asked.leapt


def carried_off(state: State) -> None:
    """Be adrift; a map of one scan, in which nobody can be looked for, is begun anew: it would be one of two places."""
    atlas, since = state.atlas, state.suspicion.since
    first = next((one.key for one in atlas.submaps.values() if one.first >= since > 0), None)
    if first is not None:
        relocalisation.disown(state, first, since)
    if not relocalisation.afresh(state) and atlas.adrift is None:
        forget(state)
        state.anew += 1

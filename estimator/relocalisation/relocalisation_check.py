"""Relocalisation check: confirms or revokes an accepted pose by later keyframes, while the robot drives on.

A room that is not in the map may look like one that is. Inside it no scan shows the difference; scans after leaving it
do. Then relocalisation starts again. Submaps created there meanwhile are removed if the lidar alone had decided. During
the trial they are not saved, and replace nothing older. If light gives the pose, and the map had a frame of its own,
the map becomes unaligned instead (`unaligned_map`).
"""

from __future__ import annotations

from functools import partial
from typing import Final

from estimator.job_queue import SEARCH, job_function
from estimator.mapping.keyframe import Keyframe
from estimator.relocalisation import relocalisation, unaligned_map
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, Verdict, look
from estimator.relocalisation.hypothesis_tracking import Seek, Watch
from estimator.relocalisation.owners import Owners

STRIKES: Final = 3
"""Rejected checks without a confirming one between them after which the pose was wrong."""


def keyframe_laid(state: Owners, frame: Keyframe) -> None:
    """Check a new keyframe against the map as it was before the pose was found."""
    graph, told, watch = state.map.graph, state.map.settings.loops, state.map.parts.trial
    if not isinstance(watch, Watch) or told is None or graph.parts.detached is not None or graph.jobs.busy(watch):
        return
    if graph.way_m > watch.until_m:
        graph.parts.trial = None
        return
    older = [one for one in graph.settled() if one.key < watch.first]
    pieces = tuple(Piece(one.key, one.T_map_submap, one.settled) for one in older if one.settled is not None)
    if pieces:
        guess = (frame.T_map_keyframe,)
        query = Query(frame, pieces, watch.terrain, guess, (), search=False, outvoted=lit(state))
        graph.jobs.ask(SEARCH, partial(look, query, told), partial(take_check, state, watch), owner=watch)


def lit(state: Owners) -> bool:
    """Whether light confirms the pose too; then one reference scan of the map does not exclude it."""
    if state.light is None:
        return False
    from estimator.relocalisation.light_evidence import witness

    return witness(state.light, state.map.graph, state.pose.here(state.motion.T_odom_base))


@job_function
def take_check(state: Owners, watch: Watch, payload: object) -> None:
    """Apply the result of a check."""
    assert isinstance(payload, Looked)
    (fit,), watch.terrain = payload.guesses, payload.terrain
    watch.strikes = 0 if fit.verdict is Verdict.HOLDS else watch.strikes + (fit.verdict is Verdict.NO)
    if watch.strikes >= STRIKES and state.map.parts.trial is watch and state.map.parts.detached is None:
        state.map.parts.trial = None
        if watch.foreign_m is not None and unaligned_map.lit(state):
            unaligned_map.set_aside(state, watch, watch.foreign_m, Seek())
            return
        if watch.alone:
            relocalisation.disown(state, watch.first, watch.since)
        relocalisation.begin(state, dead_reckoning=watch.expected)
        state.relocalisation.unaligned |= watch.foreign_m is not None

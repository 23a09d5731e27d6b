"""After a place was found in the whole map: whether what is seen from there on goes on being true of it.

A room that is not in the map may look like one that is. While the robot stays in it nothing tells; what it sees when it
leaves does, and then it is being relocalised again instead of going on in the wrong place. What it has mapped there
meanwhile goes if the laser alone had decided; until the watch is over that is not saved, and takes the place of nothing
older. Where light has the place and the map came in a frame of its own, it is the map that goes: it is set aside
(`unaligned_map`).
"""

from __future__ import annotations

from functools import partial
from typing import Final

from estimator.job_queue import SEARCH
from estimator.mapping.keyframe import Keyframe
from estimator.relocalisation import relocalisation, unaligned_map
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, Verdict, look
from estimator.relocalisation.hypothesis_tracking import Seek, Watch
from estimator.relocalisation.owners import Owners

STRIKES: Final = 3
"""Looks, with none between that holds the place, after which it was the wrong one."""


def keyframe_laid(state: Owners, frame: Keyframe) -> None:
    """Look whether a new keyframe is true of the map as it was before the place was found."""
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
        graph.jobs.ask(SEARCH, partial(look, query, told), partial(take, state, watch), owner=watch)


def lit(state: Owners) -> bool:
    """Whether light has the robot here too: then one witness of the map does not rule the place out."""
    if state.light is None:
        return False
    from estimator.relocalisation.light_evidence import witness

    return witness(state.light, state.map.graph, state.pose.here(state.motion.T_odom_base))


def take(state: Owners, watch: Watch, payload: object) -> None:
    """Take in what a look has found."""
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
        relocalisation.begin(state)
        state.relocalisation.unaligned |= watch.foreign_m is not None

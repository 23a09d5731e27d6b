"""After a place was found in the whole map: whether what is seen from there on goes on being true of it.

A room that is not in the map may look like one that is. While the robot stays in it nothing tells; what it sees when
it leaves does, and then it is adrift again instead of going on in the wrong place. What it has mapped there meanwhile
goes if the laser alone had decided; until the watch is over that is not saved, and takes the place of nothing older.
Where light has the place and the map came in a frame of its own, it is the map that goes: it is put aside (`aside`).
"""

from __future__ import annotations

from functools import partial
from typing import Final

from estimator.mapping.keyframe import Keyframe
from estimator.mapping.submap_graph import LOOK
from estimator.numerics import se2
from estimator.relocalisation import relocalisation, unaligned_map
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, Verdict, look
from estimator.relocalisation.hypothesis_tracking import Watch
from estimator.state import State

STRIKES: Final = 3
"""Looks, with none between that holds the place, after which it was the wrong one."""


def keyframe_laid(state: State, frame: Keyframe) -> None:
    """Look whether a new keyframe is true of the map as it was before the place was found."""
    atlas, told, watch = state.atlas, state.settings.loops, state.atlas.watch
    if watch is None or told is None or atlas.adrift is not None or watch.job in atlas.asked:
        return
    if atlas.way_m > watch.until_m:
        atlas.watch = None
        return
    older = [one for one in atlas.settled() if one.key < watch.first]
    pieces = tuple(Piece(one.key, one.T_map_submap, one.settled) for one in older if one.settled is not None)
    if pieces:
        guess = (frame.T_map_keyframe,)
        query = Query(frame, pieces, watch.terrain, guess, (), search=False, outvoted=lit(state))
        watch.job = atlas.ask(LOOK, partial(look, query, told), partial(take, state, watch))


def lit(state: State) -> bool:
    """Whether light has the robot here too: then one witness of the map does not rule the place out."""
    if state.light is None:
        return False
    from estimator.relocalisation.light_evidence import witness

    return witness(state, se2.compose(state.T_map_odom, state.fused.T_odom_base))


def take(state: State, watch: Watch, payload: object) -> None:
    """Take in what a look has found."""
    assert isinstance(payload, Looked)
    (fit,), watch.terrain = payload.guesses, payload.terrain
    watch.strikes = 0 if fit.verdict is Verdict.HOLDS else watch.strikes + (fit.verdict is Verdict.NO)
    if watch.strikes >= STRIKES and state.atlas.watch is watch and state.atlas.adrift is None:
        state.atlas.watch = None
        if watch.foreign_m is not None and unaligned_map.lit(state):
            unaligned_map.put_aside(state, watch.first, watch.since, watch.foreign_m)
            return
        if watch.alone:
            relocalisation.disown(state, watch.first, watch.since)
        relocalisation.begin(state)
        state.atlas.foreign |= watch.foreign_m is not None

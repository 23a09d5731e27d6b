"""A stored map in a frame of its own, set aside while light tells where the robot is: it is found then, or let go of.

A map that was made without lamps does not say where it lies in the light survey, so light is no witness of a place in
it. But once light has told the robot's place surely, that is its place, whether the map is found or not: a new map is
begun there, as without a stored one, and whoever drives out of what the stored one knows is not lost. Meanwhile each
new keyframe is looked for in the stored one by the laser alone. Where it is found the stored one is laid to where it
belongs, the robot does not jump, and the two are one map. Where as much has been driven as the stored map may be of,
and nothing of it holds, it is of somewhere else: it is let go of, and what was mapped since is a map of its own.
"""

from __future__ import annotations

import numpy as np

from estimator.fusion.light_witness import KNOWN, light_holds
from estimator.mapping import live_grid
from estimator.mapping.keyframe import SIZE, Keyframe
from estimator.mapping.map_frame import relist
from estimator.mapping.map_parts import Trial
from estimator.relocalisation.global_scan_match import Looked
from estimator.relocalisation.hypothesis_tracking import Hypothesis, SearchedAside, Seek
from estimator.relocalisation.landing import land
from estimator.relocalisation.owners import Owners
from estimator.relocalisation.relocalisation import hand_out
from estimator.result import SURPRISE, Fix

LEAST_M, MOST_M = 5.0, 100.0
"""Way under lamps, at least and at most, after which a stored map in which nothing holds is let go of."""


def step_done(state: Owners) -> None:
    """Set the stored map aside once light has told the place, and there is something of a new one."""
    graph, parts, memory = state.map.graph, state.map.parts, state.relocalisation
    if not memory.unaligned or parts.detached is None or memory.search.hint is not None or not lit(state):
        return
    newest = graph.newest
    if newest is not None and newest.key >= parts.detached:
        set_aside(state, Trial(first=parts.detached, since=parts.detached_since), graph.way_m, memory.search)


def lit(state: Owners) -> bool:
    """Whether light goes on telling the place, and surely."""
    alignment, light = state.pose.alignment, state.light
    holds = light_holds(state.pose, state.motion, light)
    if alignment is None or light is None or not holds or light.result.fix is not Fix.GOOD:
        return False
    agrees = alignment.odd_since is None and alignment.gap is not None and alignment.gap <= SURPRISE
    return agrees and bool(np.all(np.diag(alignment.P) < KNOWN))


def set_aside(state: Owners, own: Trial, begun_m: float, search: Seek) -> None:
    """Go on in a map of its own.

    Args:
        state: its map is split.
        own: where that map begins; what is older goes aside.
        begun_m: way driven when the robot, its place being known by light, began to be looked for in what goes aside.
        search: that search so far.
    """
    graph, parts, first, since = state.map.graph, state.map.parts, own.first, own.since
    older = {key: submap for key, submap in graph.submaps.items() if key < first}
    frames = {key: frame for key, frame in state.map.keyframes.items() if key < since}
    joined = graph.constraints.split(first)
    parts.aside = SearchedAside(
        submaps=older,
        constraints=joined,
        frames=frames,
        session_start=parts.session_start,
        first=first,
        since=since,
        begun_m=begun_m,
        search=search,
    )
    graph.submaps = {key: submap for key, submap in graph.submaps.items() if key >= first}
    state.map.keyframes = {key: frame for key, frame in state.map.keyframes.items() if key >= since}
    parts.attach()
    parts.bridge, parts.trial, state.relocalisation.search = None, None, Seek()
    parts.session_start, parts.fixed = 0, False  # light holds the robot in a map of its own
    state.relocalisation.unaligned = False
    graph.waiting, graph.tied, graph.ties, graph.stale = [], None, {}, True
    relist(state.map, 0)
    live_grid.redraw(state.map.live, state.map.graph, state.map.keyframes.values())


def keyframe_laid(state: Owners, frame: Keyframe) -> None:
    """Look for a new keyframe in the map that was set aside, or let go of that one."""
    graph, parts = state.map.graph, state.map.parts
    aside = parts.aside
    if not isinstance(aside, SearchedAside) or parts.detached is not None or parts.trial is not None:
        return
    if graph.jobs.busy(aside.search):
        return
    holds = any(one.held and not one.idle for one in aside.search.alive)
    if graph.way_m - aside.begun_m > enough(state.map.settings.keyframe_m, aside) and not holds:
        parts.aside = None
        state.relocalisation.maps_dropped += 1
        return
    hand_out(state, aside.search, frame, aside.submaps.values(), None, take)


def enough(keyframe_m: float, aside: SearchedAside) -> float:
    """Way (m) after which a robot would have been found: as much as the map may be of, within bounds."""
    return min(max(LEAST_M, len(aside.submaps) * SIZE * keyframe_m), MOST_M)


def take(state: Owners, seek: Seek, frame: Keyframe, asked: tuple[Hypothesis, ...], payload: object) -> None:
    """Take in what a look has found; and the decision, if it is one."""
    assert isinstance(payload, Looked)
    aside = state.map.parts.aside
    if not isinstance(aside, SearchedAside) or aside.search is not seek or state.map.parts.detached is not None:
        return
    seek.take(frame, asked, payload)
    one = seek.favourite()
    if one is not None and seek.sure(one, False):
        found(state, aside, one)


def found(state: Owners, aside: SearchedAside, one: Hypothesis) -> None:
    """The map that was set aside is taken to where the robot has been found in it, and the two are one.

    It is watched as every place is that the laser alone has found.
    """
    graph, parts = state.map.graph, state.map.parts
    if not any(frame.submap.key in graph.submaps for frame, _ in one.held):
        return
    graph.submaps, state.map.keyframes = aside.submaps | graph.submaps, aside.frames | state.map.keyframes
    graph.constraints.put(aside.constraints)
    parts.aside, parts.session_start, parts.fixed = None, aside.session_start, state.map.settings.localise
    parts.detached, parts.detached_since = aside.first, aside.since
    state.relocalisation.unaligned, state.relocalisation.search = True, aside.search
    land(state, one, True)
    if parts.trial is not None:
        parts.trial.foreign_m = aside.begun_m
    live_grid.redraw(state.map.live, state.map.graph, state.map.keyframes.values())

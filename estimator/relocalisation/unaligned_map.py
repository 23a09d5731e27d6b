"""Unaligned map: a stored map not registered to the survey, kept apart until the lidar finds the robot in it.

A map made without lamps has no known pose in the survey, so light cannot confirm a pose in it. But once light gives the
robot's pose with a small covariance, that pose is valid without the stored map. A new map begins there, as without a
stored one. A robot that leaves the area of the stored map is therefore not lost. Meanwhile the lidar alone searches
each new keyframe in the stored map. After a match the stored map moves to its pose in the survey, and both become one
map. The robot does not jump. If no match follows on a path as long as the stored map, that map is of another area. It
is then dropped, and the new map stands alone.
"""

from __future__ import annotations

import numpy as np

from estimator.fusion.light_witness import KNOWN, light_holds
from estimator.job_queue import job_function
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
"""Shortest and longest path (m) under lamps after which a stored map without a match is dropped."""


def step_done(state: Owners) -> None:
    """Separate the stored map once light gives the pose, and a new submap exists."""
    graph, parts, memory = state.map.graph, state.map.parts, state.relocalisation
    if not memory.unaligned or parts.detached is None or memory.search.hint is not None or not lit(state):
        return
    newest = graph.newest
    if newest is not None and newest.key >= parts.detached:
        set_aside(state, Trial(first=parts.detached, since=parts.detached_since), graph.way_m, memory.search)


def lit(state: Owners) -> bool:
    """Whether light gives the pose now, with a small covariance."""
    alignment, light = state.pose.alignment, state.light
    holds = light_holds(state.pose, state.motion, light)
    if alignment is None or light is None or not holds or light.result.fix is not Fix.GOOD:
        return False
    agrees = alignment.odd_since is None and alignment.gap is not None and alignment.gap <= SURPRISE
    return agrees and bool(np.all(np.diag(alignment.P) < KNOWN))


def set_aside(state: Owners, own: Trial, begun_m: float, search: Seek) -> None:
    """Separate the older map and continue in a map of its own.

    Args:
        state: its map is split.
        own: begin of that map; everything older is separated.
        begun_m: path length at which the search in the older map began, after light had given the pose, m.
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
    parts.session_start, parts.fixed = 0, False  # light gives the robot's pose in a map of its own
    state.relocalisation.unaligned = False
    graph.waiting, graph.tied, graph.ties, graph.stale = [], None, {}, True
    relist(state.map, 0)
    live_grid.redraw(state.map.live, state.map.graph, state.map.keyframes.values())


def keyframe_laid(state: Owners, frame: Keyframe) -> None:
    """Search a new keyframe in the unaligned map, or drop that map."""
    graph, parts = state.map.graph, state.map.parts
    aside = parts.aside
    if not isinstance(aside, SearchedAside) or parts.detached is not None or parts.trial is not None:
        return
    if graph.jobs.busy(aside.search) or state.motion.t_mono < aside.search.t_paid:
        return
    holds = any(one.held and not one.idle for one in aside.search.alive)
    if graph.way_m - aside.begun_m > enough(state.map.settings.keyframe_m, aside) and not holds:
        parts.aside = None
        state.relocalisation.maps_dropped += 1
        return
    hand_out(state, aside.search, frame, aside.submaps.values(), None, take_aside)


def enough(keyframe_m: float, aside: SearchedAside) -> float:
    """Path length (m) after which a robot would have been found: as long as the map can cover, within limits."""
    return min(max(LEAST_M, len(aside.submaps) * SIZE * keyframe_m), MOST_M)


@job_function
def take_aside(state: Owners, seek: Seek, frame: Keyframe, asked: tuple[Hypothesis, ...], payload: object) -> None:
    """Apply the result of a search, and accept a hypothesis if it is decided."""
    assert isinstance(payload, Looked)
    aside = state.map.parts.aside
    if not isinstance(aside, SearchedAside) or aside.search is not seek or state.map.parts.detached is not None:
        return
    seek.take(frame, asked, payload)
    seek.pay(state.motion.t_mono, payload.work())
    one = seek.favourite()
    if one is not None and seek.sure(one, False):
        found(state, aside, one)


def found(state: Owners, aside: SearchedAside, one: Hypothesis) -> None:
    """Move the unaligned map to the pose of the accepted hypothesis and join the two maps.

    As after every pose found by the lidar alone, a trial follows.
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

"""A stored map in a frame of its own, put aside while light tells where the robot is: it is found then, or let go of.

A map that was made without lamps does not say where it lies in the light survey, so light is no witness of a place in
it. But once light has told the robot's place surely, that is its place, whether the map is found or not: a new map is
begun there, as without a stored one, and whoever drives out of what the stored one knows is not lost. Meanwhile each
new keyframe is looked for in the stored one by the laser alone. Where it is found the stored one is laid to where it
belongs, the robot does not jump, and the two are one map. Where as much has been driven as the stored map may be of,
and nothing of it holds, it is of somewhere else: it is let go of, and what was mapped since is a map of its own.
"""

from __future__ import annotations

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.mapping import live_grid
from estimator.mapping.keyframe import Keyframe
from estimator.mapping.map_frame import rehang
from estimator.mapping.submap import SIZE
from estimator.mapping.submap_graph import Aside
from estimator.relocalisation.global_scan_match import Looked
from estimator.relocalisation.hypothesis_tracking import Hypothesis, Seek
from estimator.relocalisation.relocalisation import hand_out, land
from estimator.result import SURPRISE, Fix
from estimator.state import State

LEAST_M, MOST_M = 5.0, 100.0
"""Way under lamps, at least and at most, after which a stored map in which nothing holds is let go of."""


def step_done(state: State) -> None:
    """Put the stored map aside once light has told the place, and there is something of a new one."""
    atlas, newest = state.atlas, state.atlas.newest
    if not atlas.foreign or atlas.adrift is None or atlas.seek.hint is not None or not lit(state):
        return
    if newest is not None and newest.key >= atlas.adrift:
        put_aside(state, atlas.adrift, atlas.since, atlas.way_m, atlas.seek)


def lit(state: State) -> bool:
    """Whether light goes on telling the place, and surely."""
    tie, light = state.absolute, state.light
    if tie is None or light is None or not map_odom_filter.tells(state) or light.result.fix is not Fix.GOOD:
        return False
    agrees = tie.odd_since is None and tie.gap is not None and tie.gap <= SURPRISE
    return agrees and bool(np.all(np.diag(tie.P) < map_odom_filter.KNOWN))


def put_aside(state: State, first: int, since: int, begun_m: float, seek: Seek | None = None) -> None:
    """Go on in a map of its own.

    Args:
        state: all of the estimator.
        first: key of the first submap of that map; what is older goes aside.
        since: ID of its first keyframe.
        begun_m: way driven when the robot, its place being told by light, began to be looked for in what goes aside.
        seek: that search so far.
    """
    atlas = state.atlas
    older = {key: submap for key, submap in atlas.submaps.items() if key < first}
    frames = {key: frame for key, frame in state.keyframes.items() if key < since}
    joined = atlas.constraints.split(first)
    atlas.aside = Aside(older, joined, frames, atlas.kept, first, since, begun_m, seek or Seek())
    atlas.submaps = {key: submap for key, submap in atlas.submaps.items() if key >= first}
    state.keyframes = {key: frame for key, frame in state.keyframes.items() if key >= since}
    atlas.adrift, atlas.since, atlas.bridge, atlas.seek, atlas.watch = None, 0, None, Seek(), None
    atlas.kept, atlas.held, atlas.foreign = 0, False, False  # light holds the robot in a map of its own
    atlas.waiting, atlas.tied, atlas.ties, atlas.stale = [], None, {}, True
    rehang(state, 0)
    live_grid.redraw(state)


def keyframe_laid(state: State, frame: Keyframe) -> None:
    """Look for a new keyframe in the map that was put aside, or let go of that one."""
    atlas, aside = state.atlas, state.atlas.aside
    if aside is None or atlas.adrift is not None or atlas.watch is not None or aside.seek.job in atlas.asked:
        return  # none, or the robot's own place is in doubt
    holds = any(one.held and not one.idle for one in aside.seek.alive)
    if atlas.way_m - aside.begun_m > enough(state, aside) and not holds:
        atlas.aside = None
        state.let_go += 1
        return
    hand_out(state, aside.seek, frame, aside.submaps.values(), None, take)


def enough(state: State, aside: Aside) -> float:
    """Way (m) after which a robot would have been found: as much as the map may be of, within bounds."""
    return min(max(LEAST_M, len(aside.submaps) * SIZE * state.settings.keyframe_m), MOST_M)


def take(state: State, seek: Seek, frame: Keyframe, asked: tuple[Hypothesis, ...], payload: object) -> None:
    """Take in what a look has found; and the decision, if it is one."""
    assert isinstance(payload, Looked)
    aside = state.atlas.aside
    if aside is None or aside.seek is not seek or state.atlas.adrift is not None:
        return
    seek.take(frame, asked, payload)
    one = seek.favourite()
    if one is not None and seek.sure(one, False):
        found(state, aside, one)


def found(state: State, aside: Aside, one: Hypothesis) -> None:
    """The map that was put aside is taken to where the robot has been found in it, and the two are one.

    It is watched as every place is that the laser alone has found.
    """
    atlas = state.atlas
    if not any(frame.submap.key in atlas.submaps for frame, _ in one.held):
        return
    atlas.submaps, state.keyframes = aside.submaps | atlas.submaps, aside.frames | state.keyframes
    atlas.constraints.put(aside.constraints)
    atlas.aside, atlas.kept, atlas.held, atlas.foreign = None, aside.kept, state.settings.localise, True
    atlas.adrift, atlas.since, atlas.seek = aside.first, aside.since, aside.seek
    land(state, one, True)
    if atlas.watch is not None:
        atlas.watch.foreign_m = aside.begun_m
    live_grid.redraw(state)

"""Relocalisation: finds the robot's pose in the map after a start in a stored map, or after kidnapping.

Until it is found the robot maps as usual, in a detached part of the graph. Searches in the older part
(`global_scan_match`, background jobs) leave some hypotheses (`hypothesis_tracking`). When one of them is certain, a
loop joins the two parts. ``T_map_odom`` moves the robot there at once, and ordinary loops continue.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final

import numpy as np

from estimator.fusion.light_witness import blind, light_holds
from estimator.job_queue import SEARCH, job_function
from estimator.mapping import live_grid
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.mapping.map_frame import relist, unlist
from estimator.numerics import se2
from estimator.relocalisation import kidnap_opportunity
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, look
from estimator.relocalisation.hypothesis_tracking import Hypothesis, SearchedAside, Seek, near
from estimator.relocalisation.landing import SURPRISE, land
from estimator.relocalisation.owners import Owners
from estimator.result import Fix
from estimator.scan_matching.branch_and_bound import Around

Take = Callable[[Owners, Seek, Keyframe, tuple[Hypothesis, ...], object], None]
"""Applies a search result: arguments are the state, hypothesis set, keyframe, tested hypotheses and result."""

HINT_M, HINT_RAD = 1.0, 0.5
"""Largest distance (m, rad) of the robot from an operator pose."""
HINT_LOOKS: Final = 4
"""Searches without a match after which the operator pose is wrong."""
PATIENCE_S: Final = 1.0
"""Time (s) to wait for light before a search of the whole map."""
ELSEWHERE_S, UNFIT = 3.0, 2
"""Time (s) of light at another position after which the robot counts as kidnapped.

UNFIT: number of consecutive scans without a match after which it counts at once.
"""
ASIDE_S: Final = 0.3
"""The same time (s) where lidar tracking had a gap since light last agreed, and single epochs place it elsewhere.

The robot may have been carried on while a new local map began.
"""
ALONE_M: Final = 5.0
"""Path length (m) after which valid light that agrees is accepted alone, where the map does not know the area."""
STALE: Final = 5
"""Scans after which a keyframe without a match is created again, where light places it here."""
YOUNG: Final = 2
"""Fewest keyframes of a map that can be searched."""


def begin(state: Owners, dead_reckoning: bool = False) -> bool:
    """Detach the map and start relocalisation; False where there is no map to search.

    ``dead_reckoning``: see `RelocalisationMemory`.

    One unfinished submap suffices: the robot begins another one, and the former is then finished. So do submaps that
    are just being finished.
    """
    graph = state.map.graph
    young = graph.parts.detached is None and (len(graph.frames) >= YOUNG or len(graph.submaps) > 1)
    if state.map.settings.loops is None or not (young or graph.settled()):
        return False
    if graph.parts.detached is not None:
        forget_detached(state)
    else:
        leave_map(state)
    state.relocalisation.suspicion.end()
    state.relocalisation.suspicion.leap.forget()
    graph.detach(state.map.next_key)
    state.relocalisation.search, state.relocalisation.dead_reckoning = Seek(), dead_reckoning
    aside = graph.parts.aside
    if isinstance(aside, SearchedAside):
        aside.search = Seek()
    return True


def leave_map(state: Owners) -> None:
    """Store the pose and covariance of the map's alignment at the latest match; zero without an alignment by light."""
    alignment, memory = state.pose.alignment, state.relocalisation
    placed = alignment is not None and alignment.placed
    memory.T_left, memory.P_left = alignment.kept if alignment and placed else (se2.identity(), np.zeros((3, 3)))


def local_map_lost(state: Owners) -> None:
    """Start relocalisation after a local map restart, unless a kidnapping is excluded, by its opportunity or by light.

    Without an opportunity for a kidnapping (`kidnap_opportunity`), odometry or the last velocity has carried the pose.
    A light filter biased by odometry confirms the pose too, as long as the received lamps are possible here. A robot
    under relocalisation may have been carried on; the search so far is then void.
    """
    if not kidnap_opportunity.unresolved(state):
        return
    detached = state.map.parts.detached is not None
    if not lit(state) or detached:
        begin(state, state.motion.odometry and (state.relocalisation.dead_reckoning or not detached))


def lit(state: Owners) -> bool:
    """Whether light confirms the pose: its solution agrees, or the received lamps are possible here."""
    alignment = state.pose.alignment
    if alignment is None or alignment.gap is None or not light_holds(state.pose, state.motion, state.light):
        return False
    from estimator.relocalisation.light_evidence import in_place

    here = state.pose.here(state.motion.T_odom_base)
    return alignment.gap <= SURPRISE or (alignment.proved and in_place(state.light, here))


def lidar_is_wrong(state: Owners) -> bool:
    """Whether light confirms the pose while scans see through most of the map; such scans begin no new local map.

    Light and odometry carry the pose. The map stays as it is until the scans fit again.
    """
    return kidnap_opportunity.mostly_excluded(state) and lit(state)


def forget_detached(state: Owners) -> None:
    """Remove the keyframes of a part that was never attached."""
    gone = [frame for key, frame in state.map.keyframes.items() if key >= state.map.parts.detached_since]
    for frame in gone:
        del state.map.keyframes[frame.key]
        if state.map.settings.history:
            state.map.retired[frame.key] = frame.submap, se2.between(frame.submap.T_odom_submap, frame.T_odom_keyframe)
    unlist(state.map, state.map.parts.detached_since)


def disown(state: Owners, first: int, since: int) -> None:
    """Detach the submaps of a wrong pose, so that the next `begin` removes them.

    Otherwise the robot would find itself again in them. ``first``: key of the first such submap, ``since``: ID of its
    first keyframe.
    """
    if state.map.parts.detached is None:
        leave_map(state)
    state.map.parts.detached, state.map.parts.detached_since, state.map.graph.stale = first, since, True
    live_grid.forget(state.map.live, state.map.graph, first)


def places(state: Owners) -> int | None:
    """Number of hypotheses, None where the pose is known (see `StepResult.places`); light alone may know it too."""
    if state.map.parts.detached is None or dead_reckons(state):
        return None
    lit = light_holds(state.pose, state.motion, state.light) and blind(state.pose, state.motion)
    if lit:
        from estimator.relocalisation.light_evidence import disputed  # costs nothing where there is no photodiode

        lit = not disputed(state.light, state.map.graph)
    return None if lit else len(state.relocalisation.search.alive)


def dead_reckons(state: Owners) -> bool:
    """Whether odometry carries the pose of a detached part, and no search has confirmed another place.

    Until then a blocked view is far more probable than a kidnapping.
    """
    if not state.relocalisation.dead_reckoning or state.map.parts.detached is None:
        return False
    T = state.motion.T_odom_base
    here = state.pose.here(T)
    confirmed = [one for one in state.relocalisation.search.alive if one.held]
    return all(near(here, se2.compose(one.T_map_odom, T)) for one in confirmed)


def hinted(state: Owners) -> None:
    """Restart the search around an operator pose."""
    state.relocalisation.dead_reckoning = False
    state.relocalisation.search = Seek(terrain=state.relocalisation.search.terrain, hint=(state.pose.T_map_odom, 0))


def keyframe_laid(state: Owners, frame: Keyframe) -> None:
    """Search a new keyframe during relocalisation, if no other search runs."""
    graph, told = state.map.graph, state.map.settings.loops
    if graph.parts.detached is None or told is None or graph.jobs.busy(state.relocalisation.search):
        return
    around = windows(state, frame)
    if around is None and (light_is_coming(state) or search_waits(state)):
        return
    look_for(state, frame, around)


def search_waits(state: Owners) -> bool:
    """Whether a search has to wait for its share of a core. Only while odometry carries the pose there is time."""
    return state.relocalisation.dead_reckoning and state.motion.t_mono < state.relocalisation.search.t_paid


def look_for(state: Owners, frame: Keyframe, around: tuple[Around, ...] | None) -> None:
    """Queue the search of a keyframe in what is not detached."""
    hand_out(state, state.relocalisation.search, frame, state.map.graph.settled(), around, take_look)


def hand_out(
    state: Owners, seek: Seek, frame: Keyframe, among: Iterable[Submap], around: tuple[Around, ...] | None, take: Take
) -> None:
    """Queue the search of a keyframe among submaps."""
    graph, told = state.map.graph, state.map.settings.loops
    pieces = tuple(Piece(one.key, one.T_map_submap, one.settled) for one in among if one.settled is not None)
    if not pieces or told is None:
        return
    asked = seek.alive
    seek.lit = frame.key
    due = seek.due(frame) or seek.elsewhere(around or ())
    if due:
        seek.around = around or ()
    guesses = tuple(se2.compose(one.T_map_odom, frame.T_odom_keyframe) for one in asked)
    firm = tuple(one.firm() for one in asked)
    query = Query(frame, pieces, seek.terrain, guesses, seek.past, due, around, outvoted=around is not None, firm=firm)
    then = partial(take, state, seek, frame, asked)
    graph.jobs.ask(SEARCH, partial(look, query, told), then, owner=seek)


def step_done(state: Owners) -> None:
    """Search the newest keyframe again when light has new windows, because the robot may be at rest.

    It also accepts a hypothesis when light has confirmed it since.
    """
    graph, frame = state.map.graph, state.map.keyframes.get(state.pose.anchor)
    if state.light is None:
        return
    if graph.parts.detached is None:
        doubt(state)
        return
    if frame is None or frame.key < graph.parts.detached_since:
        return
    seek = state.relocalisation.search
    if graph.jobs.busy(seek) or seek.hint is not None:
        return
    decide(state)
    if state.map.parts.detached is None or by_light_alone(state):
        return
    allowed = windows(state, frame)
    if allowed is None and not (seek.looks == 0 and state.motion.t_mono - seek.t_begin > PATIENCE_S):
        return
    asked = seek.lit == frame.key and not seek.elsewhere(allowed or ())
    stale = asked and seek.looks and not seek.alive and state.matching.scans_since_keyframe > STALE
    if stale or (allowed and state.matching.failures >= UNFIT):
        afresh(state)  # at rest without a match, or just put down: stored keyframes do not show its pose
    elif not asked:
        seek.searched = None
        look_for(state, frame, allowed)


def by_light_alone(state: Owners) -> bool:
    """End the search where light has long given the pose, in an area that the map does not know.

    Priors by light then connect both parts of the graph.
    """
    from estimator.relocalisation.light_evidence import told

    graph, seek, alignment, light = state.map.graph, state.relocalisation.search, state.pose.alignment, state.light
    good = light is not None and light.result.fix is Fix.GOOD
    if alignment is None or not good or alignment.gap is None or alignment.gap > SURPRISE:
        return False
    if not math.isfinite(seek.way_begin):
        seek.way_begin = alignment.way
    if (
        seek.alive
        or not seek.looks
        or alignment.way - seek.way_begin < ALONE_M
        or not told(state.light, state.map.graph)
    ):
        return False
    since = graph.parts.detached_since
    graph.parts.attach()
    graph.parts.bridge, state.relocalisation.search = None, Seek()
    relist(state.map, since)
    return True


def doubt(state: Owners) -> None:
    """Start relocalisation where light contradicts the pose: at once if scans do not match, else after a while.

    The lidar may go on matching in a room that looks alike. Then light must give one position, and not here. Where
    light once confirmed the pose, more is required. A received lamp must be impossible here. Or, where scans do not
    match or did not, single epochs must give another position. Odometry can bias the filter itself, and a tracked robot
    is not detached for that. A pose found before the filter agreed has no such confirmation: the robot may have been
    carried then.
    """
    from estimator.relocalisation import light_evidence

    alignment, light = state.pose.alignment, state.light
    assert alignment is not None
    assert light is not None
    if not light_evidence.disputed(state.light, state.map.graph):
        alignment.elsewhere_since, alignment.aside_since, alignment.unheard = None, None, False
        return
    if alignment.gap is not None and alignment.gap <= SURPRISE and not light_evidence.contradicted(light.filter):
        alignment.unheard = False  # the filter has a new position already, and that is here
    now = state.motion.t_mono
    alignment.elsewhere_since = now if alignment.elsewhere_since is None else alignment.elsewhere_since
    here = state.pose.here(state.motion.T_odom_base)
    unfit = state.matching.failures >= UNFIT
    aside = (unfit or alignment.broken) and light_evidence.glimpsed_elsewhere(state.light, here)
    alignment.aside_since = (now if alignment.aside_since is None else alignment.aside_since) if aside else None
    aside = alignment.aside_since is not None and (unfit or now - alignment.aside_since >= ASIDE_S)
    held = alignment.proved and not (alignment.unheard and unfit)
    if held and not aside and not light_evidence.out_of_place(state.light, here):
        return
    sure = now - alignment.elsewhere_since >= ELSEWHERE_S and light_evidence.elsewhere(
        state.light, state.map.graph, here
    )
    if (sure or unfit or aside) and afresh(state):
        alignment.elsewhere_since, alignment.aside_since, alignment.broken = None, None, True


def afresh(state: Owners, dead_reckoning: bool = False) -> bool:
    """Detach the map from the next scan on, with a new local map; ``dead_reckoning``: see :func:`begin`."""
    if not begin(state, dead_reckoning):
        return False
    state.matching.local_map, state.matching.failures = None, 0
    return True


def light_is_coming(state: Owners) -> bool:
    """Whether light may give windows within a moment, so that the whole map need not be searched."""
    seek = state.relocalisation.search
    if not math.isfinite(seek.t_begin):
        seek.t_begin = state.motion.t_mono
    if state.light is None or seek.looks or state.motion.t_mono - seek.t_begin > PATIENCE_S:
        return False
    from estimator.relocalisation import light_evidence

    return light_evidence.told(state.light, state.map.graph)


def windows(state: Owners, frame: Keyframe) -> tuple[Around, ...] | None:
    """Search windows of a keyframe by operator or light; everywhere if None."""
    hint = state.relocalisation.search.hint
    if hint is not None:
        T_map_lidar = se2.compose(se2.compose(hint[0], frame.T_odom_keyframe), frame.T_base_lidar)
        return (Around(T_map_lidar, HINT_M, HINT_RAD),)
    if state.light is None:
        return None
    from estimator.relocalisation import light_evidence  # costs nothing where there is no photodiode

    lever = math.hypot(*frame.T_base_lidar[:2].tolist())
    allowed = light_evidence.windows(
        state.light, state.map.graph, se2.between(state.motion.T_odom_base, frame.T_odom_keyframe)
    )
    return tuple(Around(np.array((one.x, one.y, 0.0)), one.reach_m + lever, math.pi) for one in allowed) or None


@job_function
def take_look(state: Owners, seek: Seek, frame: Keyframe, asked: tuple[Hypothesis, ...], payload: object) -> None:
    """Apply the result of a search, and accept a hypothesis if it is decided."""
    assert isinstance(payload, Looked)
    if state.relocalisation.search is not seek or state.map.parts.detached is None:
        return
    seek.take(frame, asked, payload)
    seek.pay(state.motion.t_mono, payload.work())
    if seek.hint is not None and not seek.alive:
        T_map_odom, looks = seek.hint
        seek.hint = (T_map_odom, looks + 1) if looks + 1 < HINT_LOOKS else None
    seek.alive = tuple(one for one in seek.alive if not ruled_out(state, one))
    decide(state)


def ruled_out(state: Owners, one: Hypothesis) -> bool:
    """Whether light excludes a hypothesis permanently, which a single epoch cannot."""
    if state.light is None or said(state, one) is not False:
        return False
    from estimator.relocalisation.light_evidence import contradicted

    return not contradicted(state.light.filter)


def decide(state: Owners) -> None:
    """Accept the certain hypothesis, if there is one."""
    seek = state.relocalisation.search
    one = seek.favourite()
    if one is not None:
        witnessed = said(state, one) is True
        if seek.sure(one, witnessed):
            land(state, one, not witnessed)
            return
    one = seek.recalled()
    if one is not None and said(state, one) is not False:
        land(state, one, said(state, one) is not True)


def said(state: Owners, one: Hypothesis) -> bool | None:
    """Whether operator or light confirms a hypothesis (True) or rejects it (False); None without information."""
    if state.relocalisation.search.hint is not None:
        return True  # the search covered no other region
    if state.light is None:
        return None
    from estimator.relocalisation import light_evidence

    T_map_base = se2.compose(one.T_map_odom, state.motion.T_odom_base)
    if light_evidence.witness(state.light, state.map.graph, T_map_base):
        return True
    return False if light_evidence.compatible(state.light, state.map.graph, T_map_base) is False else None

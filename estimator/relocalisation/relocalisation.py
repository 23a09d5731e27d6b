"""Where in the map the robot is, when that is not known: after the start in a stored map, or after it was carried off.

Until it is found the robot maps on as ever, in a part of the graph that nothing joins to the older one. Looks in the
older one (`global_scan_match`, jobs for the background) leave over some places (`hypothesis_tracking`); when one of
them is sure, a loop joins the two parts, ``T_map_odom`` takes the robot there at once, and ordinary loops take over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final

import numpy as np

from estimator.fusion.light_witness import blind, light_holds
from estimator.job_queue import SEARCH
from estimator.mapping import live_grid
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.mapping.map_frame import relist, unlist
from estimator.numerics import se2
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, look
from estimator.relocalisation.hypothesis_tracking import Hypothesis, SearchedAside, Seek
from estimator.relocalisation.landing import SURPRISE, land
from estimator.relocalisation.owners import Owners
from estimator.result import Fix
from estimator.scan_matching.branch_and_bound import Around

Take = Callable[[Owners, Seek, Keyframe, tuple[Hypothesis, ...], object], None]
"""Takes in what a look has found: for which search, at which keyframe, for which places it was asked."""

HINT_M, HINT_RAD = 1.0, 0.5
"""How far the robot may be from where a person has said that it is."""
HINT_LOOKS: Final = 4
"""Looks after which the map says that it is not there."""
PATIENCE_S: Final = 1.0
"""Light is waited for so long before the whole map is searched."""
ELSEWHERE_S, UNFIT = 3.0, 2
"""Light that has the robot elsewhere for so long is believed that it was carried off; and at once when so many scans in
a row did not fit."""
ASIDE_S: Final = 0.3
"""And so soon where the laser has lost the place since light last agreed, and epoch after epoch, each read by itself,
has the robot elsewhere: it may have been carried on while a new local map was begun."""
ALONE_M: Final = 5.0
"""Way after which light alone, if it is good and agrees, is believed where the map knows nothing of the place."""
STALE: Final = 5
"""Scans after which a keyframe that was found nowhere is laid anew, where light says that it must be here."""
YOUNG: Final = 2
"""Keyframes of a map in which a robot can be looked for."""


def begin(state: Owners) -> bool:
    """Say that the robot may be anywhere in the map; False where there is no map yet that it could be found in.

    A map of one submap that is not finished will do: the robot begins another one, and that one is finished then. So
    will one whose submaps are just being finished.
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
    state.relocalisation.search = Seek()
    aside = graph.parts.aside
    if isinstance(aside, SearchedAside):
        aside.search = Seek()
    return True


def leave_map(state: Owners) -> None:
    """Keep how surely the map lies in the survey, as of the latest match with it; zero where light has not told it."""
    alignment, memory = state.pose.alignment, state.relocalisation
    placed = alignment is not None and alignment.placed
    memory.T_left, memory.P_left = alignment.kept if alignment and placed else (se2.identity(), np.zeros((3, 3)))


def local_map_lost(state: Owners) -> None:
    """The local map is begun anew: the robot may have been carried off, unless light that tells now holds it here.

    Light that wheels have led away holds it too, as long as the lamps that are received are those of the place. One
    that is being relocalised already may have been carried on: what was looked for before says nothing of where it is
    now.
    """
    alignment = state.pose.alignment
    held = False
    if alignment is not None and light_holds(state.pose, state.motion, state.light) and alignment.gap is not None:
        from estimator.relocalisation.light_evidence import in_place

        here = state.pose.here(state.motion.T_odom_base)
        held = alignment.gap <= SURPRISE or (alignment.proved and in_place(state.light, here))
    if not held or state.map.parts.detached is not None:
        begin(state)


def forget_detached(state: Owners) -> None:
    """Let go of the keyframes of a part that has never been placed."""
    gone = [frame for key, frame in state.map.keyframes.items() if key >= state.map.parts.detached_since]
    for frame in gone:
        del state.map.keyframes[frame.key]
        if state.map.settings.history:
            state.map.retired[frame.key] = frame.submap, se2.between(frame.submap.T_odom_submap, frame.T_odom_keyframe)
    unlist(state.map, state.map.parts.detached_since)


def disown(state: Owners, first: int, since: int) -> None:
    """The place was the wrong one: what was mapped since lies in it, and is what the next `begin` lets go of.

    Else the robot would find itself again in what it has laid there. ``first``: key of the first submap of that,
    ``since``: ID of its first keyframe.
    """
    if state.map.parts.detached is None:
        leave_map(state)
    state.map.parts.detached, state.map.parts.detached_since, state.map.graph.stale = first, since, True
    live_grid.forget(state.map.live, state.map.graph, first)


def places(state: Owners) -> int | None:
    """How many places fit, None where the place is known (see `StepResult.places`); light alone may know it too."""
    if state.map.parts.detached is None:
        return None
    lit = light_holds(state.pose, state.motion, state.light) and blind(state.pose, state.motion)
    if lit:
        from estimator.relocalisation.light_evidence import disputed  # costs nothing where there is no photodiode

        lit = not disputed(state.light, state.map.graph)
    return None if lit else len(state.relocalisation.search.alive)


def hinted(state: Owners) -> None:
    """A person has just said where the robot is: it is looked for there first."""
    state.relocalisation.search = Seek(terrain=state.relocalisation.search.terrain, hint=(state.pose.T_map_odom, 0))


def keyframe_laid(state: Owners, frame: Keyframe) -> None:
    """Look for a new keyframe, if the robot is being relocalised and no other look is under way."""
    graph, told = state.map.graph, state.map.settings.loops
    if graph.parts.detached is None or told is None or graph.jobs.busy(state.relocalisation.search):
        return
    around = windows(state, frame)
    if around is None and light_is_coming(state):
        return
    look_for(state, frame, around)


def look_for(state: Owners, frame: Keyframe, around: tuple[Around, ...] | None) -> None:
    """Hand out a look for a keyframe in what is not detached."""
    hand_out(state, state.relocalisation.search, frame, state.map.graph.settled(), around, take_look)


def hand_out(
    state: Owners, seek: Seek, frame: Keyframe, among: Iterable[Submap], around: tuple[Around, ...] | None, take: Take
) -> None:
    """Hand out a look for a keyframe among submaps."""
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
    """Look again at the newest keyframe when light has come to say where it is, or says otherwise: robots may stand.

    And decide, when light has become a witness since.
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
        afresh(state)  # it stands and was not found, or was just put down: what was kept says nothing of where it is
    elif not asked:
        seek.searched = None
        look_for(state, frame, allowed)


def by_light_alone(state: Owners) -> bool:
    """End the search where light has long told the place, in a part of the building that the map does not know.

    Both parts of the graph then hang on what light has said of them.
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
    """Say that the robot was carried off where light says so: at once if scans fit no more, else after a while.

    The laser may go on fitting, in a room that looks alike; then light must have it in one place, and not here. Where
    light once proved the place, it must also receive a lamp that cannot be received here, or, where scans do not fit or
    did not, epochs read by themselves must have the robot elsewhere: the filter itself can be led astray by wheels, and
    a robot that the laser holds is not detached for that. A place that was found before the filter agreed is no such
    proof: it may have been found in somebody's hands.
    """
    from estimator.relocalisation import light_evidence

    alignment, light = state.pose.alignment, state.light
    assert alignment is not None
    assert light is not None
    if not light_evidence.disputed(state.light, state.map.graph):
        alignment.elsewhere_since, alignment.aside_since, alignment.unheard = None, None, False
        return
    if alignment.gap is not None and alignment.gap <= SURPRISE and not light_evidence.contradicted(light.filter):
        alignment.unheard = False  # the filter is at a new place already, and that is here
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


def afresh(state: Owners) -> bool:
    """Detach the map from the next scan on, with a new local map."""
    if not begin(state):
        return False
    state.matching.local_map, state.matching.failures = None, 0
    return True


def light_is_coming(state: Owners) -> bool:
    """Whether light may tell within a moment, so that the whole map need not be searched: it has just come on."""
    seek = state.relocalisation.search
    if not math.isfinite(seek.t_begin):
        seek.t_begin = state.motion.t_mono
    if state.light is None or seek.looks or state.motion.t_mono - seek.t_begin > PATIENCE_S:
        return False
    from estimator.relocalisation import light_evidence

    return light_evidence.told(state.light, state.map.graph)


def windows(state: Owners, frame: Keyframe) -> tuple[Around, ...] | None:
    """Where a keyframe is to be searched for, by what a person or light says; everywhere if None."""
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


def take_look(state: Owners, seek: Seek, frame: Keyframe, asked: tuple[Hypothesis, ...], payload: object) -> None:
    """Take in what a look has found; and the decision, if it is one."""
    assert isinstance(payload, Looked)
    if state.relocalisation.search is not seek or state.map.parts.detached is None:
        return
    seek.take(frame, asked, payload)
    if seek.hint is not None and not seek.alive:
        T_map_odom, looks = seek.hint
        seek.hint = (T_map_odom, looks + 1) if looks + 1 < HINT_LOOKS else None
    seek.alive = tuple(one for one in seek.alive if not ruled_out(state, one))
    decide(state)


def ruled_out(state: Owners, one: Hypothesis) -> bool:
    """Whether light has no hypothesis there; for good, which one epoch by itself cannot say."""
    if state.light is None or said(state, one) is not False:
        return False
    from estimator.relocalisation.light_evidence import contradicted

    return not contradicted(state.light.filter)


def decide(state: Owners) -> None:
    """Take the robot to the place that is sure, if one is."""
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
    """Whether a person or light says that this is the place (True) or that it is not; None where neither can tell."""
    if state.relocalisation.search.hint is not None:
        return True  # it was looked for nowhere else
    if state.light is None:
        return None
    from estimator.relocalisation import light_evidence

    T_map_base = se2.compose(one.T_map_odom, state.motion.T_odom_base)
    if light_evidence.witness(state.light, state.map.graph, T_map_base):
        return True
    return False if light_evidence.compatible(state.light, state.map.graph, T_map_base) is False else None

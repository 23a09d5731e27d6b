"""Where in the map the robot is, when that is not known: after the start in a stored map, or after it was carried off.

Until it is found the robot maps on as ever, in a part of the graph that nothing joins to the older one. Looks in the
older one (`relocate`, jobs for the background) leave over some places (`hypotheses`); when one of them is sure, a loop
joins the two parts, ``T_map_odom`` takes the robot there at once, and ordinary loops take over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.mapping import live_grid
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.mapping.loop_closure import join
from estimator.mapping.loop_verification import Found
from estimator.mapping.map_alignment_covariance import askew_at
from estimator.mapping.map_frame import move_map, rehang, shift_map, unlist
from estimator.mapping.submap_graph import LOOK, Atlas
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation.global_scan_match import Looked, Piece, Query, look
from estimator.relocalisation.hypothesis_tracking import WATCH_M, Hypothesis, Seek, Watch
from estimator.result import Fix, LoopReason
from estimator.scan_matching.branch_and_bound import Around
from estimator.state import State

Take = Callable[[State, Seek, Keyframe, tuple[Hypothesis, ...], object], None]
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
SURPRISE: Final = 16.3
"""Squared Mahalanobis distance beyond which the way driven blindly is not the one that was found."""


def begin(state: State) -> bool:
    """Say that the robot may be anywhere in the map; False where there is no map yet that it could be found in.

    A map of one submap that is not finished will do: the robot begins another one, and that one is finished then. So
    will one whose submaps are just being finished.
    """
    atlas = state.atlas
    young = atlas.adrift is None and (len(atlas.frames) >= YOUNG or len(atlas.submaps) > 1)
    if state.settings.loops is None or not (young or atlas.settled()):
        return False
    if atlas.adrift is not None:
        forget_adrift(state)
    else:
        leave_map(state)
    state.suspicion.end()
    state.suspicion.leap.forget()
    atlas.cut(state.next_key)
    atlas.seek = Seek()
    if atlas.aside is not None:
        atlas.aside.seek = Seek()
    return True


def leave_map(state: State) -> None:
    """Keep how surely the map lies in the survey, as of the latest match with it; zero where light has not told it."""
    tie, atlas = state.absolute, state.atlas
    atlas.T_askew, atlas.askew = (se2.identity(), np.zeros((3, 3))) if tie is None or not tie.placed else tie.kept


def local_map_lost(state: State) -> None:
    """The local map is begun anew: the robot may have been carried off, unless light that tells now holds it here.

    Light that wheels have led away holds it too, as long as the lamps that are received are those of the place. One
    that is adrift already may have been carried on: what was looked for before says nothing of where it is now.
    """
    tie = state.absolute
    held = False
    if tie is not None and map_odom_filter.tells(state) and tie.gap is not None:
        from estimator.relocalisation.light_evidence import in_place

        here = se2.compose(state.T_map_odom, state.fused.T_odom_base)
        held = tie.gap <= SURPRISE or (tie.proved and in_place(state, here))
    if not held or state.atlas.adrift is not None:
        begin(state)


def forget_adrift(state: State) -> None:
    """Let go of the keyframes of a part that has never been placed."""
    gone = [frame for key, frame in state.keyframes.items() if key >= state.atlas.since]
    for frame in gone:
        del state.keyframes[frame.key]
        if state.settings.history:
            state.retired[frame.key] = frame.submap, se2.between(frame.submap.T_odom_submap, frame.T_odom_keyframe)
    unlist(state, state.atlas.since)


def disown(state: State, first: int, since: int) -> None:
    """The place was the wrong one: what was mapped since lies in it, and is what the next `begin` lets go of.

    Else the robot would find itself again in what it has laid there. ``first``: key of the first submap of that,
    ``since``: ID of its first keyframe.
    """
    if state.atlas.adrift is None:
        leave_map(state)
    state.atlas.adrift, state.atlas.since, state.atlas.stale = first, since, True
    live_grid.forget(state, first)


def places(state: State) -> int | None:
    """How many places fit, None where the place is known (see `StepResult.places`); light alone may know it too."""
    if state.atlas.adrift is None:
        return None
    lit = map_odom_filter.tells(state) and map_odom_filter.blind(state)
    if lit:
        from estimator.relocalisation.light_evidence import disputed  # costs nothing where there is no photodiode

        lit = not disputed(state)
    return None if lit else len(state.atlas.seek.alive)


def hinted(state: State) -> None:
    """A person has just said where the robot is: it is looked for there first."""
    state.atlas.seek = Seek(terrain=state.atlas.seek.terrain, hint=(state.T_map_odom, 0))


def keyframe_laid(state: State, frame: Keyframe) -> None:
    """Look for a new keyframe, if the robot is adrift and no other look is under way."""
    atlas, told = state.atlas, state.settings.loops
    if atlas.adrift is None or told is None or atlas.seek.job in atlas.asked:
        return
    around = windows(state, frame)
    if around is None and light_is_coming(state):
        return
    look_for(state, frame, around)


def look_for(state: State, frame: Keyframe, around: tuple[Around, ...] | None) -> None:
    """Hand out a look for a keyframe in what is not adrift."""
    hand_out(state, state.atlas.seek, frame, state.atlas.settled(), around, take_look)


def hand_out(
    state: State, seek: Seek, frame: Keyframe, among: Iterable[Submap], around: tuple[Around, ...] | None, take: Take
) -> None:
    """Hand out a look for a keyframe among submaps."""
    atlas, told = state.atlas, state.settings.loops
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
    seek.job = atlas.ask(LOOK, partial(look, query, told), then)


def step_done(state: State) -> None:
    """Look again at the newest keyframe when light has come to say where it is, or says otherwise: robots may stand.

    And decide, when light has become a witness since.
    """
    atlas, frame = state.atlas, state.keyframes.get(state.anchor)
    if state.light is None:
        return
    if atlas.adrift is None:
        doubt(state)
        return
    if frame is None or frame.key < atlas.since:
        return
    seek = atlas.seek
    if seek.job in atlas.asked or seek.hint is not None:
        return
    decide(state)
    if state.atlas.adrift is None or by_light_alone(state):
        return
    allowed = windows(state, frame)
    if allowed is None and not (seek.looks == 0 and state.fused.t_mono - seek.t_begin > PATIENCE_S):
        return
    asked = seek.lit == frame.key and not seek.elsewhere(allowed or ())
    stale = asked and seek.looks and not seek.alive and state.since_keyframe > STALE
    if stale or (allowed and state.failures >= UNFIT):
        afresh(state)  # it stands and was not found, or was just put down: what was kept says nothing of where it is
    elif not asked:
        seek.searched = None
        look_for(state, frame, allowed)


def by_light_alone(state: State) -> bool:
    """End being adrift where light has long told the place, in a part of the building that the map does not know.

    Both parts of the graph then hang on what light has said of them.
    """
    from estimator.relocalisation.light_evidence import told

    atlas, seek, tie, light = state.atlas, state.atlas.seek, state.absolute, state.light
    if tie is None or light is None or light.result.fix is not Fix.GOOD or tie.gap is None or tie.gap > SURPRISE:
        return False
    if not math.isfinite(seek.way_begin):
        seek.way_begin = tie.way
    if seek.alive or not seek.looks or tie.way - seek.way_begin < ALONE_M or not told(state):
        return False
    since = atlas.since
    atlas.adrift, atlas.since, atlas.bridge, atlas.seek = None, 0, None, Seek()
    rehang(state, since)
    return True


def doubt(state: State) -> None:
    """Say that the robot was carried off where light says so: at once if scans fit no more, else after a while.

    The laser may go on fitting, in a room that looks alike; then light must have it in one place, and not here. Where
    light once proved the place, it must also receive a lamp that cannot be received here, or, where scans do not fit or
    did not, epochs read by themselves must have the robot elsewhere: the filter itself can be led astray by wheels, and
    a robot that the laser holds is not set adrift for that. A place that was found before the filter agreed is no such
    proof: it may have been found in somebody's hands.
    """
    from estimator.relocalisation import light_evidence

    tie, light = state.absolute, state.light
    assert tie is not None
    assert light is not None
    if not light_evidence.disputed(state):
        tie.elsewhere_since, tie.aside_since, tie.unheard = None, None, False
        return
    if tie.gap is not None and tie.gap <= SURPRISE and not light_evidence.contradicted(light.filter):
        tie.unheard = False  # the filter is at a new place already, and that is here
    now = state.fused.t_mono
    tie.elsewhere_since = now if tie.elsewhere_since is None else tie.elsewhere_since
    here = se2.compose(state.T_map_odom, state.fused.T_odom_base)
    unfit = state.failures >= UNFIT
    aside = (unfit or tie.broken) and light_evidence.glimpsed_elsewhere(state, here)
    tie.aside_since = (now if tie.aside_since is None else tie.aside_since) if aside else None
    aside = tie.aside_since is not None and (unfit or now - tie.aside_since >= ASIDE_S)
    held = tie.proved and not (tie.unheard and unfit)
    if held and not aside and not light_evidence.out_of_place(state, here):
        return
    sure = now - tie.elsewhere_since >= ELSEWHERE_S and light_evidence.elsewhere(state, here)
    if (sure or unfit or aside) and afresh(state):
        tie.elsewhere_since, tie.aside_since, tie.broken = None, None, True


def afresh(state: State) -> bool:
    """Be adrift from the next scan on, with a new local map."""
    if not begin(state):
        return False
    state.local, state.failures = None, 0
    return True


def light_is_coming(state: State) -> bool:
    """Whether light may tell within a moment, so that the whole map need not be searched: it has just come on."""
    seek = state.atlas.seek
    if not math.isfinite(seek.t_begin):
        seek.t_begin = state.fused.t_mono
    if state.light is None or seek.looks or state.fused.t_mono - seek.t_begin > PATIENCE_S:
        return False
    from estimator.relocalisation import light_evidence

    return light_evidence.told(state)


def windows(state: State, frame: Keyframe) -> tuple[Around, ...] | None:
    """Where a keyframe is to be searched for, by what a person or light says; everywhere if None."""
    hint = state.atlas.seek.hint
    if hint is not None:
        T_map_lidar = se2.compose(se2.compose(hint[0], frame.T_odom_keyframe), frame.T_base_lidar)
        return (Around(T_map_lidar, HINT_M, HINT_RAD),)
    if state.light is None:
        return None
    from estimator.relocalisation import light_evidence  # costs nothing where there is no photodiode

    lever = math.hypot(*frame.T_base_lidar[:2].tolist())
    allowed = light_evidence.windows(state, se2.between(state.fused.T_odom_base, frame.T_odom_keyframe))
    return tuple(Around(np.array((one.x, one.y, 0.0)), one.reach_m + lever, math.pi) for one in allowed) or None


def take_look(state: State, seek: Seek, frame: Keyframe, asked: tuple[Hypothesis, ...], payload: object) -> None:
    """Take in what a look has found; and the decision, if it is one."""
    assert isinstance(payload, Looked)
    if state.atlas.seek is not seek or state.atlas.adrift is None:
        return
    seek.take(frame, asked, payload)
    if seek.hint is not None and not seek.alive:
        T_map_odom, looks = seek.hint
        seek.hint = (T_map_odom, looks + 1) if looks + 1 < HINT_LOOKS else None
    seek.alive = tuple(one for one in seek.alive if not ruled_out(state, one))
    decide(state)


def ruled_out(state: State, one: Hypothesis) -> bool:
    """Whether light has no hypothesis there; for good, which one epoch by itself cannot say."""
    if state.light is None or said(state, one) is not False:
        return False
    from estimator.relocalisation.light_evidence import contradicted

    return not contradicted(state.light.filter)


def decide(state: State) -> None:
    """Take the robot to the place that is sure, if one is."""
    seek = state.atlas.seek
    one = seek.favourite()
    if one is not None:
        witnessed = said(state, one) is True
        if seek.sure(one, witnessed):
            land(state, one, not witnessed)
            return
    one = seek.recalled()
    if one is not None and said(state, one) is not False:
        land(state, one, said(state, one) is not True)


def said(state: State, one: Hypothesis) -> bool | None:
    """Whether a person or light says that this is the place (True) or that it is not; None where neither can tell."""
    if state.atlas.seek.hint is not None:
        return True  # it was looked for nowhere else
    if state.light is None:
        return None
    from estimator.relocalisation import light_evidence

    T_map_base = se2.compose(one.T_map_odom, state.fused.T_odom_base)
    if light_evidence.witness(state, T_map_base):
        return True
    return False if light_evidence.compatible(state, T_map_base) is False else None


def land(state: State, one: Hypothesis, alone: bool) -> None:
    """The place is known: join what was mapped adrift to the older map, and take the robot there.

    A map in a frame of its own is taken to the robot instead, if light has told where that is. ``alone``: by the laser
    alone.
    """
    atlas, (frame, fit) = state.atlas, one.held[-1]
    found = [(at, it) for at, it in (one.held[0], one.held[-1]) if at.submap.key in atlas.submaps]
    if fit.key not in atlas.submaps or not found:
        return
    T_map_keyframe = se2.compose(atlas.submaps[fit.key].T_map_submap, fit.T_submap_keyframe)
    T_map_odom = se2.compose(T_map_keyframe, se2.inverse(frame.T_odom_keyframe))
    moved = se2.compose(T_map_odom, se2.inverse(state.T_map_odom))
    stays = atlas.foreign and state.absolute is not None and state.absolute.placed
    since, first, was = atlas.since, atlas.adrift, state.T_map_odom
    shift_map(state, moved, since)
    if stays:
        state.T_map_odom = T_map_odom  # for the moment: it is no jump
    else:
        move_map(state, T_map_odom)
    if first is not None:
        watch = Watch(first, atlas.way_m + WATCH_M, atlas.seek.terrain, since=since, alone=alone)
        atlas.watch = replace(watch, foreign_m=atlas.way_m if atlas.foreign else None)
    atlas.adrift, atlas.since, atlas.seek = None, 0, Seek()
    for at, it in found[: 1 if one.held[0] is one.held[-1] else 2]:
        if it.key in atlas.submaps:
            R = se2.rotation(-atlas.submaps[it.key].T_map_submap[2])
            P = R @ it.P @ R.T
            close = Found(it.key, it.T_submap_keyframe, P, it.share, it.against, it.residual_m, np.zeros(3))
            join(atlas, at, replace(close, reason=LoopReason.PLACED))
    bridge(atlas, first)
    resettle(state, frame, fit.P, first)
    if stays:
        shift_map(state, se2.inverse(moved), 0)
        state.T_map_odom = was
    rehang(state, 0 if stays else since)


def bridge(atlas: Atlas, first: int | None) -> None:
    """The way driven across the break counts as one that may be false, where what was found agrees with it."""
    told, atlas.bridge = atlas.bridge, None
    if told is None or first not in atlas.submaps or told[0] not in atlas.submaps:
        return
    key, T, P = told
    before, after = atlas.submaps[key], atlas.submaps[first]
    off = se2.between(T, se2.between(before.T_map_submap, after.T_map_submap))
    if float(off @ invert3(P) @ off) < SURPRISE:
        atlas.constraints.add(key, after.key, T, P, True)


def resettle(state: State, frame: Keyframe, P_map: Array, first: int | None) -> None:
    """How sure the pose is now: by the match that has decided, the way since, and the map it was found in.

    ``first``: key of the first submap that is no part of that map.
    """
    atlas = state.atlas
    newest = atlas.newest
    assert newest is not None
    T_keyframe_newest = se2.between(frame.T_odom_keyframe, newest.T_odom_submap)
    R = se2.rotation(-state.T_map_odom[2])
    P = se2.carry(frame.T_map_keyframe, T_keyframe_newest, P_map)
    atlas.marginal = R @ P @ R.T
    state.P_anchor = atlas.spread(state.T_odom_anchor)
    tie = state.absolute
    if tie is None:
        return
    from estimator.relocalisation.light_evidence import disputed, told

    if atlas.foreign:  # map and robot are one again: light takes both to where they are, as after a first start
        tie.since, atlas.foreign = 0, False
    elif tie.placed or told(state):  # the map's frame is the survey's
        map_odom_filter.hang_on_anchor(state)
        askew = askew_at(atlas, se2.compose(state.T_map_odom, state.fused.T_odom_base), first)
        tie.P = tie.P + R @ askew @ R.T  # no surer in the survey's frame than the map is
        tie.placed, tie.proved, tie.broken = True, True, False
        tie.gap, tie.odd_since, tie.since = None, None, state.next_key
        map_odom_filter.told_anew(tie, True)
        tie.way_start = -math.inf if state.light is None else state.light.filter.way_start
        tie.unheard, tie.t_match = disputed(state), state.fused.t_mono  # the laser has just told the place

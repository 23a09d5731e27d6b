"""Windows that light gives for looking in a stored map, and when it counts as a witness."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimator.light_filter.initialisation import rule_out
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.keyframe import Settled, Submap
from estimator.measurements import UNLIMITED, Array, LightEpoch, Odometry
from estimator.numerics import se2
from estimator.pipeline import new_state, step
from estimator.relocalisation import relocalisation
from estimator.relocalisation.hypothesis_tracking import Hypothesis
from estimator.relocalisation.light_evidence import (
    AGAINST,
    HEADED_M,
    Window,
    compatible,
    disputed,
    elsewhere,
    glimpsed,
    misplaced,
    out_of_place,
    told,
    windows,
    witness,
)
from estimator.result import Fix, LinkState
from estimator.state import State
from tools.experiments.relocation.worlds import Site, Stroll, lit_house
from tools.sim.ceiling.ceiling import Effects

pytestmark = pytest.mark.jit

HERE = np.array((4.0, 10.9, 0.7))
CORRIDOR = np.array((15.0, 7.6, 0.3))
MILD = Effects(gain_spread=0.02, bounces=0, obstacles=False, people=False, sway=False)


@cache
def site(reused: bool = False) -> Site:
    return Site(lit_house(reused=reused), MILD, 1)


@cache
def walled() -> Site:
    """Where walls hide the lamps of other rooms."""
    return Site(lit_house(), Effects(gain_spread=0.02), 1)


@cache
def light(at: tuple[float, float, float], reused: bool = False, walls: bool = False) -> tuple[LightEpoch, ...]:
    """Epochs of a robot at rest, without what lamps say of themselves."""
    way, place = Stroll(np.array(at), 0.0, 0.0), walled() if walls else site(reused)
    return tuple(replace(one, lamps=(None,) * len(one.ids)) for one in place.light(way.at, (0.0, 0.6), 1))


def robot(reused: bool = False, surveyed: bool = True, walls: bool = False) -> State:
    """Switched on with a map whose frame is the survey's."""
    state = new_state(lights=LightsSetup((walled() if walls else site(reused)).survey, clock_ppm=0.0))
    settled = Settled(np.zeros((0, 8), np.float32), None, 0.01)  # type: ignore[arg-type]  # nobody looks at it here
    placed = (np.zeros(3), np.eye(3)) if surveyed else None
    state.map.graph.submaps[1] = Submap(1, 1, np.zeros(3), np.zeros(3), settled=settled, light=placed)
    state.map.parts.detached, state.map.parts.detached_since = 2, 2
    return state


def shown(state: State, at: Array = HERE, reused: bool = False, walls: bool = False, begin: float = 0.0) -> State:
    x, y, yaw = at.tolist()
    for one in light((x, y, yaw), reused, walls):
        epoch = replace(one, t_begin=begin + one.t_begin, t_end=begin + one.t_end)
        step(state, [Odometry(epoch.t_begin, epoch.t_end, np.zeros(3)), epoch], UNLIMITED)
    return state


def inside(window: Window, at: Array) -> bool:
    return math.hypot(window.x - at[0], window.y - at[1]) < window.reach_m


def test_light_gives_one_small_window_that_holds_the_place_at_any_heading() -> None:
    state = shown(robot())
    (window,) = windows(state.light, state.map.graph)
    assert inside(window, HERE)
    assert window.reach_m < 1.0
    assert window.chance == pytest.approx(1.0, abs=1e-3)


def test_what_fits_is_compatible_and_what_lies_elsewhere_is_not() -> None:
    state = shown(robot())
    for turn in (0.0, 1.5, 3.0):
        assert compatible(state.light, state.map.graph, HERE + np.array((0.05, -0.05, turn))) is True
    assert compatible(state.light, state.map.graph, HERE + np.array((3.0, 0.0, 0.0))) is False
    assert witness(state.light, state.map.graph, HERE)
    assert not witness(state.light, state.map.graph, HERE + np.array((3.0, 0.0, 0.0)))


def test_a_heading_from_light_rules_a_place_out_only_after_some_way() -> None:
    """Young hypotheses of it go astray together: a robot that the laser had found stood RELOCATING for that."""
    state = shown(robot())
    lights = state.light.filter  # type: ignore[union-attr]
    lights.tracks = lights.tracks[:1]
    lights.tracks[0].x[:3] = HERE
    lights.tracks[0].P[:3, :3] = np.diag((0.01, 0.01, 0.001))
    for way, told_apart in ((0.5, False), (HEADED_M + 0.5, True)):
        lights.course.way = lights.way_start + way
        assert compatible(state.light, state.map.graph, HERE) is True
        assert compatible(state.light, state.map.graph, HERE + np.array((0.0, 0.0, 1.5))) is not told_apart
        assert compatible(state.light, state.map.graph, HERE + np.array((3.0, 0.0, 0.0))) is False


def test_before_the_first_epoch_and_in_another_frame_light_says_nothing() -> None:
    dark, foreign = robot(), shown(robot(surveyed=False))
    for state in (dark, foreign):
        assert windows(state.light, state.map.graph) == ()
        assert compatible(state.light, state.map.graph, HERE) is None
        assert not witness(state.light, state.map.graph, HERE)
    assert not told(foreign.light, foreign.map.graph)
    assert not told(None, new_state().map.graph)


def test_codes_that_repeat_give_a_window_for_each_place_and_no_witness() -> None:
    """Rooms 0 and 2 to the south send the same codes in the same pattern."""
    at, twin = np.array((2.2, 3.0, 0.4)), np.array((14.2, 3.0, 0.4))
    state = shown(robot(reused=True), at, reused=True)
    found = windows(state.light, state.map.graph)
    assert len(found) == 2
    assert {inside(found[0], at), inside(found[1], at)} == {True, False}
    assert all(inside(window, at) or inside(window, twin) for window in found)
    assert compatible(state.light, state.map.graph, at) is True
    assert not witness(state.light, state.map.graph, at)


def test_a_robot_carried_off_is_looked_for_where_the_latest_light_came_from() -> None:
    """The `lights` filter itself takes two seconds to give its place up."""
    state = shown(robot())
    state.light.filter.tracks = state.light.filter.tracks[:1]  # type: ignore[union-attr]  # as after some way
    state.light.filter.t_odd = 0.5  # type: ignore[union-attr]
    (window,) = windows(state.light, state.map.graph)
    assert inside(window, HERE)
    assert compatible(state.light, state.map.graph, HERE) is True
    assert witness(state.light, state.map.graph, HERE)
    assert not witness(state.light, state.map.graph, HERE + np.array((3.0, 0.0, 0.0)))


def test_on_which_side_of_a_row_of_lamps_a_robot_stands_is_left_to_the_laser() -> None:
    """In a corridor an epoch by itself fits on both sides; where the lamps are the same it is one part of the house."""
    state, at = shown(robot(walls=True), HERE, walls=True), np.array((5.96, 7.25, 0.3))
    state.light.filter.tracks = state.light.filter.tracks[:1]  # type: ignore[union-attr]  # as after some way
    shown(state, at, walls=True, begin=0.6)
    assert len(windows(state.light, state.map.graph)) > 1
    assert any(inside(window, at) for window in windows(state.light, state.map.graph))
    assert witness(state.light, state.map.graph, at)
    assert not witness(state.light, state.map.graph, at + np.array((3.0, 0.0, 0.0)))


@pytest.mark.parametrize(("rims", "kept"), [(0.7, True), (4.8, False)])
def test_one_link_more_that_does_not_fit_rules_no_place_out_unless_its_lamp_is_too_strong_there(
    rims: float, kept: bool
) -> None:
    """What a wall reflects is as strong as what comes straight at times: in one epoch, and not in the next."""
    at = np.array((2.2, 3.0, 0.4))
    state = shown(robot(reused=True), at, reused=True)
    light = state.light
    assert light is not None
    assert light.epoch is not None
    assert len(glimpsed(light)) == 2
    code = 12  # of a lamp beside each of the two rooms; the one beside the other room was learned as far brighter
    beside, bright = sorted(light.filter.catalogue.candidates(code), key=lambda lamp: lamp.x)
    light.filter.gains[bright.lamp_id] = np.array((math.log(20.0), 0.0, 0.0)), np.full(3, 0.01)
    more = replace(
        light.epoch,
        ids=np.append(light.epoch.ids, code),
        amplitude=np.append(light.epoch.amplitude, rims * light.filter.catalogue.rims[beside.lamp_id]),
        variance=np.append(light.epoch.variance, light.epoch.variance[0]),
        flags=np.append(light.epoch.flags, 0),
        lamps=(*light.epoch.lamps, None),
    )
    light.epoch = more
    assert any(math.hypot(*(np.array((one.x, one.y)) - at[:2])) < 1.0 for one in glimpsed(light)) == kept


def test_one_epoch_by_itself_rules_no_place_out_for_good() -> None:
    """Of two rooms it may have the one of which it lacks a lamp less."""
    for contradiction in (math.inf, 0.5):
        state = shown(robot())
        lights = state.light.filter  # type: ignore[union-attr]
        lights.tracks, lights.t_odd = lights.tracks[:1], contradiction
        there = Hypothesis(HERE + np.array((5.0, 0.0, 0.0)))
        assert compatible(state.light, state.map.graph, there.T_map_odom) is False
        assert relocalisation.ruled_out(state, there) == math.isinf(contradiction)
        assert not relocalisation.ruled_out(state, Hypothesis(HERE))


def test_lamps_behind_walls_are_no_witness_against_a_place() -> None:
    """Of the walls the survey knows nothing: at rest in a corridor nothing would ever be sure."""
    state, at = shown(robot(walls=True), CORRIDOR, walls=True), CORRIDOR
    links = state.light.result.links  # type: ignore[union-attr]
    used, against = sum(link.state is LinkState.ACCEPTED for link in links), sum(link.against for link in links)
    assert against > AGAINST * (used + against)
    assert witness(state.light, state.map.graph, at)


def test_a_robot_found_in_somebody_s_hands_is_looked_for_again_when_it_is_put_down() -> None:
    """It was carried on for a moment, by less than a lamp's light would tell; the filter is still at its old place."""
    for unheard in (True, False):
        state = shown(robot())
        state.map.parts.detached, state.map.parts.detached_since, state.matching.failures = (
            None,
            0,
            relocalisation.UNFIT,
        )
        state.pose.T_map_odom = se2.compose(HERE + np.array((0.2, 0.0, 0.0)), se2.inverse(state.motion.T_odom_base))
        tie, lights = state.pose.alignment, state.light.filter  # type: ignore[union-attr]
        tie.placed, tie.proved, tie.unheard, lights.lost = True, True, unheard, True  # type: ignore[union-attr]
        tie.gap = None  # type: ignore[union-attr]
        relocalisation.doubt(state)
        assert (state.map.parts.detached is not None) == unheard
    state.map.parts.detached = None
    for lost, gap, agree in ((False, None, True), (True, 1.0, True), (True, 1e3, False), (True, None, False)):
        lights.lost, tie.gap, tie.unheard, state.matching.failures = lost, gap, True, 0  # type: ignore[union-attr]
        relocalisation.doubt(state)
        assert tie.unheard != agree  # type: ignore[union-attr]


@pytest.mark.parametrize(("since_s", "lost", "known"), [(0.0, False, True), (1.0, False, False), (0.0, True, False)])
def test_light_alone_knows_the_place_only_while_it_tells(since_s: float, lost: bool, known: bool) -> None:
    """A robot that was just put down is where the filter last had it for nobody but the filter."""
    state = shown(robot())
    assert state.pose.alignment is not None
    assert state.light is not None
    state.pose.alignment.placed, state.light.filter.lost = True, lost
    state.pose.alignment.t_match = state.motion.t_mono - 5.0
    state.light.filter.t_used = state.motion.t_mono - since_s
    assert (relocalisation.places(state) is None) == known


def test_a_robot_that_light_has_elsewhere_is_adrift_after_a_while_and_at_once_when_scans_do_not_fit() -> None:
    """As in a room that looks alike: the laser would go on fitting for ever."""
    for failures, patience in ((0, True), (2, False)):
        state = shown(robot())
        state.light.filter.lost = True  # type: ignore[union-attr]  # it has had to look for a new place
        state.pose.T_map_odom, state.matching.failures = HERE + np.array((5.0, 0.0, 0.0)), failures
        state.map.parts.detached, state.map.parts.detached_since = None, 0
        assert disputed(state.light, state.map.graph)
        assert elsewhere(state.light, state.map.graph, state.pose.T_map_odom)
        assert not elsewhere(state.light, state.map.graph, HERE)
        relocalisation.step_done(state)
        assert (state.map.parts.detached is None) == patience
        if patience:
            state.pose.alignment.elsewhere_since -= 3.1  # type: ignore[union-attr, operator]  # a while later
        relocalisation.step_done(state)
        assert state.map.parts.detached == 2


def test_light_that_has_gone_says_nothing() -> None:
    state = shown(robot())
    step(state, [Odometry(0.6, 1.5, np.zeros(3))], UNLIMITED)
    assert windows(state.light, state.map.graph) == ()


def test_a_lamp_that_says_which_one_it_is_rules_out_the_other_room_at_rest() -> None:
    at = np.array((2.2, 3.0, 0.4))
    state = shown(robot(reused=True), at, reused=True)
    assert len(windows(state.light, state.map.graph)) == 2
    way = Stroll(at, 0.0, 0.0)
    told_by_itself = [one for one in site(True).light(way.at, (0.0, 3.6), 1) if any(one.lamps)]
    for epoch in told_by_itself[:3]:
        moved = [Odometry(0.6, epoch.t_end, np.zeros(3))] if epoch is told_by_itself[0] else []
        step(state, [*moved, epoch], UNLIMITED)
    (window,) = windows(state.light, state.map.graph)
    assert inside(window, at)


def test_lamps_that_say_which_they_are_end_a_start_in_the_wrong_room() -> None:
    """Only the twin had been thought of; two lamps out of its sight are enough, one may have been moved."""
    at = np.array((2.2, 3.0, 0.4))
    state = shown(robot(reused=True), at, reused=True)
    lights = state.light.filter  # type: ignore[union-attr]
    lights.tracks = [track for track in lights.tracks if track.x[0] > 10.0]
    assert len(lights.tracks) > 1
    way = Stroll(at, 0.0, 0.0)
    epoch = next(one for one in site(True).light(way.at, (0.0, 3.6), 1) if sum(map(bool, one.lamps)) >= 4)
    first = next(k for k in np.argsort(-epoch.amplitude) if epoch.lamps[k])
    alone = replace(epoch, lamps=tuple(one if k == first else None for k, one in enumerate(epoch.lamps)))
    rule_out(lights, alone)
    assert lights.tracks
    rule_out(lights, epoch)
    assert not lights.tracks
    step(state, [Odometry(0.6, epoch.t_end, np.zeros(3)), epoch], UNLIMITED)
    (window,) = windows(state.light, state.map.graph)
    assert inside(window, at)


def test_light_that_has_long_told_the_place_is_enough_where_the_map_knows_nothing() -> None:
    state = shown(robot())
    state.relocalisation.search.looks = 1
    light, tie = state.light, state.pose.alignment
    light.result = replace(light.result, fix=Fix.GOOD)  # type: ignore[union-attr]
    tie.gap, tie.way = 1.0, 0.0  # type: ignore[union-attr]
    for way, known in ((0.0, False), (4.0, False), (6.0, True)):
        tie.way = way  # type: ignore[union-attr]
        assert relocalisation.by_light_alone(state) == known
    assert state.map.parts.detached is None
    assert relocalisation.places(state) is None


@pytest.mark.parametrize("bearing", np.linspace(0.0, 2.0 * math.pi, 6, endpoint=False).tolist())
def test_lamps_that_cannot_be_received_here_say_that_the_robot_is_elsewhere(bearing: float) -> None:
    state, way = shown(robot()), np.array((math.cos(bearing), math.sin(bearing), 0.0))
    for yaw in (0.0, 1.6, 3.1):  # of which strengths say nothing
        assert not out_of_place(state.light, np.array((*HERE[:2], yaw)))
    assert not out_of_place(state.light, HERE + 0.8 * way)
    assert out_of_place(state.light, HERE + 5.0 * way)
    state.light.filter.course.t_mono += 5.0  # type: ignore[union-attr]  # what was received then
    assert not out_of_place(state.light, HERE + 5.0 * way)


def unused(state: State) -> State:
    """As after the robot was carried off: the filter uses none of the lamps that are received."""
    light = state.light
    assert light is not None
    links = tuple(replace(link, state=LinkState.RIM) for link in light.result.links)
    light.result = replace(light.result, links=links, accepted=frozenset())
    return state


def anew(state: State, T_map_base: Array) -> bool:
    """Whether an epoch that has not been asked yet says that it is misplaced."""
    assert state.light is not None
    state.light.asked = None
    return misplaced(state.light, state.pose.alignment, T_map_base)


def test_an_epoch_is_asked_again_only_about_another_place() -> None:
    state, away = unused(shown(robot())), HERE + np.array((5.0, 0.0, 0.0))
    beside = away + np.array((0.03, 0.0, 1.0))
    light = state.light
    assert light is not None
    assert not misplaced(state.light, state.pose.alignment, HERE)
    assert misplaced(state.light, state.pose.alignment, away), (
        "a person has said where it is, or the laser has found it there"
    )
    strong, light.filter.catalogue.rims = light.filter.catalogue.rims, dict.fromkeys(light.filter.catalogue.rims, 1e9)
    assert misplaced(state.light, state.pose.alignment, beside)
    light.epoch = replace(light.epoch)
    assert not misplaced(state.light, state.pose.alignment, beside), "nothing is stronger than that"
    light.filter.catalogue.rims = strong
    light.epoch = replace(light.epoch)
    assert misplaced(state.light, state.pose.alignment, away)
    light.result, state.pose.alignment.gap = shown(robot()).light.result, 1.0  # type: ignore[union-attr]
    light.epoch = replace(light.epoch)
    assert not misplaced(state.light, state.pose.alignment, away), "what is used fits, and is held against the pose"
    state.pose.alignment.gap = None  # type: ignore[union-attr]
    assert misplaced(state.light, state.pose.alignment, away), "it is not any more"
    light.filter.course.t_mono += 10.0
    assert not misplaced(state.light, state.pose.alignment, away), "nothing is received any more"

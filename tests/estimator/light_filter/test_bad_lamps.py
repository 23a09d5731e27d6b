"""What may be wrong with lamps, survey and light: each case is named, and the pose stays honest."""

import dataclasses
import math

import numpy as np
import pytest

from estimator.cdma.data_frame import LampFrame
from estimator.light_filter import light_filter as lf
from estimator.light_filter.survey import Lamp, Survey
from estimator.result import Fix, LightsResult, LinkState
from tests.estimator.light_room import LAMPS, RECEIVER, SURVEY, Room, circle, drive

pytestmark = [pytest.mark.jit, pytest.mark.no_cover]


def follow(filter_: lf.Lights, room: Room, seconds: float, start: float = 0.0) -> list[LightsResult]:
    out = []
    for _, odometry, epoch in drive(room, circle, seconds, start):
        lf.predict(filter_, odometry)
        out.append(lf.update(filter_, epoch))
    return out


def away(result: LightsResult, t: float) -> float:
    return math.hypot(*(result.T_map_base - circle(t))[:2].tolist())


def states_of(results: list[LightsResult], lamp_id: int) -> list[LinkState]:
    return [link.state for result in results for link in result.links if link.lamp_id == lamp_id]


def test_a_dead_lamp_is_called_missing() -> None:
    filter_ = lf.new_lights(SURVEY)
    results = follow(filter_, Room(cover=lambda lamp, _t: 0.0 if lamp == 11 else 1.0), 30.0)
    assert LinkState.MISSING in states_of(results, 11)
    dead = {link.lamp_id for result in results for link in result.links if link.state is LinkState.MISSING}
    assert dead == {11}
    assert away(results[-1], 30.0) < 0.05


def test_a_lamp_that_was_moved_is_rejected_and_does_not_pull_the_pose() -> None:
    moved = tuple(dataclasses.replace(k, x=k.x + 1.0) if k.lamp_id == 11 else k for k in LAMPS)
    filter_ = lf.new_lights(SURVEY)
    results = follow(filter_, Room(moved), 60.0)
    wrong = states_of(results[300:], 11)
    assert wrong.count(LinkState.REJECTED) > 0.5 * len(wrong)
    assert max(away(result, 0.1 * (k + 1)) for k, result in enumerate(results) if k > 400) < 0.12


def test_a_lamp_that_was_moved_and_put_back_is_used_again() -> None:
    moved = tuple(dataclasses.replace(k, x=k.x + 1.0) if k.lamp_id == 11 else k for k in LAMPS)
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(moved), 100.0)
    assert filter_.tracks[0].watches[11].moved
    results = follow(filter_, Room(), 100.0, 100.0)
    assert LinkState.REJECTED in states_of(results[:200], 11)
    last = states_of(results[-150:], 11)
    assert last.count(LinkState.ACCEPTED) > 50
    assert LinkState.REJECTED not in last
    assert away(results[-1], 200.0) < 0.06


def test_a_lamp_that_stays_moved_gets_ever_fewer_chances() -> None:
    moved = tuple(dataclasses.replace(k, x=k.x + 0.5) if k.lamp_id == 11 else k for k in LAMPS)
    filter_ = lf.new_lights(SURVEY)
    results = follow(filter_, Room(moved), 300.0)
    heard = states_of(results[1000:], 11)
    assert heard.count(LinkState.ACCEPTED) < 0.2 * len(heard)
    assert max(away(result, 0.1 * (k + 1)) for k, result in enumerate(results) if k > 400) < 0.12


def near(t: float) -> np.ndarray:
    """A narrow round drive in the middle of the room: always the same lamps in view."""
    return circle(t, 1.0, 1.0)


def test_a_lamp_that_dims_is_learned_anew_however_often_that_has_happened_before() -> None:
    """Darker, brighter, and 100 m later darker again: nothing of that is a lamp in another place."""

    def cover(lamp: int, t: float) -> float:
        return 0.5 if lamp == 11 and (15.0 < t < 45.0 or t > 205.0) else 1.0

    filter_ = lf.new_lights(SURVEY)
    results = []
    for _, odometry, epoch in drive(Room(cover=cover), near, 240.0):
        lf.predict(filter_, odometry)
        results.append(lf.update(filter_, epoch))
    assert states_of(results[160:200], 11).count(LinkState.ACCEPTED) == 0
    assert LinkState.ACCEPTED in states_of(results[400:440], 11)
    assert LinkState.ACCEPTED in states_of(results[700:720], 11)
    assert states_of(results[2060:2100], 11).count(LinkState.ACCEPTED) == 0
    last = [link for link in results[-1].links if link.lamp_id == 11]
    assert [link.state for link in last] == [LinkState.ACCEPTED]


def test_two_lamps_of_one_code_in_view_are_not_used() -> None:
    double = tuple(dataclasses.replace(k, code=5) if k.lamp_id in (6, 7) else k for k in LAMPS)
    filter_ = lf.new_lights(dataclasses.replace(SURVEY, lamps=double))
    results = follow(filter_, Room(double), 20.0)
    twins = [link for result in results for link in result.links if link.code == 5]
    assert {link.state for link in twins} <= {LinkState.TWIN, LinkState.RIM, LinkState.FAINT, LinkState.ACCEPTED}
    assert sum(link.state is LinkState.TWIN for link in twins) > 0.5 * len(twins)
    assert all(link.lamp_id is None for link in twins if link.state is LinkState.TWIN)
    assert away(results[-1], 20.0) < 0.05


def test_a_survey_of_another_building_gives_no_pose() -> None:
    rng = np.random.default_rng(1)
    order = rng.permutation(16)
    shuffled = tuple(dataclasses.replace(k, code=int(c)) for k, c in zip(LAMPS, order, strict=True))
    filter_ = lf.new_lights(dataclasses.replace(SURVEY, lamps=shuffled))
    results = follow(filter_, Room(), 20.0)
    assert sum(result.fix is Fix.GOOD for result in results) < 0.1 * len(results)


def frames() -> dict[int, LampFrame]:
    return {k.lamp_id: LampFrame(k.lamp_id, k.x, k.y, k.z, k.power_w, 70.0) for k in LAMPS}


def test_lamps_that_describe_themselves_need_no_survey() -> None:
    filter_ = lf.new_lights(Survey((), RECEIVER))
    results = follow(filter_, Room(frames=frames()), 12.0)
    assert results[-1].fix is Fix.GOOD
    assert away(results[-1], 12.0) < 0.06


def test_without_survey_and_frames_links_are_unsurveyed() -> None:
    result = follow(lf.new_lights(Survey((), RECEIVER)), Room(), 1.0)[-1]
    assert result.fix is Fix.NONE
    assert {link.state for link in result.links} == {LinkState.UNSURVEYED}


def test_a_lamp_known_by_its_own_word_only_is_not_missed() -> None:
    """A wrong frame may name a lamp that there is not."""
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 5.0)
    epoch = Room().epoch(5.05, circle(5.05))
    there = LAMPS[int(epoch.ids[2])]
    ghost = LampFrame(99, there.x + 0.5, there.y, 2.9, 0.05, 70.0)
    lf.update(filter_, dataclasses.replace(epoch, lamps=(None, None, ghost, *epoch.lamps[3:])))
    assert 99 in filter_.catalogue.by_id
    results = follow(filter_, Room(), 30.0, 5.1)
    assert LinkState.MISSING not in {link.state for result in results for link in result.links}


@pytest.mark.slow
def test_lamps_known_by_their_own_word_only_are_forgotten_when_long_unheard() -> None:
    filter_ = lf.new_lights(SURVEY)
    room = Room()
    for k in range(3000):  # every frame another lamp, none of them ever heard again
        epoch = room.epoch(0.1 * k, circle(0.0))
        ghost = LampFrame(1000 + k, 60.0, 60.0, 2.9, 1.5, 70.0)
        lf.update(filter_, dataclasses.replace(epoch, lamps=(ghost, *epoch.lamps[1:])))
    assert len(filter_.catalogue.by_id) < 1100 + len(LAMPS)
    assert sum(len(lamps) for lamps in filter_.catalogue.by_code.values()) == len(filter_.catalogue.by_id)
    for k in range(10):
        lf.update(filter_, room.epoch(4300.0 + k, circle(0.0)))
    slots = set[int]().union(*(track.slots for track in filter_.tracks))
    assert set(filter_.catalogue.by_id) <= {lamp.lamp_id for lamp in LAMPS} | slots
    assert {lamp.lamp_id for lamp in LAMPS} <= set(filter_.catalogue.by_id)


def test_a_lamp_that_contradicts_the_survey_is_marked_and_the_survey_wins() -> None:
    said = frames()
    said[6] = dataclasses.replace(said[6], x_m=said[6].x_m + 2.0)
    results = follow(lf.new_lights(SURVEY), Room(frames=said), 15.0)
    marked = {link.lamp_id for result in results for link in result.links if link.contradicted}
    assert marked == {6}
    assert LinkState.ACCEPTED in states_of(results, 6)
    assert away(results[-1], 15.0) < 0.05


def test_codes_used_again_are_told_apart_by_their_neighbours() -> None:
    """Three halls with the same sixteen codes; in the third they hang in another order."""
    rng = np.random.default_rng(3)
    far = [dataclasses.replace(k, lamp_id=k.lamp_id + 100, x=k.x + 40.0) for k in LAMPS]
    other = rng.permutation(16)
    far = [dataclasses.replace(k, code=int(other[i])) for i, k in enumerate(far)]
    filter_ = lf.new_lights(Survey((*LAMPS, *far), RECEIVER))
    results = follow(filter_, Room(), 10.0)
    assert results[-1].fix is Fix.GOOD
    assert away(results[-1], 10.0) < 0.06
    assert all(lamp_id < 100 for lamp_id in results[-1].accepted)


def test_two_equal_halls_are_ambiguous() -> None:
    far = [Lamp(k.lamp_id + 100, k.code, k.x + 40.0, k.y, k.z, sigma_ln=k.sigma_ln) for k in LAMPS]
    filter_ = lf.new_lights(Survey((*LAMPS, *far), RECEIVER))
    results = follow(filter_, Room(), 10.0)
    assert {result.fix for result in results[5:]} == {Fix.AMBIGUOUS}
    assert results[-1].covariance[0, 0] > 15.0**2
    lf.place(filter_, circle(10.0), np.diag((1.0, 1.0, 1.0)))  # somebody says which
    results = follow(filter_, Room(), 5.0, 10.0)
    assert results[-1].fix is Fix.GOOD
    assert away(results[-1], 15.0) < 0.08


def test_more_lamps_than_slots_come_and_go() -> None:
    """A corridor of forty lamps: slots are handed on, gains remembered."""
    row = tuple(Lamp(k + 1, k, 2.0 * k, 0.5 * (k % 2), 2.9, sigma_ln=0.05) for k in range(40))
    filter_ = lf.new_lights(Survey(row, RECEIVER))

    def along(t: float) -> np.ndarray:
        return np.array((1.0 + 0.6 * t, 0.8, 0.0))

    for _, odometry, epoch in drive(Room(row), along, 110.0):
        lf.predict(filter_, odometry)
        result = lf.update(filter_, epoch)
    assert math.hypot(*(result.T_map_base - along(110.0))[:2].tolist()) < 0.15
    assert len(filter_.gains) > 10


def test_the_papers_pause_rule() -> None:
    settings = lf.LightsSettings(link_n=4, pause=lf.Pause.PAPER)
    filter_ = lf.new_lights(SURVEY, settings)
    room = Room(cover=lambda lamp, t: 0.05 if t > 10.0 and lamp in (6, 7, 10, 11, 5, 9, 14, 15, 3) else 1.0)
    results = follow(filter_, room, 14.0)
    assert max(len(result.accepted) for result in results) <= 4
    assert results[-1].fix is Fix.HELD
    np.testing.assert_array_equal(results[-1].gained, 0.0)

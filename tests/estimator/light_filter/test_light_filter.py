"""The `lights` filter as others use it: it starts, tracks, pauses, recovers, and says what it knows."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from estimator.cdma.epoch import BlockFlag
from estimator.light_filter import iterated_update, state_vector
from estimator.light_filter import light_filter as lf
from estimator.light_filter.gain_memory import recall
from estimator.light_filter.link_association import Sight
from estimator.light_filter.link_gating import gate
from estimator.light_filter.survey import Survey
from estimator.measurements import Array, Imu
from estimator.numerics import se2
from estimator.result import Fix, LightsResult, LinkState, speaks_against
from tests.estimator.light_room import LAMPS, SURVEY, Room, circle, drive, wheels

pytestmark = pytest.mark.jit


def off(result: LightsResult, truth: Array) -> tuple[float, float]:
    """Error in m and rad."""
    x, y, yaw = (result.T_map_base - truth).tolist()
    return math.hypot(x, y), abs(se2.wrap(yaw))


def follow(filter_: lf.Lights, room: Room, seconds: float, start: float = 0.0) -> list[LightsResult]:
    out = []
    for _, odometry, epoch in drive(room, circle, seconds, start):
        lf.predict(filter_, odometry)
        out.append(lf.update(filter_, epoch))
    return out


def states(result: LightsResult) -> dict[int | None, LinkState]:
    return {link.lamp_id: link.state for link in result.links}


def test_nothing_is_known_before_the_first_epoch() -> None:
    result = lf.result(lf.new_lights(SURVEY))
    assert result.fix is Fix.NONE
    assert result.links == ()
    assert result.t_mono == -math.inf


def test_it_starts_by_itself_and_finds_place_and_heading() -> None:
    filter_ = lf.new_lights(SURVEY)
    results = follow(filter_, Room(), 10.0)
    assert results[0].fix is Fix.STARTING
    assert math.sqrt(results[0].covariance[2, 2]) > 1.0  # any heading
    good = next(k for k, result in enumerate(results) if result.fix is Fix.GOOD)
    assert good < 60
    error, heading = off(results[-1], circle(10.0))
    assert error < 0.04
    assert heading < math.radians(3.0)
    assert results[-1].accepted
    assert results[-1].accepted <= {lamp.lamp_id for lamp in LAMPS}


def test_a_start_that_is_decided_keeps_nothing_of_the_other_hypotheses() -> None:
    filter_ = lf.new_lights(SURVEY)
    shared = set()
    for _, odometry, epoch in drive(Room(), circle, 10.0):
        lf.predict(filter_, odometry)
        if lf.update(filter_, epoch).fix is Fix.GOOD:
            break
        shared |= {id(track.P.base) for track in filter_.tracks if len(filter_.tracks) > 1}
    assert len(shared) == 1
    assert len(filter_.tracks) == 1
    assert filter_.tracks[0].P.base is None


def test_what_pauses_a_link_and_what_speaks_against_the_place_are_the_same_limits() -> None:
    assert not {"weak", "strong"} & {setting.name for setting in dataclasses.fields(lf.LightsSettings)}
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 5.0)
    for deviations in (-3.1, -2.9, 0.0, 3.4, 3.6):
        track = filter_.tracks[0]
        track.watches.clear()
        sight = Sight(5, 1e-6, 1e-18, LinkState.ACCEPTED, LAMPS[5], residual=deviations * 0.1, sigma=0.1)
        paused = gate(filter_, track, sight) is not LinkState.ACCEPTED
        assert paused is speaks_against(LinkState.ACCEPTED, sight.residual, sight.sigma)


def test_standing_still_it_says_that_it_does_not_know_the_heading() -> None:
    filter_, room = lf.new_lights(SURVEY), Room()
    for k in range(200):
        result = lf.update(filter_, room.epoch(0.1 * k, circle(0.0)))
    assert result.fix is Fix.STARTING
    assert math.sqrt(result.covariance[2, 2]) > 1.0


def test_a_hidden_lamp_leads_no_robot_astray_that_stands_after_its_start() -> None:
    here = np.array((2.6, 2.4, 0.5))
    room = Room(cover=lambda lamp, _: 0.05 if lamp in (5, 7, 10) else 1.0)  # 6, 2 and 1 are clear, and one further off
    filter_ = lf.new_lights(SURVEY)
    for k in range(400):
        t = 0.05 * k
        lf.predict(filter_, wheels(lambda _: here, t, 0.05))
        result = lf.update(filter_, room.epoch(t, here))
    error, _ = off(result, here)
    assert error < 0.3
    assert error < 3.0 * math.sqrt(result.covariance[0, 0] + result.covariance[1, 1])


@pytest.mark.slow
def test_exchanged_lamps_lead_no_robot_astray_that_stands_after_its_start() -> None:
    """What does not fit says the same in every epoch: it must not pull at the place as often."""
    rng, deviations = np.random.default_rng(0), []
    for _ in range(24):
        here = np.append(rng.uniform(3.0, 7.0, 2), rng.uniform(-3.0, 3.0))
        near = np.argsort([math.hypot(lamp.x - here[0], lamp.y - here[1]) for lamp in LAMPS])[:7]
        one, two = (LAMPS[k] for k in rng.choice(near, 2, replace=False))
        hung = {one.code: two.code, two.code: one.code}
        room = Room([dataclasses.replace(lamp, code=hung.get(lamp.code, lamp.code)) for lamp in LAMPS])
        filter_ = lf.new_lights(SURVEY)
        for t in np.arange(0.0, 10.0, 0.05).tolist():
            lf.predict(filter_, wheels(lambda _, here=here: here, t, 0.05))  # type: ignore[misc]
            result = lf.update(filter_, room.epoch(t, here))
        e = (result.T_map_base - here)[:2]
        deviations.append(float(e @ np.linalg.solve(result.covariance[:2, :2], e)))
    assert np.median(deviations) < 3.0  # 1.4 where nothing is wrong


def test_a_robot_that_stands_keeps_its_place_when_all_lamps_but_one_are_uncovered() -> None:
    """Those that fit again are not used before it drives on, and speak for the place nevertheless."""
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 10.0)
    here = circle(10.0)
    assert lf.result(filter_).fix is Fix.GOOD
    hidden = min(lf.result(filter_).accepted)
    room = Room(cover=lambda lamp, t: 0.05 if t < 11.0 or lamp == hidden else 1.0)
    for k in range(1, 201):
        t = 10.0 + 0.05 * k
        lf.predict(filter_, wheels(lambda _: here, t, 0.05))
        result = lf.update(filter_, room.epoch(t, here))
        assert result.fix in (Fix.GOOD, Fix.HELD)
    assert off(result, here)[0] < 0.1
    assert off(result, here)[1] < math.radians(5.0)
    assert states(result)[hidden] is LinkState.OCCLUDED


@pytest.mark.parametrize("curve", [-0.06, 0.06])
def test_wheels_that_have_never_been_calibrated_are_found_out(curve: float) -> None:
    filter_, room = lf.new_lights(SURVEY), Room()
    for _, odometry, epoch in drive(room, circle, 40.0):
        x, y, yaw = odometry.delta.tolist()
        wrong = np.array((1.03 * x, 1.03 * y, yaw + curve * x))
        lf.predict(filter_, dataclasses.replace(odometry, delta=wrong))
        result = lf.update(filter_, epoch)
    assert result.fix is Fix.GOOD
    error, heading = off(result, circle(40.0))
    assert error < 0.06
    assert heading < math.radians(3.0)
    assert filter_.tracks[0].x[state_vector.CURVE] == pytest.approx(-curve, abs=0.02)


def test_gains_of_lamps_are_learned() -> None:
    dim = tuple(dataclasses.replace(lamp, power_w=1.2) if lamp.lamp_id == 6 else lamp for lamp in LAMPS)
    filter_ = lf.new_lights(
        dataclasses.replace(SURVEY, lamps=tuple(dataclasses.replace(k, sigma_ln=0.15) for k in LAMPS))
    )
    results = follow(filter_, Room(dim), 60.0)
    last = [result for result in results if 6 in result.accepted][-1]
    assert last.t_mono > 40.0
    gains = {link.lamp_id: link.gain for link in last.links if link.state is LinkState.ACCEPTED}
    others = [gain for lamp_id, gain in gains.items() if lamp_id != 6]
    assert len(others) >= 3
    assert gains[6] - float(np.median(others)) == pytest.approx(math.log(1.2 / 1.5), abs=0.05)
    assert off(results[-1], circle(60.0))[0] < 0.05


def test_a_covered_lamp_is_paused_and_comes_back() -> None:
    filter_ = lf.new_lights(SURVEY)
    room = Room(cover=lambda lamp, t: 0.2 if 12.0 < t < 16.0 and lamp in (10, 11) else 1.0)
    results = follow(filter_, room, 20.0)
    during = {states(result).get(lamp) for result in results[125:155] for lamp in (10, 11)}
    assert LinkState.OCCLUDED in during
    assert LinkState.ACCEPTED not in during
    assert off(results[155], circle(15.6))[0] < 0.06
    assert {states(result).get(11) for result in results[185:]} <= {LinkState.ACCEPTED, LinkState.RIM, None}


def test_with_every_link_gone_the_pose_is_held_and_its_covariance_grows() -> None:
    filter_ = lf.new_lights(SURVEY)
    results = follow(filter_, Room(cover=lambda _lamp, t: 1.0 if t < 10.0 else 0.0), 20.0)
    assert results[95].fix is Fix.GOOD
    assert results[-1].fix is Fix.HELD
    assert results[-1].covariance[0, 0] > results[95].covariance[0, 0]
    assert off(results[-1], circle(20.0))[0] < 0.3


def test_carried_elsewhere_it_says_lost_and_finds_itself_again() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 10.0)
    there = filter_.bent
    results = follow(filter_, Room(), 30.0, 15.0)  # 5 s of driving that no wheel has seen
    assert Fix.LOST in {result.fix for result in results}
    assert results[-1].fix is Fix.GOOD
    assert off(results[-1], circle(45.0))[0] < 0.08
    assert filter_.bent is not there, "what its lamps were bent by elsewhere tells nothing here"


def test_information_gained_is_what_the_covariance_lost() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 10.0)
    lf.predict(filter_, wheels(circle, 10.1, 0.1))
    before = lf.result(filter_)
    after = lf.update(filter_, Room().epoch(10.1, circle(10.1)))
    want = np.linalg.inv(after.covariance) - np.linalg.inv(before.covariance)
    np.testing.assert_allclose(after.gained, want, rtol=0.05, atol=0.02 * np.abs(want).max())
    assert np.linalg.eigvalsh(after.gained).min() > -1e-6
    np.testing.assert_allclose(after.gained_by, after.T_map_base - before.T_map_base, atol=1e-12)


def test_a_late_epoch_is_compared_with_where_the_robot_was() -> None:
    on_time, late = lf.new_lights(SURVEY), lf.new_lights(SURVEY)
    held = []
    for _, odometry, epoch in drive(Room(), circle, 20.0):
        lf.predict(on_time, odometry)
        lf.predict(late, odometry)
        a = lf.update(on_time, epoch)
        held.append(epoch)
        b = lf.update(late, held.pop(0)) if len(held) > 3 else lf.result(late)  # 0.3 s: 12 cm of way
    assert off(a, circle(20.0))[0] < 0.03
    assert off(b, circle(20.0))[0] < 0.03
    assert b.t_mono < b.t_pose


def test_place_sets_the_pose() -> None:
    filter_ = lf.new_lights(SURVEY)
    lf.place(filter_, circle(0.0), np.diag((0.1**2, 0.1**2, 0.1**2)))
    assert off(lf.result(filter_), circle(0.0)) == (0.0, 0.0)
    results = follow(filter_, Room(), 2.0)
    assert results[-1].fix is Fix.GOOD
    assert off(results[-1], circle(2.0))[0] < 0.06


def test_reset_forgets_everything() -> None:
    filter_ = lf.new_lights(SURVEY)
    recall(filter_, {1: (np.full(3, 0.1), np.full(3, 1e-4))}, None, ())
    follow(filter_, Room(), 5.0)
    assert filter_.recalled
    assert filter_.bent.lamps
    lf.reset(filter_)
    assert lf.result(filter_).fix is Fix.NONE
    assert lf.result(filter_).accepted == frozenset()
    assert lf.result(filter_).bent == 0.0
    assert not filter_.recalled
    assert not filter_.bent.lamps


def test_a_block_that_cannot_be_used_brings_no_links() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 5.0)
    none = Room().epoch(5.1, circle(5.1), least=1.0)
    result = lf.update(filter_, dataclasses.replace(none, block=BlockFlag.SATURATED))
    assert result.links == ()
    assert result.block is BlockFlag.SATURATED
    np.testing.assert_array_equal(result.gained, 0.0)


def test_numbers_that_are_none_change_nothing() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 6.0)
    lf.predict(filter_, lf.Odometry(6.0, 6.1, np.array((math.nan, 0.0, 0.0))))
    lf.predict(filter_, lf.Odometry(6.0, math.nan, np.zeros(3)))
    lf.predict(filter_, Imu(6.0, 6.1, math.nan))
    epoch = Room().epoch(6.1, circle(6.1))
    epoch.amplitude[0], epoch.amplitude[1], epoch.variance[2] = math.nan, -1.0, math.nan
    result = lf.update(filter_, epoch)
    assert np.isfinite(result.T_map_base).all()
    assert np.isfinite(result.covariance).all()
    assert off(result, circle(6.1))[0] < 0.15


def test_a_survey_with_one_number_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="lamp 1 twice"):
        lf.new_lights(Survey((LAMPS[0], LAMPS[0])))


def test_only_where_hypotheses_are_compared_one_epoch_may_lead_them_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is improbable speaks against one of eight; the one that is left is not led farther than it may be."""
    filter_, heard = lf.new_lights(SURVEY), set[tuple[bool, bool]]()
    whole = iterated_update.take_in

    def take_in(*what: Any, bounded: bool) -> float:
        heard.add((len(filter_.tracks) == 1, bounded))
        return whole(*what, bounded=bounded)

    monkeypatch.setattr(iterated_update, "take_in", take_in)
    follow(filter_, Room(), 10.0)
    assert heard == {(False, False), (True, True)}

"""The alert on the position error: raised at once, over only when the bound has stayed within, said once."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import pytest
from msgspec import structs

from daemon.health.reasons import Reason
from daemon.integrity.evidence import Evidence, Light
from daemon.integrity.position_alert import CLEAR_S, SETTLE_S, Alarm, bounded
from daemon.integrity.state_memory import Memory
from daemon.snapshot import State


def run(alarm: Alarm, bounds: list[float | None], begin: float = 0.0) -> list[bool]:
    """One bound a tenth of a second."""
    return [alarm.update(begin + 0.1 * k, bound) for k, bound in enumerate(bounds)]


def test_no_limit_no_alert() -> None:
    assert run(Alarm(0.0), [None, 100.0, 0.1]) == [False, False, False]


def test_who_knows_nothing_does_not_say_that_all_is_well(caplog: pytest.LogCaptureFixture) -> None:
    alarm = Alarm(0.5)
    assert alarm.on
    with caplog.at_level(logging.INFO):
        assert all(run(alarm, [None] * 20))
    assert caplog.messages == [], "before the first bound there is nothing to be alarmed about"
    assert not alarm.said


def test_a_bound_that_never_comes_within_the_limit_is_said_once_it_has_had_the_time(
    caplog: pytest.LogCaptureFixture,
) -> None:
    alarm = Alarm(0.02)
    with caplog.at_level(logging.INFO):
        run(alarm, [None] * 300)
        run(alarm, [0.03] * round(10.0 * SETTLE_S), 30.0)
        assert not alarm.said, "it may still be settling"
        run(alarm, [0.03, None, 0.03], 30.0 + SETTLE_S)
        assert alarm.said
        run(alarm, [0.01] * 20, 50.0)
    assert not alarm.said
    assert len(caplog.messages) == 2
    assert "`integrity.alert_m`: 0.02 m" in caplog.messages[0]


def test_a_start_whose_bound_settles_is_no_alarm(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        run(Alarm(0.02), [None] * 20 + [0.05] * 30 + [0.01] * 20)
    assert caplog.messages == []


@pytest.mark.parametrize("bad", [None, 0.51, float("nan"), float("inf")])
def test_one_cycle_above_the_limit_raises_it_and_it_is_said_once(
    bad: float | None, caplog: pytest.LogCaptureFixture
) -> None:
    alarm = Alarm(0.5)
    with caplog.at_level(logging.INFO):
        run(alarm, [0.2] * 20)
        assert not alarm.on
        assert run(alarm, [bad, 0.2, bad, bad], 2.0) == [True] * 4
        assert alarm.said
        assert len(caplog.messages) == 1
        assert "integrity.alert_m" in caplog.messages[0]
        assert "`integrity.alert_m`: 0.5 m" in caplog.messages[0]
        assert ("no protection level" in caplog.messages[0]) == (bad is None or not math.isfinite(bad))
        after = run(alarm, [0.2] * 20, 3.0)
    assert after[0]
    assert not after[-1]
    assert after.count(True) == pytest.approx(CLEAR_S / 0.1, abs=1), "over only after the bound has stayed within"
    assert len(caplog.messages) == 2
    assert "over" in caplog.messages[1]


def test_it_does_not_chatter() -> None:
    alarm = Alarm(0.5)
    run(alarm, [0.2] * 20)
    assert all(run(alarm, [0.51, 0.49] * 30, 2.0))


HELD = Memory(State.TRACKING, Reason.NONE, tracked=True)
TURNING = Light(alive=True, used=True, placed=True, agrees=True, known=(True, True, False))


def test_a_bound_stands_where_the_pose_is_held() -> None:
    assert bounded(HELD, Evidence(1.0))
    assert bounded(structs.replace(HELD, state=State.DEGRADED), Evidence(1.0))


def test_a_bound_waits_for_the_heading_only_where_lamps_find_it_and_the_pose_goes_by_it() -> None:
    young = structs.replace(HELD, state=State.DEGRADED, tracked=False)
    assert not bounded(young, Evidence(1.0, light=TURNING))
    assert bounded(young, Evidence(1.0)), "laser alone: a turn in the map is none in the world"
    assert bounded(young, Evidence(1.0, light=replace(TURNING, known=(True, True, True))))
    assert bounded(young, Evidence(1.0, light=TURNING, lidar=False)), "each epoch tells the place anew"
    assert not bounded(young, Evidence(1.0, light=TURNING, lidar=False, odometry=True))


@pytest.mark.parametrize("state", [s for s in State if s not in (State.TRACKING, State.DEGRADED)])
def test_no_bound_in_any_other_state(state: State) -> None:
    assert not bounded(structs.replace(HELD, state=state), Evidence(1.0))


@pytest.mark.parametrize(
    ("memory", "evidence"),
    [
        (HELD, Evidence(1.0, guessed=True)),
        (HELD, Evidence(1.0, places=1)),
        (structs.replace(HELD, doubt=True), Evidence(1.0)),
        (structs.replace(HELD, odd_since=0.9), Evidence(1.0)),
        (structs.replace(HELD, tracked=False), Evidence(1.0, light=TURNING)),
    ],
)
def test_no_bound_of_a_place_in_doubt(memory: Memory, evidence: Evidence) -> None:
    assert not bounded(memory, evidence)


@pytest.mark.parametrize(("agrees", "stands"), [(None, False), (False, False), (True, True)])
def test_no_bound_while_odometry_and_lidar_contradict_each_other_unless_light_decides(
    agrees: bool | None, stands: bool
) -> None:
    light = Light(True, used=agrees is not None, placed=agrees is not None, agrees=agrees)
    memory = Memory(State.DEGRADED, Reason.WITNESSES_DISAGREE, disagree_since=5.0, tracked=True)
    evidence = Evidence(10.0, light=light)
    assert bounded(memory, evidence) is stands
    assert bounded(structs.replace(memory, disagree_since=None), evidence)

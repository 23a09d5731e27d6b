"""Data that come, and come wrongly: late scans, odometry that is lost, late or seldom, a laser at odds with the map."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.publish.snapshot import State
from daemon.reasons import Reason
from daemon.state_memory import Memory
from daemon.watch import Watch
from hal.odometry import RawOdometry
from tests.daemon.room import raw_scan

PERIOD = 0.1


def reading(t_rx: float, age: float = 0.0, missed: int = 0) -> RawOdometry:
    return RawOdometry(t_rx, t_rx - age, 0.0, 0.0, 0.0, missed)


def fed(*spells: tuple[float, float]) -> Watch:
    """A watch that is asked once a second; spells of (seconds, readings per second)."""
    watch, t = Watch(), 0.0
    for seconds, hz in spells:
        for k in range(round(seconds * hz)):
            watch.on_odometry(reading(t + k / hz))
            if k % round(hz) == 0:
                watch.seldom(t + k / hz, PERIOD)
        t += seconds
    return watch


@pytest.mark.parametrize(
    ("spells", "seldom"),
    [
        (((20.0, 50.0),), False),
        (((20.0, 10.0),), False),
        (((20.0, 50.0), (4.0, 12.5)), True),
        (((20.0, 50.0), (120.0, 12.5)), False),  # it has become usual
        (((20.0, 12.5), (4.0, 50.0)), False),
        (((30.0, 4.0),), True),  # fewer than scans
        (((1.0, 50.0),), False),  # too early to say
    ],
)
def test_readings_that_come_more_seldom_than_before(spells: tuple[tuple[float, float], ...], seldom: bool) -> None:
    assert fed(*spells).seldom(sum(seconds for seconds, _ in spells), PERIOD) is seldom


def test_lost_and_late_readings_are_counted_but_not_those_of_a_silence() -> None:
    watch = Watch()
    watch.on_odometry(reading(0.0))
    watch.on_odometry(reading(0.04, missed=1))
    watch.on_odometry(reading(0.06, age=0.3))
    watch.on_odometry(reading(0.08, age=0.1))
    assert (watch.readings, watch.missed, watch.old) == (4, 1, 1)
    watch.on_odometry(reading(9.0, missed=400))
    assert (watch.readings, watch.missed) == (5, 1), "silence has a fault of its own"
    assert not watch.seldom(9.5, PERIOD), "and what came before it says nothing of the rate now"


def test_late_scans_are_counted() -> None:
    watch, scan = Watch(), raw_scan(0, 5.0)
    watch.on_scan(replace(scan, t_rx=5.13), PERIOD)
    assert watch.late == 0
    watch.on_scan(replace(scan, t_rx=5.4), PERIOD)
    assert watch.late == 1


def test_a_laser_at_odds_with_a_place_that_was_known() -> None:
    watch, odd = Watch(), Memory(State.RELOCATING, Reason.SEARCHING)
    for t in range(10):
        watch.on_verdict(float(t), odd, scans=True)
    assert not watch.misfit, "a place that is not known yet cannot be contradicted"
    watch.on_verdict(10.0, Memory(State.TRACKING, Reason.NONE), scans=True)
    watch.on_verdict(10.1, Memory(State.DEGRADED, Reason.MATCH_FAILED), scans=True)
    watch.on_verdict(11.9, Memory(State.DEGRADED, Reason.CONFIRMING), scans=True)
    assert not watch.misfit
    watch.on_verdict(12.2, odd, scans=True)
    assert watch.misfit
    watch.on_verdict(12.3, odd, scans=False)
    assert not watch.misfit, "a laser that is silent says nothing"
    watch.on_verdict(20.0, odd, scans=True)
    watch.on_verdict(23.0, odd, scans=True)
    watch.on_verdict(23.1, Memory(State.TRACKING, Reason.NONE), scans=True)
    assert not watch.misfit


def test_disagreement_counts_whatever_else_is_said() -> None:
    watch = Watch()
    memory = Memory(State.DEGRADED, Reason.LIGHT_LOST, disagree_since=5.0)
    watch.on_verdict(5.5, memory, scans=True)
    assert not watch.disagree
    watch.on_verdict(6.1, memory, scans=True)
    assert watch.disagree
    watch.on_verdict(6.2, replace(memory, disagree_since=None), scans=True)
    assert not watch.disagree

"""Odometry readings as they arrive: whether they come, and more seldom than they used to."""

from __future__ import annotations

import pytest

from daemon.integrity.arrival_monitor import Arrivals
from daemon.runtime.inbox import DEEPEST, Inbox
from tests.daemon.support.room import raw_odometry

PERIOD = 0.1


def fed(*spells: tuple[float, float]) -> Arrivals:
    """Asked once a second; spells of (seconds, readings per second)."""
    arrivals, t = Arrivals(), 0.0
    for seconds, hz in spells:
        for k in range(round(seconds * hz)):
            arrivals.on_reading(t + k / hz)
            if k % round(hz) == 0:
                arrivals.seldom(t + k / hz, PERIOD)
        t += seconds
    return arrivals


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


@pytest.mark.parametrize(("hz", "period", "seldom"), [(20.0, 0.025, False), (10.0, 0.025, False), (5.0, 0.025, True)])
def test_wheels_that_are_slower_than_a_fast_lidar_are_no_fault(hz: float, period: float, seldom: bool) -> None:
    arrivals = Arrivals()
    for k in range(round(60.0 * hz)):
        arrivals.on_reading(k / hz)
        if k % round(hz) == 0 and k > 10.0 * hz:
            assert arrivals.seldom(k / hz, period) is seldom


def test_wheels_need_not_be_faster_than_a_slow_lidar() -> None:
    assert not fed((30.0, 5.0)).seldom(30.0, 0.2)


def test_a_fast_sender_that_becomes_slow_is_noticed() -> None:
    assert fed((20.0, 1000.0), (4.0, 100.0)).seldom(24.0, PERIOD)


def test_what_came_before_a_silence_says_nothing_of_the_rate_now() -> None:
    arrivals = fed((20.0, 50.0))
    arrivals.on_reading(25.0)
    assert not arrivals.seldom(25.5, PERIOD)
    assert arrivals.latest == 25.0


def test_readings_that_wait_for_a_cycle_have_arrived_all_of_them() -> None:
    """More than are held: while the estimator is loaded, and between the scans of a slow lidar."""
    inbox, told = Inbox(), []
    for k in range(30 * 100):
        inbox.put_odometry(raw_odometry(0.01 * k))
        if k % 100 == 99:
            told.append(inbox.wheels.seldom(0.01 * k, 1.0))
    assert len(inbox.drain().odometry) <= DEEPEST
    assert not any(told)
    for k in range(4 * 40):
        inbox.put_odometry(raw_odometry(30.0 + k / 40))
    assert inbox.wheels.seldom(34.0, 1.0), "what is usual was not learned from what was held"

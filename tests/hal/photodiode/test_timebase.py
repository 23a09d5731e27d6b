"""SCL and sample times from nothing but the times around transactions."""

import random

import pytest

from hal.photodiode.timebase import STEP_BLOCKS, WINDOW, SclClock, scl_hz

LENGTH = 2222
OVERHEAD = 65e-6


def span(hz: float, length: int = LENGTH, overhead: float = OVERHEAD) -> float:
    return (10 + 9 * length) / hz + overhead


def clock(hz: float = 400e3, spread: float = 0.0) -> SclClock:
    return SclClock(LENGTH, span(hz), span(hz, 2), spread)


def test_scl_from_two_lengths() -> None:
    assert scl_hz(LENGTH, span(391e3), span(391e3, 2)) == pytest.approx(391e3)
    assert scl_hz(2, 1.0, 1.0) == 0.0
    assert scl_hz(60, 1e-4, 1e-4) == 0.0


def test_an_undisturbed_block() -> None:
    timing = clock().add(10.0, 10.0 + span(400e3))
    assert timing.rate_hz == pytest.approx(400e3 / 18)
    assert timing.t_first == pytest.approx(10.0 + 8 / 400e3)
    assert timing.slack_s == pytest.approx(OVERHEAD)
    assert not timing.stretched


@pytest.mark.parametrize("late", [40e-6, 1e-3, 50e-3])
def test_a_late_return_does_not_move_the_samples(late: float) -> None:
    scl = clock()
    timing = scl.add(10.0, 10.0 + span(400e3) + late)
    assert timing.t_first == pytest.approx(10.0 + 8 / 400e3)
    assert timing.excess_s == pytest.approx(late)
    assert timing.slack_s == pytest.approx(OVERHEAD + late)
    assert timing.stretched
    assert not scl.doubt


@pytest.mark.parametrize(("spread", "most"), [(140e-6, 10), (0.0, 60)])
def test_the_limit_follows_the_spread(spread: float, most: int) -> None:
    """On a computer where returns scatter by 200 us, 0.5 ms is nothing special."""
    chance = random.Random(1)
    scl, t, stretched = clock(spread=spread), 0.0, 0
    for _ in range(500):
        stretched += scl.add(t, t + span(400e3) + chance.expovariate(1 / 200e-6)).stretched
        t += 0.05
    assert stretched < most
    assert not scl.add(t, t + span(400e3) + 500e-6).stretched
    assert scl.add(t, t + span(400e3) + 5e-3).stretched
    assert scl.spread_s == pytest.approx(200e-6 * 0.69, rel=0.5)


def test_the_first_measurement_is_refined() -> None:
    """Both reads of the start were late; the first good block shows it."""
    scl = SclClock(LENGTH, span(400e3) + 200e-6, span(400e3, 2))
    assert abs(scl.hz / 400e3 - 1.0) > 3e-3
    scl.add(0.0, span(400e3))
    assert scl.hz == pytest.approx(400e3, rel=20e-6)


def test_slow_drift_is_followed() -> None:
    scl, t = clock(), 0.0
    for k in range(10 * WINDOW):
        hz = 400e3 * (1.0 - 1e-3 * k / (10 * WINDOW))
        scl.add(t, t + span(hz))
        t += 0.05
    assert not scl.doubt
    assert scl.hz == pytest.approx(400e3 * 0.999, rel=250e-6)


def test_a_slower_clock_raises_doubt_after_some_blocks() -> None:
    scl, t = clock(), 0.0
    for k in range(STEP_BLOCKS):
        assert not scl.doubt, k
        assert scl.add(t, t + span(396e3)).stretched
        t += 0.05
    assert scl.doubt


def test_doubt_ends_with_a_block_as_short_as_before() -> None:
    """They were all late: returns can fall into step with what keeps the computer busy."""
    scl = clock()
    for k in range(2 * STEP_BLOCKS):
        scl.add(0.05 * k, 0.05 * k + span(400e3) + 2e-3)
    assert scl.doubt
    timing = scl.add(10.0, 10.0 + span(400e3))
    assert not scl.doubt
    assert not timing.stretched


def test_single_blocks_that_are_late_raise_no_doubt() -> None:
    scl, t = clock(), 0.0
    for k in range(200):
        scl.add(t, t + span(400e3) + (5e-3 if k % STEP_BLOCKS else 0.0))
        t += 0.06
    assert not scl.doubt


def test_a_faster_clock_raises_doubt_at_once() -> None:
    scl = clock()
    timing = scl.add(0.0, span(404e3))
    assert scl.doubt
    assert timing.stretched
    assert scl.hz == pytest.approx(400e3)  # what was known stays until it is measured anew


def test_a_transaction_that_took_no_time_breaks_nothing() -> None:
    scl = clock()
    timing = scl.add(5.0, 5.0)
    assert scl.doubt
    assert timing.stretched
    assert timing.slack_s == pytest.approx(OVERHEAD)

"""A monotone time for stamps that are not monotone."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.replay.monotone_stamps import GAP_S, monotone


def test_good_stamps_are_kept_to_the_bit() -> None:
    stamps = np.array([100.0, 100.1, 100.25, 100.3])
    assert np.array_equal(monotone(stamps, 100.0).time, stamps - 100.0)


def test_a_step_back_is_shared_by_its_neighbours() -> None:
    clock = monotone(np.array([0.0, 1.0, 2.0, 1.4, 3.0, 4.0]), 0.0)
    assert clock.backward == 1
    assert clock.worst_s == pytest.approx(0.6)
    assert np.all(np.diff(clock.time) >= GAP_S - 1e-12)
    assert clock.time[[0, 1, 4, 5]] == pytest.approx([0.0, 1.0, 3.0, 4.0])
    assert 1.4 <= clock.time[2] < clock.time[3] <= 2.0


def test_duplicates_are_spread() -> None:
    stamps = np.arange(40.0)
    stamps[7:9] = stamps[6]
    clock = monotone(stamps, 0.0)
    assert (clock.duplicates, clock.backward, clock.coarse_s) == (2, 0, 0.0)
    assert np.all(np.diff(clock.time) >= GAP_S - 1e-12)
    assert np.abs(clock.time - stamps).max() <= 2.1 * GAP_S


def test_a_restarted_clock_continues_where_it_was() -> None:
    stamps = np.array([1000.0, 1000.1, 1000.2, 3.0, 3.1, 3.2])
    clock = monotone(stamps, 1000.0)
    assert (clock.restarts, clock.backward) == (1, 0)
    assert clock.time == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])


def test_a_clock_that_was_set_back_by_less_than_a_restart_is_bridged() -> None:
    stamps = 0.1 * np.arange(100)
    stamps[50:] -= 3.0
    clock = monotone(stamps, 0.0)
    assert clock.restarts == 1
    np.testing.assert_allclose(np.diff(clock.time), 0.1)


def test_one_wild_stamp_moves_nothing_after_it() -> None:
    stamps = np.array([1e9, 1e9 + 0.1, 0.0, 1e9 + 0.3, 1e9 + 0.4])
    clock = monotone(stamps, 1e9)
    assert (clock.wild, clock.restarts, clock.backward) == (1, 0, 0)
    assert clock.time == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-6)


def test_one_and_two_records() -> None:
    assert monotone(np.array([5.0]), 5.0).time.tolist() == [0.0]
    assert monotone(np.array([5.0, 4.5]), 5.0).backward == 1
    assert monotone(np.array([9.0, 1.0]), 9.0).restarts == 1


@pytest.mark.parametrize("period", [0.025, 0.1, 0.5])
@pytest.mark.parametrize("back", [1.0, 2.0, 3.0, 4.9, 30.0, 3600.0])
def test_a_clock_set_back_in_mid_log_is_bridged(period: float, back: float) -> None:
    true = period * np.arange(400)
    stamps = 1e9 + true
    stamps[200:] -= back
    clock = monotone(stamps, 1e9)
    if back > 2.0 * period + 1e-9:
        assert (clock.restarts, clock.backward) == (1, 0)
        assert clock.time == pytest.approx(true, abs=1e-5)
    assert not clock.refusal


def test_a_clock_set_back_again_and_again_is_bridged_each_time() -> None:
    true = 0.1 * np.arange(600)
    clock = monotone(true - 3.0 * (np.arange(600) // 60), 0.0)
    assert clock.restarts == 9
    assert clock.time == pytest.approx(true, abs=1e-6)


def test_stamps_that_scatter_are_no_clock_that_was_set() -> None:
    true = 0.1 * np.arange(2000)
    clock = monotone(true + np.random.default_rng(1).normal(0.0, 0.3, 2000), 0.0)
    assert clock.backward > 200
    assert clock.restarts == 0
    assert np.abs(clock.time - true).max() < 1.0


@pytest.mark.parametrize("step", [0.2, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("part", [0.0, 0.35])
@pytest.mark.parametrize("rounded", [np.floor, np.round])
def test_a_coarse_clock_is_spread_over_its_steps(step: float, part: float, rounded: np.ufunc) -> None:
    """Whole seconds, and other steps: a constant delay stays, but no scan moves by more than a period against it."""
    true = part + 0.0987 * np.arange(600)
    clock = monotone(step * rounded(true / step), 0.0)
    assert clock.coarse_s == pytest.approx(step)
    delay = clock.time - true
    assert np.ptp(delay) < 0.11
    assert abs(delay.mean()) < step
    assert np.diff(clock.time) == pytest.approx(np.full(599, 0.0987), rel=0.15)
    assert not clock.refusal


def test_a_coarse_clock_that_was_set() -> None:
    true = 0.1 * np.arange(600)
    stamps = np.floor(true)
    stamps[300:] -= 3.0
    clock = monotone(stamps, 0.0)
    assert clock.restarts == 1
    assert np.ptp(clock.time - true) < 0.11


@pytest.mark.parametrize(
    ("stamps", "says"),
    [
        (np.zeros(100), "all 100 stamps are equal"),
        (np.repeat([0.0, 1.0], 300), "598 equal it"),
        (-0.1 * np.arange(100), "99 run back"),
        (1e3 * 0.1 * np.arange(100), "100 s apart"),
        (1e6 * 0.1 * np.arange(100), "the clock jumps at 99 of 99 stamps"),
        (np.random.default_rng(1).uniform(0.0, 60.0, 600), "the clock jumps"),
    ],
)
def test_stamps_without_a_usable_time_are_refused(stamps: npt.NDArray[np.float64], says: str) -> None:
    assert says in monotone(stamps, float(stamps[0])).refusal


@given(st.lists(st.floats(0.0, 20.0), min_size=1, max_size=60), st.integers(0, 1 << 20))
def test_always_increasing_and_never_further_off_than_the_disorder(values: list[float], seed: int) -> None:
    scatter = np.random.default_rng(seed).uniform(0.0, 0.9, len(values))
    stamps = np.sort(np.array(values)) + scatter
    clock = monotone(stamps, float(stamps[0]))
    assert clock.restarts == 0
    assert np.all(np.diff(clock.time) >= GAP_S * (1.0 - 1e-6))
    disorder = np.maximum.accumulate(stamps) - np.minimum.accumulate(stamps[::-1])[::-1]
    off = np.abs(clock.time + stamps[0] - stamps)
    assert np.all(off <= disorder + GAP_S * len(stamps))

"""A monotone time for stamps that are not monotone."""

from __future__ import annotations

import numpy as np
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
    clock = monotone(np.array([0.0, 1.0, 1.0, 1.0, 2.0]), 0.0)
    assert (clock.duplicates, clock.backward) == (2, 0)
    assert np.all(np.diff(clock.time) >= GAP_S - 1e-12)
    assert np.abs(clock.time - [0.0, 1.0, 1.0, 1.0, 2.0]).max() <= 2.1 * GAP_S


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
    assert clock.restarts == 2
    assert clock.time == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-6)


def test_one_and_two_records() -> None:
    assert monotone(np.array([5.0]), 5.0).time.tolist() == [0.0]
    assert monotone(np.array([5.0, 4.5]), 5.0).backward == 1
    assert monotone(np.array([9.0, 1.0]), 9.0).restarts == 1


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

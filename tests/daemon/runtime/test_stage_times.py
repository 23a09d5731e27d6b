"""Histograms against numpy's quantiles; stages, rungs and stalls as they are published."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from daemon.runtime.histogram import Histogram
from daemon.runtime.stage_times import NAMES, StageTimer, TimingStatistics
from daemon.snapshot import Stage
from estimator.measurements import DegradationLevel


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=300))
def test_quantiles_are_never_too_small_and_at_most_a_sixteenth_too_large(numbers: list[int]) -> None:
    histogram = Histogram()
    for number in numbers:
        histogram.add(number)
    found = histogram.spread()
    assert found is not None
    true = np.quantile(numbers, (0.5, 0.99), method="inverted_cdf")
    for told, exact in zip(found, true, strict=False):
        assert exact <= told <= exact * (1 + 1 / 16) + 1
    assert found[2] == max(numbers)


def test_what_is_older_than_two_halves_is_forgotten() -> None:
    histogram = Histogram()
    assert histogram.spread() is None
    histogram.add(1000)
    histogram.turn()
    histogram.add(10)
    assert histogram.spread() is not None
    assert histogram.spread()[2] == 1000  # type: ignore[index]  # asserted above
    histogram.turn()
    assert histogram.spread() == (10, 10, 10)
    histogram.turn()
    assert histogram.spread() is None


def test_a_stage_that_comes_twice_adds_up_and_the_longest_is_named() -> None:
    ticks = iter([0.0, 0.001, 0.003, 0.006])
    laps = StageTimer(lambda: next(ticks))
    laps.begin()
    for stage in ("match", "map", "match"):
        laps.lap(stage)
    assert laps.us == {"match": 4000, "map": 2000}
    assert laps.longest() is Stage.MATCH
    quiet = StageTimer(None)
    quiet.begin()
    quiet.lap("match")
    assert quiet.us == {}
    assert quiet.longest() is Stage.OUTSIDE


def test_the_pulse_tells_each_stage_in_the_order_of_the_contract() -> None:
    taker = TimingStatistics()
    for k in range(100):
        taker.late(0.001)
        taker.on_cycle(0.025 * k, {"match": 300, "publish": 20})
    pulse = taker.latest
    assert pulse.cycle is not None
    assert 320 <= pulse.cycle[0] <= 340
    assert pulse.late is not None
    assert 1000 <= pulse.late[0] <= 1063
    told = dict(zip(Stage, pulse.stages, strict=False))
    assert told[Stage.MATCH] == (300, 300, 300)
    assert told[Stage.BRIDGE] is None
    assert len(pulse.stages) == len(Stage) - 1
    assert set(NAMES.values()) == set(Stage)


def test_rungs_and_stalls_are_counted() -> None:
    taker = TimingStatistics()
    for rung in (
        DegradationLevel.FULL,
        DegradationLevel.THINNED,
        DegradationLevel.NO_MAP,
        DegradationLevel.NO_MAP,
        DegradationLevel.CARRIED,
        DegradationLevel.FULL,
    ):
        taker.on_level(rung)
    taker.stalled(0.2, Stage.MAP)
    pulse = taker.latest
    assert (pulse.rung, pulse.thinned, pulse.without_map, pulse.carried) == (0, 1, 2, 1)
    assert (pulse.stalls, pulse.stall_s, pulse.stall_in) == (1, 0.2, Stage.MAP)

"""Sensor stamps to monotonic time, in virtual time: wraps, rates, jitter, resets, damage, stalls, changing motors."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.hokuyo.clock_envelope import Envelope
from hal.hokuyo.scip import TICK_MODULUS
from hal.hokuyo.ticks import ScanTime, TickClock, Unwrapper, Verdict
from tests.rotation import share

SWEEP, LINE_S = 0.75, 3.4e-3


@dataclass
class Sensor:
    """Truth: when step 0 was passed (host seconds), what the stamps said, when the frames came."""

    true: npt.NDArray[np.float64]
    stamps: npt.NDArray[np.int64]
    arrival: npt.NDArray[np.float64]

    def clock(self, nominal_s: float) -> TickClock:
        return TickClock(nominal_s, SWEEP, LINE_S)


def sensor(
    *,
    ppm: float = 0.0,
    period_s: float = 0.02505,
    seconds: float = 60.0,
    start_ms: float = 0.0,
    jitter_s: float = 5e-4,
    seed: int = 0,
) -> Sensor:
    rng = np.random.default_rng(seed)
    count = int(seconds / period_s)
    true = 5000.0 + rng.uniform(0, 1) + period_s * np.arange(count)
    device_ms = start_ms + 1e3 * (true - true[0]) * (1 + 1e-6 * ppm) + rng.uniform(0, 1)
    arrival = true + SWEEP * period_s + LINE_S + np.abs(rng.normal(0, jitter_s, count))
    return Sensor(true, np.floor(device_ms).astype(np.int64) % TICK_MODULUS, arrival)


def feed(clock: TickClock, s: Sensor) -> list[ScanTime | None]:
    return [clock.feed(int(stamp), float(t)) for stamp, t in zip(s.stamps, s.arrival, strict=True)]


def errors_ms(times: list[ScanTime | None], s: Sensor) -> npt.NDArray[np.float64]:
    return np.array([1e3 * (when.t_mono - t) for when, t in zip(times, s.true, strict=True) if when is not None])


def check(times: list[ScanTime | None], s: Sensor, rms: float = 0.3) -> None:
    """Each scan within 1 ms, or within what it says itself; all of them within 0.3 ms RMS."""
    errors = errors_ms(times, s)
    sigmas = np.array([1e3 * when.t_sigma for when in times if when is not None])
    assert (np.abs(errors) < np.maximum(1.0, 3 * sigmas)).all()
    assert (sigmas > 1.0).sum() < 30
    assert np.sqrt(np.mean(errors**2)) < rms


NOMINAL = {0.02505: 0.025, 0.1002: 0.1, 0.025: 0.025, 0.1: 0.1, 0.100003: 0.1, 0.05: 0.05, 0.028: 0.028}


@pytest.mark.no_cover
@pytest.mark.parametrize("ppm", [-1000, -50, 0, 50, 1000])
@pytest.mark.parametrize("period_s", NOMINAL)
@pytest.mark.parametrize("seed", [pytest.param(seed, marks=share(seed, 2)) for seed in range(2)])
def test_stamps_are_right_to_a_fraction_of_the_millisecond(seed: int, ppm: float, period_s: float) -> None:
    """Every scan within 1 ms, 0.3 ms RMS, through a wrap, whatever the clock's rate and the period."""
    s = sensor(ppm=ppm, period_s=period_s, seconds=90, start_ms=TICK_MODULUS - 30_000, seed=seed)
    clock = s.clock(NOMINAL[period_s])
    times = feed(clock, s)
    assert None not in times
    errors = errors_ms(times, s)
    first_second = int(1.0 / period_s)  # an arrival or two cannot tell how late they are
    assert np.abs(errors[:first_second]).max() < 2.0
    assert np.abs(errors[first_second:]).max() < 1.0
    assert np.sqrt(np.mean(errors**2)) < 0.3
    assert clock.resets == 0
    assert all(when is not None and when.periods == 1 for when in times)
    assert clock.period_s == pytest.approx(period_s, rel=1e-3)


@pytest.mark.no_cover
@pytest.mark.parametrize("ppm", [pytest.param(ppm, marks=share(turn, 2)) for turn, ppm in enumerate((-1000, 1000))])
def test_three_wraps(ppm: float) -> None:
    """14 hours: every tenth revolution of a 10 Hz sensor."""
    s = sensor(ppm=ppm, period_s=1.002, seconds=3.1 * TICK_MODULUS / 1e3, start_ms=TICK_MODULUS - 100_000)
    assert (np.diff(s.stamps) < 0).sum() == 4
    clock = s.clock(1.0)
    times = feed(clock, s)
    assert None not in times
    check(times, s)
    assert clock.resets == 0
    assert clock.skew == pytest.approx(-1e-6 * ppm, abs=2e-5)


def test_sigma_covers_the_error() -> None:
    inside = total = 0
    for seed in range(30):
        s = sensor(ppm=200, seconds=4, seed=seed)
        for when, true in zip(feed(s.clock(0.025), s), s.true, strict=True):
            assert when is not None
            inside += abs(when.t_mono - true) < 2 * when.t_sigma
            total += 1
    assert inside / total > 0.95
    assert feed(s.clock(0.025), s)[0].t_sigma > 5e-3  # type: ignore[union-attr]  # the first is honest about itself
    assert feed(s.clock(0.025), s)[-1].t_sigma < 5e-4  # type: ignore[union-attr]  # checked above not to be None


def test_lost_revolutions_are_counted() -> None:
    s = sensor(seconds=10)
    keep = np.ones(len(s.true), bool)
    keep[[50, 51, 52, 100]] = False
    kept = Sensor(s.true[keep], s.stamps[keep], s.arrival[keep])
    times = feed(kept.clock(0.025), kept)
    assert sum(when.periods - 1 for when in times if when is not None) == 4
    assert np.abs(errors_ms(times, kept)).max() < 1.0


def test_a_damaged_stamp_is_dropped_and_changes_nothing() -> None:
    s = sensor(seconds=10)
    clean = feed(s.clock(0.025), s)
    for wrong in (0, 5, TICK_MODULUS - 1, int(s.stamps[200]) + 500, int(s.stamps[200]) - 12):
        hurt = Sensor(s.true, s.stamps.copy(), s.arrival)
        hurt.stamps[200] = wrong
        clock = s.clock(0.025)
        times = feed(clock, hurt)
        assert times[200] is None
        assert clock.resets == 0
        assert [t for i, t in enumerate(times) if i > 201] == [
            pytest.approx(c, abs=0) if c is None else c for i, c in enumerate(clean) if i > 201
        ] or np.abs(errors_ms(times, s)[190:]).max() < 0.3


RESETS: dict[str, Callable[[int], int]] = {
    "to zero": lambda stamp: 0,
    "to zero after hours": lambda stamp: 3,
    "a second back": lambda stamp: stamp - 1000,
    "less than a revolution back": lambda stamp: stamp - 12,
    "two seconds ahead": lambda stamp: stamp + 2000,
    "a fifth of a second ahead": lambda stamp: stamp + 207,
    "half way round": lambda stamp: (stamp + TICK_MODULUS // 2) % TICK_MODULUS,
}


@pytest.mark.parametrize("change", RESETS.values(), ids=RESETS)
@pytest.mark.parametrize("start_ms", [0.0, 9e6, TICK_MODULUS - 13_000])
def test_a_clock_that_restarts_costs_a_scan_and_never_a_wrong_time(
    change: Callable[[int], int], start_ms: float
) -> None:
    s = sensor(seconds=30, start_ms=start_ms)
    at = 600
    shift = change(int(s.stamps[at])) - int(s.stamps[at])
    s.stamps[at:] = (s.stamps[at:] + shift) % TICK_MODULUS
    clock = s.clock(0.025)
    times = feed(clock, s)
    assert clock.resets == 1
    assert [i for i, when in enumerate(times) if when is None] == [at]
    check(times, s)


def test_a_sensor_that_repeats_itself_is_stuck() -> None:
    s = sensor(seconds=5)
    clock = s.clock(0.025)
    feed(clock, s)
    last, t = int(s.stamps[-1]), float(s.arrival[-1])
    assert clock.feed(last, t + 0.025) is None
    assert not clock.stuck
    assert clock.feed(last, t + 0.05) is None
    assert clock.stuck
    assert clock.feed(last + 75, t + 0.075) is not None
    assert not clock.stuck


@pytest.mark.parametrize("stall_s", [0.3, 2.0, 25.0])
def test_a_stall_and_its_burst_move_nothing(stall_s: float) -> None:
    """Old scans that come late keep their own times; nothing is taken for a reset."""
    s = sensor(seconds=90)
    begin = s.arrival[1000]
    held = (s.arrival >= begin) & (s.arrival < begin + stall_s)
    s.arrival[held] = begin + stall_s
    clock = s.clock(0.025)
    times = feed(clock, s)
    assert None not in times
    assert clock.resets == 0
    check(times, s, rms=0.3 + 0.01 * stall_s)  # the rate learned before has to bridge it


@pytest.mark.parametrize("silence_s", [1.0, 60.0, 3600.0, 20_000.0])
def test_a_long_silence_keeps_the_clock(silence_s: float) -> None:
    """Even one longer than a whole turn of the 24 bits."""
    before, after = sensor(ppm=50, seconds=20, start_ms=1e7), sensor(ppm=50, seconds=20, start_ms=1e7)
    turns = round(silence_s / 0.02505)
    away = turns * 0.02505
    shifted = Sensor(
        after.true + away,
        np.floor(1e7 + 1e3 * (after.true - after.true[0] + away) * (1 + 50e-6)).astype(np.int64) % TICK_MODULUS,
        after.arrival + away,
    )
    clock = before.clock(0.025)
    feed(clock, before)
    keep = shifted.true > before.true[-1]
    rest = Sensor(shifted.true[keep], shifted.stamps[keep], shifted.arrival[keep])
    times = feed(clock, rest)
    assert clock.resets == 0
    assert None not in times
    check(times, rest)


@pytest.mark.parametrize("delay_s", [0.05, 0.3, 2.0])
@pytest.mark.parametrize("ppm", [-300, 50])
def test_a_lag_that_comes_at_once_is_a_queue_however_long_it_lasts(delay_s: float, ppm: float) -> None:
    """The motor goes on in step: a clock that was set would have broken its rhythm. It says how unsure it becomes."""
    s = sensor(seconds=120, ppm=ppm)
    s.arrival[(s.true > s.true[0] + 30) & (s.true < s.true[0] + 90)] += delay_s
    s.arrival[:] = np.maximum.accumulate(s.arrival)  # what was held up comes first
    clock = s.clock(0.025)
    times = feed(clock, s)
    assert clock.resets == 0
    assert None not in times
    errors = errors_ms(times, s)
    sigmas = np.array([1e3 * when.t_sigma for when in times if when is not None])
    assert (np.abs(errors) < np.maximum(1.0, 3 * sigmas)).all()
    assert np.abs(errors).max() < 6.0  # the rate, unseen for a minute
    assert np.abs(errors[-1000:]).max() < 1.0


@pytest.mark.parametrize("slow", [0.005, 0.015])
def test_a_lag_that_comes_slowly_is_a_clock(slow: float) -> None:
    """A rate beyond all that a clock may be off is followed by beginning anew, and not taken for a queue."""
    s = sensor(seconds=60, ppm=-1e6 * slow)
    clock = s.clock(0.025)
    times = feed(clock, s)
    assert clock.resets >= 1
    errors = np.array([when.t_mono - t for when, t in zip(times, s.true, strict=True) if when is not None])
    assert np.abs(errors).max() < 0.02 + 4.0 * slow + 0.01


@pytest.mark.parametrize("factor", [0.8, 0.9, 0.99, 1.01, 1.1, 1.5])
def test_a_motor_that_changes_its_speed(factor: float) -> None:
    rng = np.random.default_rng(1)
    periods = np.full(2000, 0.02505)
    periods[800:1400] *= factor
    true = 100.0 + np.concatenate([[0], np.cumsum(periods)])[:-1]
    arrival = true + SWEEP * periods + LINE_S + np.abs(rng.normal(0, 3e-4, len(true)))
    s = Sensor(true, np.floor(1e3 * true * (1 - 40e-6)).astype(np.int64), arrival)
    clock = s.clock(0.025)
    times = feed(clock, s)
    assert sum(when is None for when in times) <= 2
    assert clock.resets == 0
    errors = np.array([1e3 * (when.t_mono - t) if when else 0.0 for when, t in zip(times, s.true, strict=True)])
    assert np.abs(errors).max() < 4.0  # while it changes
    settled = np.r_[100:800, 950:1400, 1550:2000]  # four seconds later
    assert np.abs(errors[settled]).max() < 1.0


def test_wobble_of_a_real_motor() -> None:
    rng = np.random.default_rng(2)
    true = 100.0 + np.cumsum(0.1002 + rng.normal(0, 5e-5, 900))
    arrival = true + SWEEP * 0.1002 + LINE_S + np.abs(rng.normal(0, 3e-4, len(true)))
    s = Sensor(true, np.floor(1e3 * true).astype(np.int64), arrival)
    errors = errors_ms(feed(s.clock(0.1), s), s)
    assert np.abs(errors).max() < 1.2
    assert np.sqrt(np.mean(errors**2)) < 0.4


def test_times_only_ever_rise() -> None:
    """A backlog read at once at the start makes every scan look late: none is given the time of the one before."""
    s = sensor(seconds=5)
    s.arrival[:12] = s.arrival[12]
    times = [when.t_mono for when in feed(s.clock(0.025), s) if when is not None]
    assert len(times) > 180
    assert (np.diff(times) > 0).all()


def test_restart_forgets_the_other_connection() -> None:
    s, other = sensor(seconds=5), sensor(seconds=5, start_ms=123)
    clock = s.clock(0.025)
    feed(clock, s)
    clock.restart()
    later = Sensor(other.true + 1000, other.stamps, other.arrival + 1000)
    times = feed(clock, later)
    assert None not in times
    assert clock.resets == 0


@given(
    start=st.integers(0, TICK_MODULUS - 1),
    gap_s=st.floats(0.02, 40_000),
    late_s=st.floats(0, 0.4),
)
def test_unwrapping_any_gap(start: int, gap_s: float, late_s: float) -> None:
    unwrapper = Unwrapper(25.0)
    assert unwrapper.feed(start, 0.0, 0.0, 0.0, 0.0) is Verdict.GOOD
    true = start + math.floor(1e3 * gap_s)
    newest = true + 1e3 * late_s
    verdict = unwrapper.feed(true % TICK_MODULUS, gap_s + late_s, newest, 500.0, 0.0)
    if true % TICK_MODULUS == start and gap_s + late_s < TICK_MODULUS / 2e3:
        assert verdict is Verdict.REPEATED
    else:
        assert verdict is Verdict.GOOD
        assert unwrapper.last == true


@given(
    st.lists(st.tuples(st.floats(0.02, 0.3), st.floats(0, 2e-3)), min_size=2, max_size=200),
    st.floats(-1e-3, 1e-3),
)
def test_the_envelope_lies_under_every_point_and_touches_one(points: list[tuple[float, float]], rate: float) -> None:
    envelope = Envelope(0.025)
    x = 0.0
    seen: list[tuple[float, float]] = []
    for dx, late in points:
        x += dx
        delay = 7.0 + rate * x + late
        excess = envelope.feed(x, delay)
        assert excess >= 0.0
        seen.append((x, delay))
        assert delay - envelope.delay(x) >= -1e-9
    span = x - seen[0][0]
    if span < 25:
        gaps = [delay - envelope.delay(at) for at, delay in seen]
        assert min(gaps) > -1.5e-3 * 0.25 - 2e-3  # within a quarter second only the lowest point is kept
        assert min(gaps) < 1e-9


def test_a_lag_soon_after_the_start_does_not_lead_the_stamps_off() -> None:
    """Four seconds tell the way's jitter, not the clock's rate: by that slope stamps came to be 55 ms early."""
    earliest = 0.0
    for seed in range(40):
        rng, envelope = np.random.default_rng(seed), Envelope(0.2)
        for x in np.arange(0.0, 60.0, 0.2).tolist():
            delay = 0.010 + (0.032 if x > 4.0 else 0.0) + float(rng.exponential(0.004))
            envelope.feed(x, delay)
            earliest = min(earliest, envelope.delay(x) - 0.010)
    assert earliest > -0.010

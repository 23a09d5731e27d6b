"""The lag of the laser's stamps against the wheels': found where turns begin and end, and nowhere else."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion import time_offset
from estimator.fusion.time_offset import DEPTH, LAGS, TimeOffset
from estimator.measurements import UNLIMITED, Array, Beam, Command, Odometry, Order, Scan
from estimator.pipeline import Settings, new_state, step
from estimator.result import Lag, MatchResult, Reason
from tests.estimator.driven import records
from tools.sim.scene import Scenario, SimulatedScene

pytestmark = pytest.mark.no_cover

DT = 0.002
SECONDS = 40.0
Rate = Callable[[np.random.Generator, Array], Array]


def turns(rng: np.random.Generator, t: Array) -> Array:
    """Turn rate (n,) of a drive: turns of any rate, length and briskness, and straight ways between them."""
    rate, begin = np.zeros(len(t)), rng.uniform(0.5, 3.0)
    while begin < t[-1] - 4.0:
        brisk, turn, lasts = rng.uniform(0.5, 4.0), rng.uniform(0.2, 1.5), rng.uniform(0.5, 3.0)
        end = begin + lasts + 2.0 * turn / brisk
        ramps = np.minimum((t - begin) * brisk, (end - t) * brisk)
        rate += rng.choice([-1.0, 1.0]) * np.clip(ramps, 0.0, turn)
        begin = end + rng.uniform(0.0, 4.0)
    return rate


def straight(rng: np.random.Generator, t: Array) -> Array:
    return np.zeros(len(t))


def even(rng: np.random.Generator, t: Array) -> Array:
    return np.full(len(t), 0.8)


def weaving(rng: np.random.Generator, t: Array) -> Array:
    return 0.5 * np.sin(2.0 * np.pi * rng.uniform(0.3, 2.0) * t)


def match_of(yaw: float, reason: Reason = Reason.CONVERGED) -> MatchResult:
    T, held = np.array((0.0, 0.0, math.remainder(yaw, 2.0 * math.pi))), np.diag((1e6, 1e6, 1e6))
    return MatchResult(T, held, 300, 361, 5, 0.01, np.ones(3), np.zeros(3), reason)


def scan_of(t_end: float) -> Scan:
    nothing = np.empty(0)
    return Scan(t_end, t_end, 0, np.zeros(3), nothing, nothing, np.full(0, np.uint8(Beam.NONE)), 0.01)


class Drive:
    """A robot that turns; what its wheels and its laser say of it goes into a `TimeOffset` in order of arrival.

    Attributes:
        told: the lag after each scan.
    """

    def __init__(self, seed: int, rate: Rate = turns, slip: float = 0.0, slips_hz: float = 0.5, scale: float = 0.0):
        self.rng = rng = np.random.default_rng((seed, 7))
        self.t = np.arange(0.0, SECONDS, DT)
        true = rate(rng, self.t)
        wheels = true * (scale or 1.0 + 0.03 * rng.standard_normal())
        at = rng.exponential(1.0 / slips_hz)
        while slip and at < SECONDS:
            lasts = rng.uniform(0.05, 0.6)
            much = rng.choice([-1.0, 1.0]) * slip * rng.exponential() / lasts
            wheels = wheels + ((self.t >= at) & (self.t < at + lasts)) * much
            at += rng.exponential(1.0 / slips_hz)
        self.yaw, self.wheels = np.cumsum(true) * DT, np.cumsum(wheels) * DT
        self.lag = TimeOffset()
        self.told: list[Lag | None] = []
        self.read: tuple[float, float] | None = None

    def go(self, late_s: float, hz: float = 10.0, noise: float = 0.0015, wheels_hz: float = 50.0, jitter: float = 0.0,
           span: tuple[float, float] = (0.1, SECONDS)) -> list[Lag]:  # fmt: skip
        """Stamp scans late by so much (negative: the wheels), both unevenly by ``jitter``; every lag that was told."""
        read = np.arange(*span, 1.0 / wheels_hz)
        counted = np.floor(np.interp(read, self.t, self.wheels) / 5e-4) * 5e-4
        read = np.maximum.accumulate(read + max(0.0, -late_s) + jitter * self.rng.uniform(0.0, 1.0, len(read)))
        seen = np.arange(*span, 1.0 / hz)
        yaw = np.interp(seen, self.t, self.yaw) + noise * self.rng.standard_normal(len(seen))
        seen += max(0.0, late_s) + jitter * self.rng.uniform(0.0, 1.0, len(seen))
        heard = [(t, False, k) for k, t in enumerate(read)] + [(t, True, k) for k, t in enumerate(seen)]
        for t, laser, k in sorted(heard):
            if laser:
                time_offset.on_match(self.lag, scan_of(t), match_of(yaw[k]))
                self.told.append(self.lag.told)
                continue
            if self.read is not None:
                made = np.array((0.01, 0.0, counted[k] - self.read[1]))
                time_offset.on_odometry(self.lag, Odometry(self.read[0], t, made))
            self.read = t, counted[k]
        return [told for told in self.told if told is not None]


@pytest.mark.parametrize("late_s", [0.15, 0.3, 0.5, -0.2])
@pytest.mark.parametrize("seed", range(4))
def test_a_lag_is_found_in_any_drive_with_turns(seed: int, late_s: float) -> None:
    drive = Drive(seed)
    told = drive.go(late_s)
    assert len(told) > 0.5 * len(drive.told), "from the first turns on"
    assert all(abs(one.lag_s - late_s) < min(0.02, 4.0 * one.sigma_s) for one in told)


@pytest.mark.parametrize(
    "said", [{"hz": 40.0}, {"noise": 0.004}, {"wheels_hz": 1000.0}, {"wheels_hz": 20.0}, {"jitter": 0.02}]
)
def test_whatever_the_devices_are_like(said: dict[str, float]) -> None:
    told = Drive(1).go(0.3, **said)  # type: ignore[arg-type]  # test shorthand
    assert told
    assert all(abs(one.lag_s - 0.3) < 0.03 for one in told)


def test_wheels_of_another_size_tell_it_too() -> None:
    told = Drive(2, scale=1.5).go(0.3)
    assert told
    assert all(abs(one.lag_s - 0.3) < 0.02 for one in told)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    ("made", "said"),
    [
        ({}, {"late_s": 0.0}),
        ({}, {"late_s": 0.05}),
        ({}, {"late_s": 0.0, "noise": 0.02}),
        ({}, {"late_s": 0.0, "jitter": 0.1}),
        ({}, {"late_s": 0.0, "wheels_hz": 2.5}),
        ({"slip": 0.1}, {"late_s": 0.0}),
        ({"slip": 1.0}, {"late_s": 0.0}),
        ({"slip": 0.2, "slips_hz": 2.0}, {"late_s": 0.0}),
        ({"rate": weaving}, {"late_s": 0.0}),
        ({"rate": straight}, {"late_s": 0.3}),
        ({"rate": straight, "slip": 0.3}, {"late_s": 0.3}),
        ({"rate": even}, {"late_s": 0.3}),
    ],
)
def test_none_is_found_where_there_is_none_or_nothing_to_see(
    seed: int, made: dict[str, float], said: dict[str, float]
) -> None:
    assert Drive(seed, **made).go(**said) == []  # type: ignore[arg-type]  # test shorthand


@pytest.mark.parametrize(
    ("slip", "slips_hz", "seed"),
    [(0.3, 0.5, 31), (0.5, 0.25, 8), (1.0, 0.5, 153), (0.3, 0.5, 94), (1.0, 0.5, 169), (0.5, 0.25, 74)],
)
def test_slip_that_looks_like_a_lag_is_none(slip: float, slips_hz: float, seed: int) -> None:
    """Of 600 drives, those that tell one where eight scans may not be left out, or where more may be left over."""
    assert Drive(seed, slip=slip, slips_hz=slips_hz).go(0.0) == []


def test_a_single_slip_that_looks_like_a_lag_is_none_and_a_turn_begun_and_ended_late_is() -> None:
    def once(rng: np.random.Generator, t: Array) -> Array:
        return np.clip(t - 5.0, 0.0, 0.9) * (t < 20.0) + np.clip(20.9 - t, 0.0, 0.9) * (t >= 20.0)

    drive = Drive(0, once)
    drive.wheels = np.interp(drive.t + 0.3, drive.t, drive.yaw)  # the body follows the wheels after 0.3 s
    assert drive.go(0.0, span=(0.1, 15.0)) == []
    assert drive.go(0.0, span=(15.02, 30.0))


def test_a_lag_that_has_gone_is_told_no_more_after_the_next_turns() -> None:
    drive = Drive(3)
    drive.go(0.15, span=(0.1, 20.0))
    assert drive.lag.told is not None
    count = len(drive.told)
    drive.go(0.0, span=(20.02, SECONDS))
    assert None in drive.told[count : count + 100]
    assert drive.told[-1] is None


def told() -> TimeOffset:
    """A lag that is told, at 30 s, and wheels that have come as far."""
    drive = Drive(3)
    drive.go(0.3, span=(0.1, 30.0))
    assert drive.lag.told is not None
    return drive.lag


def test_silences_and_stamps_that_go_back_end_what_was_known() -> None:
    lag = told()
    t = float(lag.times[lag.points - 1])
    time_offset.on_match(lag, scan_of(lag.newest - 1.0), match_of(0.0, Reason.LATE))
    assert lag.told is None, "stamps have been set"
    lag = told()
    time_offset.on_match(lag, scan_of(t + 2.5), match_of(0.0))
    assert lag.told is None, "the wheels are silent"
    lag = told()
    silent_from, newest = 0.0, lag.newest
    for begin in np.arange(t, newest + 2.5, 0.05):
        time_offset.on_odometry(lag, Odometry(begin, begin + 0.05, np.zeros(3)))
        silent_from = silent_from or (lag.told is None) * (begin + 0.05)
    assert silent_from == pytest.approx(newest + 2.025, abs=0.03), "the laser is silent"


@pytest.mark.parametrize(
    "reading",
    [
        Odometry(29.5, 30.5, np.zeros(3)),
        Odometry(30.2, 30.3, np.zeros(3)),
        Odometry(math.nan, math.nan, np.zeros(3)),
        Odometry(29.98, 30.0, np.array((0.0, 0.0, math.nan))),
    ],
)
def test_a_gap_of_the_wheels_ends_what_was_known(reading: Odometry) -> None:
    lag = told()
    time_offset.on_odometry(lag, reading)
    assert lag.told is None
    assert not lag.sums.any()


def test_scans_that_do_not_match_are_left_out() -> None:
    lag = TimeOffset()
    for k in range(200):
        time_offset.on_odometry(lag, Odometry(0.05 * k, 0.05 * (k + 1), np.array((0.0, 0.0, 0.1 * math.sin(k)))))
        time_offset.on_match(lag, scan_of(0.05 * k), match_of(0.1 * k, Reason.REJECTED))
    assert not lag.own.any()
    assert lag.before is not None


def test_what_is_kept_is_bounded_whatever_comes() -> None:
    lag = TimeOffset()
    for k in range(20000):
        time_offset.on_odometry(lag, Odometry(1e-3 * k, 1e-3 * (k + 1), np.zeros(3)))
        if k % 2:
            time_offset.on_match(lag, scan_of(1e-3 * k), match_of(0.0, Reason.REJECTED if k % 3 else Reason.CONVERGED))
        assert lag.points <= 2 * DEPTH
        assert len(lag.waiting) <= DEPTH
    assert lag.times[lag.points - 1] - lag.times[0] > 2.5 > LAGS[-1] - LAGS[0]
    assert np.all(np.diff(lag.times[: lag.points]) > 0.0)


@pytest.mark.jit
@pytest.mark.parametrize(("seed", "late_s"), [(1, 0.0), (2, 0.0), (1, 0.3), (2, 0.3)])
def test_the_estimator_tells_the_lag_of_a_simulated_robot_and_none_of_a_good_one(seed: int, late_s: float) -> None:
    state, told = new_state(Settings()), []
    for _, found in records(SimulatedScene(Scenario(seed=seed)), 30.0, 10.0, odometry=True):
        *wheels, scan = found
        assert isinstance(scan, Scan)
        late = replace(scan, t_begin=scan.t_begin + late_s, t_end=scan.t_end + late_s)
        told.append(step(state, [*wheels, late], UNLIMITED).lag)
    assert (told[-1] is not None) == bool(late_s)
    assert all(one is None or abs(one.lag_s - late_s) < 0.03 for one in told)
    if late_s:
        step(state, [Command(state.motion.t_mono, Order.RESET)], UNLIMITED)
        assert step(state, [], UNLIMITED).lag is None

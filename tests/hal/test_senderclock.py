"""The time of readings that another computer stamps: what is late is dated back, and no clock does harm."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.arrival import MAX_AGE_S
from hal.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, InputDatagram, encode
from hal.senderclock import FIRST_S, WINDOW_S, SenderClock
from tests.hal.test_inputs import Listening

AHEAD_S = 1.7e9
"""The sender's clock, of some year, against one that began when the computer was switched on."""


def told(
    seconds: float, late: Callable[[float], float], read: Callable[[float], float], rate_hz: float = 50.0
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) when readings were true and what `SenderClock` said, after so much lateness, by such a clock."""
    clock, true = SenderClock(), np.arange(0.0, seconds, 1.0 / rate_hz)
    return true, np.array([clock.when(read(t), t + late(t)) for t in true.tolist()])


def test_what_the_network_has_held_up_is_dated_back() -> None:
    rng = np.random.default_rng(3)
    held = np.where(rng.random(3000) < 0.1, rng.uniform(0.01, 0.2, 3000), rng.uniform(0.0, 0.0004, 3000))
    true, said = told(60.0, lambda t: 0.002 + float(held[round(50 * t)]), lambda t: AHEAD_S + t * (1.0 + 5e-5))
    off = (said - true - 0.002)[100:]
    assert np.abs(off).max() < 0.0015
    assert held[100:].max() > 0.19  # by which it would be off otherwise


def test_all_that_comes_after_a_stall_is_told_apart() -> None:
    true, said = told(20.0, lambda t: 0.001 + (11.0 - t if 10.5 < t < 11.0 else 0.0), lambda t: t)
    assert np.abs(said - true - 0.001)[150:].max() < 0.001


@pytest.mark.parametrize("tick_s", [0.001, 0.005, 1.0 / 64.0, 0.02])
def test_a_clock_that_ticks_coarsely_does_no_harm(tick_s: float) -> None:
    true, said = told(20.0, lambda t: 0.001, lambda t: math.floor((t + 1e-9) / tick_s) * tick_s, rate_hz=47.0)
    late = (true + 0.001 - said)[250:]
    assert late.max() < 0.2 * tick_s + 1e-4
    assert (true + 0.001 - said).max() <= tick_s


@pytest.mark.parametrize(
    "read",
    [lambda t: 0.0, lambda t: -t, lambda t: 1000.0 * t, lambda t: math.floor(t), lambda t: 5.0 * math.sin(40.0 * t)],
    ids=["stands", "runs backward", "in milliseconds", "in whole seconds", "to and fro"],
)
def test_a_clock_that_is_none_leaves_the_arrival(read: Callable[[float], float]) -> None:
    true, said = told(10.0, lambda t: 0.001, read)
    assert np.abs(said - true - 0.001).max() < 2.0 * FIRST_S


@pytest.mark.parametrize("by", [0.3, -0.3, -5.0, 3600.0])
def test_a_clock_that_is_set_is_believed_soon(by: float) -> None:
    true, said = told(30.0, lambda t: 0.001, lambda t: t + (by if t > 15.0 else 0.0))
    off = np.abs(said - true - 0.001)
    assert off[true > 15.0 + WINDOW_S + 0.1].max() < 0.001
    assert off[true < 15.0].max() < 0.001
    assert off.max() <= abs(by) + 0.001


@pytest.mark.parametrize("rate", [1.001, 0.999, 0.9])
def test_a_clock_that_drifts_is_followed(rate: float) -> None:
    true, said = told(60.0, lambda t: 0.001, lambda t: rate * t)
    assert np.abs(said - true - 0.001)[true > 10.0].max() < 0.005


@given(st.lists(st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.floats(0.0, 1e6)), max_size=60))
def test_a_reading_is_never_from_the_future_nor_older_than_is_believed(came: list[tuple[float, float]]) -> None:
    clock, t = SenderClock(), 0.0
    for time, after in came:
        t += after
        assert t - MAX_AGE_S <= clock.when(time, t) <= t


@pytest.mark.parametrize("magic", [ODOMETRY_MAGIC, IMU_MAGIC])
def test_another_computers_reading_that_comes_late_keeps_its_time(magic: bytes) -> None:
    heard = Listening()

    def take(seq: int, late: float) -> None:
        values = (0.0, 0.0, 0.0) if magic == ODOMETRY_MAGIC else (0.0,)
        heard.port.take(encode(InputDatagram(magic, 1, seq, 0, 5.0 + 0.02 * seq, values)), 100.0 + 0.02 * seq + late)

    for seq in range(200):
        take(seq, 0.0)
    take(200, 0.07)
    reading = (heard.odometry or heard.imu)[-1]
    assert reading.t_rx == pytest.approx(104.07)
    assert reading.t_mono == pytest.approx(104.0, abs=0.001)


def test_a_sender_that_restarts_is_followed_by_its_own_clock() -> None:
    heard = Listening()
    for seq in range(100):
        heard.port.take(encode(InputDatagram(ODOMETRY_MAGIC, 1, seq, 0, 0.02 * seq, (0.0, 0.0, 0.0))), 0.02 * seq)
    heard.port.take(encode(InputDatagram(ODOMETRY_MAGIC, 2, 0, 0, 3.5, (0.0, 0.0, 0.0))), 5.0)
    assert heard.odometry[-1].t_mono == 5.0

"""The time of readings that another computer stamps: what is held up is dated back, and no clock does harm."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, InputDatagram, encode
from hal.net.rx_timestamp import MAX_AGE_S
from hal.net.sender_clock import LASTS_S, SenderClock
from tests.hal.net.test_inputs import Listening

AHEAD_S = 1.7e9
"""The sender's clock, of some year, against one that began when the computer was switched on."""
WAY_S = 0.001
Clock = Callable[[float], float]


def itself(t: float) -> float:
    return AHEAD_S + t


def told(read: Clock, came: Clock, rate_hz: float = 50.0, seconds: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """(n,) by how much each reading is measured to be younger than it is, and when it was true; s.

    ``read``: the sender's clock. ``came``: when the one that was true then came, the way of the data not counted.
    """
    clock, true = SenderClock(), np.arange(0.0, seconds, 1.0 / rate_hz)
    arrived = np.maximum.accumulate([came(t) + WAY_S for t in true.tolist()])
    measured = [clock.measured_at(read(t), t_rx) for t, t_rx in zip(true.tolist(), arrived.tolist(), strict=True)]
    return np.array(measured) - true - WAY_S, true


def stall(seconds: float, since: float = 10.0) -> Clock:
    """Nothing comes for so long, then all at once."""
    return lambda t: since + seconds if since < t < since + seconds else t


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0, 1000.0])
@pytest.mark.parametrize("seconds", [0.25, 0.5, 0.95])
def test_what_comes_after_a_stall_keeps_its_time(seconds: float, rate_hz: float) -> None:
    late, _ = told(itself, stall(seconds), rate_hz, seconds=15.0)
    assert np.abs(late).max() < (0.051 if rate_hz < 10.0 else 1e-6)  # at 5 Hz 0.25 s is no gap


def test_after_a_stall_that_is_longer_than_is_believed_times_go_on_all_the_same() -> None:
    late, true = told(itself, stall(2.5))
    assert late.max() == pytest.approx(2.5 - MAX_AGE_S, abs=0.03)
    assert np.all(np.diff(late + true) >= 0.0)
    assert np.abs(late[true > 12.6]).max() < 1e-6


def test_readings_that_are_held_up_one_by_one() -> None:
    rng = np.random.default_rng(3)
    held = np.where(rng.random(1500) < 0.1, rng.uniform(0.011, 0.2, 1500), rng.uniform(0.0, 0.0004, 1500))
    by_arrival, _ = told(lambda t: 0.0, lambda t: t + float(held[round(50 * t)]))
    late, _ = told(itself, lambda t: t + float(held[round(50 * t)]))
    assert np.quantile(by_arrival, 0.95) > 0.1
    assert np.quantile(np.abs(late), 0.95) < 0.011
    assert np.quantile(np.abs(late), 0.9) < 0.001


def test_readings_that_are_sent_together_keep_their_times() -> None:
    by_arrival, _ = told(lambda t: 0.0, lambda t: math.ceil(10.0 * t - 1e-9) / 10.0, 50.0)
    late, true = told(itself, lambda t: math.ceil(10.0 * t - 1e-9) / 10.0, 50.0)
    assert by_arrival.max() > 0.07
    assert np.abs(late[true > 1.0]).max() < 0.001


@pytest.mark.parametrize(
    "read",
    [
        lambda t: 0.0,
        lambda t: -t,
        lambda t: 1000.0 * t,
        math.floor,
        lambda t: 5.0 * math.sin(40.0 * t),
        lambda t: 0.5 * t,
        lambda t: 0.7 * t,
        lambda t: t - 0.083 * min(max(t - 5.0, 0.0), 1.2),
        lambda t: t - min(max(t - 5.0, 0.0), 0.1),
        lambda t: t - min(max(t - 5.0, 0.0), 0.9),
        lambda t: t + (0.3 if t > 15.0 else 0.0),
        lambda t: t - (0.3 if t > 15.0 else 0.0),
        lambda t: t - (5.0 if t > 15.0 else 0.0),
        lambda t: t + (3600.0 if t > 15.0 else 0.0),
    ],
    ids=[
        "stands", "runs backward", "in milliseconds", "in whole seconds", "to and fro", "at half rate", "at 0.7",
        "slewed by 8 %", "stops for 0.1 s", "stops for 0.9 s", "set on by 0.3 s", "set back by 0.3 s",
        "set back by 5 s", "set on by an hour",
    ],
)  # fmt: skip
@pytest.mark.parametrize("rate_hz", [5.0, 50.0, 1000.0])
def test_a_clock_that_does_something_else_leaves_the_arrival(read: Clock, rate_hz: float) -> None:
    late, _ = told(read, lambda t: t, rate_hz, seconds=20.0)
    assert np.abs(late).max() < 1e-6


@pytest.mark.parametrize("tick_s", [0.001, 0.005, 0.01, 1.0 / 64.0, 0.02, 0.1])
@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 47.0, 50.15, 200.0])
def test_a_clock_that_ticks_coarsely_does_no_harm(tick_s: float, rate_hz: float) -> None:
    late, _ = told(lambda t: math.floor((t + 1e-9) / tick_s) * tick_s, lambda t: t, rate_hz)
    assert np.abs(late).max() < 1e-6


def test_a_way_that_has_become_longer_is_believed_soon() -> None:
    late, true = told(itself, lambda t: t + (0.2 if t > 10.0 else 0.0))
    assert np.abs(late[true <= 10.0 + LASTS_S - 0.05]).max() < 1e-6
    assert late[true > 10.0 + LASTS_S + 0.05] == pytest.approx(0.2)


def test_an_arrival_that_was_stamped_too_early_dates_nothing_back_for_long() -> None:
    clock, true = SenderClock(), np.arange(0.0, 30.0, 0.02)
    arrived = true + WAY_S
    arrived[600] -= 0.5
    measured = [clock.measured_at(itself(t), t_rx) for t, t_rx in zip(true.tolist(), arrived.tolist(), strict=True)]
    off = np.array(measured) - true - WAY_S
    assert np.sum(off[601:] < -0.001) < 20
    assert off[601:].min() > -0.025


numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(st.lists(st.tuples(numbers | st.floats(0.0, 10.0), st.floats(0.0, 1e6) | st.floats(0.0, 0.1)), max_size=60))
def test_a_reading_is_never_from_the_future_nor_before_another(came: list[tuple[float, float]]) -> None:
    clock, t, measured = SenderClock(), 0.0, list[float]()
    for time, after in came:
        t += after
        measured.append(clock.measured_at(time, t))
        assert t - MAX_AGE_S <= measured[-1] <= t
    assert all(a <= b for a, b in pairwise(measured))


@pytest.mark.parametrize("magic", [ODOMETRY_MAGIC, IMU_MAGIC])
def test_another_computers_reading_that_comes_late_keeps_its_time(magic: bytes) -> None:
    listening = Listening()

    def take(seq: int, late: float) -> None:
        values = (0.0, 0.0, 0.0) if magic == ODOMETRY_MAGIC else (0.0,)
        listening.port.receive(
            encode(InputDatagram(magic, 1, seq, 0, 5.0 + 0.02 * seq, values)), 100.0 + 0.02 * seq + late
        )

    for seq in range(200):
        take(seq, 0.0)
    take(200, 0.07)
    reading = (listening.odometry or listening.imu)[-1]
    assert reading.t_rx == pytest.approx(104.07)
    assert reading.t_mono == pytest.approx(104.0)


def test_a_sender_that_restarts_is_followed_by_its_own_clock() -> None:
    """The second one's clock is 1 s ahead of where the first one's would be: no gap of the network's."""
    listening = Listening()

    def take(session: int, seq: int, time: float, t_rx: float) -> None:
        listening.port.receive(encode(InputDatagram(ODOMETRY_MAGIC, session, seq, 0, time, (0.0, 0.0, 0.0))), t_rx)

    for seq in range(100):
        take(1, seq, 0.02 * seq, 0.02 * seq)
    take(2, 0, 2.5, 4.0)
    assert listening.odometry[-1].t_mono == 4.0

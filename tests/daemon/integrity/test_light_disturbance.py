"""Disturbances of the light are logged once, when they last, by the name that a person knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daemon.integrity.light_disturbance import LASTS_S, OVER_S, LightDisturbances
from estimator.cdma.epoch import BlockFlag, PwmLight
from estimator.result import Fix, LightsResult

ZERO = np.zeros((3, 3))
CLEAR = LightsResult(0.0, Fix.GOOD, np.zeros(3), ZERO, (), frozenset(), ZERO, np.zeros(3))
PWM = replace(CLEAR, pwm=(PwmLight(1000.3, 4.99e-6),))


def see(watch: LightDisturbances, begin: float, seconds: float, lights: LightsResult) -> float:
    for t in np.arange(begin, begin + seconds, 0.05).tolist():
        watch.on_result(t, lights)
    return begin + seconds


@pytest.mark.parametrize(
    ("lights", "words"),
    [
        (PWM, "a PWM lamp of 1.0 kHz, 5 uA"),
        (replace(CLEAR, pwm=(PwmLight(237.2, 0.5e-6),)), "a PWM lamp of 237 Hz, 0.5 uA"),
        (replace(CLEAR, pwm=(PwmLight(15e3, 2e-6, 7.2e3),)), "a PWM lamp of 15.0 kHz or 7.2 kHz, 2 uA"),
        (replace(CLEAR, slow=frozenset({17})), "the lamp with code 17 rises too slowly"),
        (replace(CLEAR, block=BlockFlag.OVERDRIVEN), "first stage is saturated part of the time"),
        (replace(CLEAR, block=BlockFlag.UNEVEN), "bus pauses at the same samples"),
    ],
)
def test_what_lasts_is_logged_once(lights: LightsResult, words: str, caplog: pytest.LogCaptureFixture) -> None:
    watch = LightDisturbances()
    t = see(watch, 10.0, 0.5 * LASTS_S, lights)
    assert caplog.text == ""
    t = see(watch, t, 3.0 * LASTS_S, lights)
    t = see(watch, t, 2.0, CLEAR)
    see(watch, t, 10.0, lights)
    assert caplog.text.count(words) == 1


def test_after_a_long_time_it_is_logged_again(caplog: pytest.LogCaptureFixture) -> None:
    watch = LightDisturbances()
    t = see(watch, 10.0, 2.0 * LASTS_S, PWM)
    t = see(watch, t, OVER_S + 1.0, CLEAR)
    see(watch, t, 2.0 * LASTS_S, PWM)
    assert caplog.text.count("PWM lamp") == 2

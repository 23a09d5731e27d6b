"""The light simulator against brute force and theory: code edges, filter and converter noise."""

import numpy as np
import pytest

from tools.sim.light.transmitter import SYNC, Lamp, code_bits
from tools.sim.light.waveform import ELECTRON, Ambient, Ceiling, Receiver

DARK = Ambient(current_a=0.0)
QUIET = Receiver(bits=24, enob=24.0, thermal_a=0.0, full_scale_a=1e-4)


def level(lamp: Lamp, t: np.ndarray) -> np.ndarray:
    """Photocurrent before all filters, straight from the definition."""
    chip = np.floor(t * 5000.0 * (1 + 1e-6 * lamp.ppm) + lamp.phase_chips).astype(int)
    first_half = (t * 5000.0 * (1 + 1e-6 * lamp.ppm) + lamp.phase_chips) % 1.0 < 0.5
    bits = (
        np.array(code_bits(7, lamp.code))[chip % 127]
        ^ np.array([int(b) for b in lamp.frame()])[chip // 127 % len(lamp.frame())]
    )
    bright = first_half == (bits == 0)
    return lamp.current_a * np.where(bright, 1.3, 0.7)


def test_edges_are_the_manchester_code() -> None:
    lamp = Lamp(code=5, current_a=2e-6, ppm=30.0, phase_chips=17.3, lamp_id=9)
    when, jump = lamp.edges(0.0, 0.3, 5000.0, 7)
    t = np.linspace(0.001, 0.299, 4001)
    assert np.min(np.abs(t[:, None] - when)) > 1e-9
    summed = np.array([jump[when < moment].sum() for moment in t])
    np.testing.assert_allclose(summed, level(lamp, t), atol=1e-15)
    assert len(set(code_bits(7, 5))) == 2
    assert lamp.frame().startswith(SYNC)


def test_samples_are_the_filtered_steps() -> None:
    """Dense numerical integration of the same chain: lamp rise, Butterworth low-pass, AC coupling."""
    lamp = Lamp(code=77, current_a=3e-6, ppm=-20.0, phase_chips=3.3, data=False)
    ceiling = Ceiling([lamp], DARK, QUIET)
    block = ceiling.block(2.0, 60)
    got = (block.words / 2**24 - 0.5) * 1e-4
    rx, dt = ceiling.receiver, 1e-7
    t = np.arange(2.0 - 0.055, block.t_sample[-1] + dt, dt)
    low, high = 2 * np.pi * rx.lpf_hz, 2 * np.pi * rx.hpf_hz
    light, a, b, slow, out = level(lamp, t), 0.0, 0.0, 0.0, np.empty_like(t)
    led = 0.0
    for k, value in enumerate(light):
        led += dt / rx.led_tau_s * (value - led)
        b += dt * (low**2 * (led - a) - np.sqrt(2) * low * b)
        a += dt * b
        slow += dt * high * (a - slow)
        out[k] = a - slow
    np.testing.assert_allclose(got, np.interp(block.t_sample, t, out), atol=1.5e-8)
    assert np.ptp(got) > 1.5e-6


@pytest.mark.parametrize(("enob", "expected_lsb"), [(12.0, 1 / np.sqrt(12)), (11.3, 2**0.7 / np.sqrt(12))])
def test_noise_is_that_of_the_converter(enob: float, expected_lsb: float) -> None:
    ambient = Ambient(current_a=79e-6, flicker=0.0, mains_hz=100.0, flicker_a=0.3e-6, harmonics=(1.0,))
    ceiling = Ceiling([], ambient, Receiver(enob=enob))
    words = ceiling.block(0.0, 4444).words
    n = np.arange(4444)
    tone = np.exp(2j * np.pi * 100 * n / 22222.222)
    rows = np.array([np.ones(4444), tone.real, tone.imag]).T
    left = words - rows @ np.linalg.lstsq(rows, words, rcond=None)[0]
    shot_lsb = np.sqrt(ELECTRON * 79e-6 * 22222) / ceiling.receiver.full_scale_a * 4096
    assert left.std() == pytest.approx(np.hypot(expected_lsb, shot_lsb), rel=0.1)

"""The light simulator against brute force and against what theory says of codes, filters and noise."""

from __future__ import annotations

import numpy as np
import pytest

from tools.sim.light.transmitter import SYNC, Lamp, code_bits
from tools.sim.light.waveform import ELECTRON, Ambient, Bus, Ceiling, Receiver

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


def test_a_stall_delays_all_that_follows() -> None:
    lamp = Lamp(code=3, current_a=3e-6)
    whole, stalled = (Ceiling([lamp], DARK, QUIET).block(1.0, 300, stalls) for stalls in ((), ((100, 50e-6),)))
    np.testing.assert_array_equal(whole.words[:100], stalled.words[:100])
    assert stalled.t1 - whole.t1 == pytest.approx(50e-6, abs=1e-9)
    late = Ceiling([lamp], DARK, QUIET).block(1.0 + 50e-6, 300)
    np.testing.assert_allclose(late.words[100:], stalled.words[100:], atol=2.0)


def test_flicker_passes_the_filters_as_a_sinusoid() -> None:
    ambient = Ambient(current_a=10e-6, flicker=0.2, harmonics=(1.0,))
    block = Ceiling([], ambient, QUIET).block(0.0, 4444)
    spectrum = np.fft.rfft(block.words - block.words.mean()) / 2222
    at = np.argmax(np.abs(spectrum))
    assert at == round(100 * 4444 / 22222.2)
    assert np.abs(spectrum[at]) * 1e-4 / 2**24 == pytest.approx(2e-6 / np.hypot(1, 0.5), rel=0.01)


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


def test_words_clip_at_the_rails() -> None:
    words = Ceiling([], Ambient(current_a=300e-6, flicker=0.2)).block(0.0, 1111).words
    assert words.min() == 0
    assert words.max() == 4095


def test_the_bus_is_as_slow_as_it_says_and_stamps_are_outside() -> None:
    block = Ceiling([], bus=Bus(scl_error=0.01)).block(5.0, 1111)
    assert np.diff(block.t_sample) == pytest.approx(18 / 404e3)
    assert block.t0 < 5.0 < block.t_sample[0] < block.t_sample[-1] < block.t1 < block.t_sample[-1] + 150e-6


def test_truth_follows_a_lamp_that_grows() -> None:
    lamp = Lamp(code=1, current_a=1e-6, slope_a_s=1e-6)
    block = Ceiling([lamp], DARK).block(2.0, 1111)
    assert block.truth_a[0] == pytest.approx(0.3 * 3.025e-6, rel=1e-3)


def test_what_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match=r"code 129 does not exist: degree 7 has codes 0\.\.128"):
        code_bits(7, 129)
    with pytest.raises(ValueError, match="does not fit into 16 bits"):
        Lamp(code=1, current_a=0.0, lamp_id=70_000).frame()

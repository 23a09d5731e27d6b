from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.experiments.recorded import tones
from tools.experiments.recorded.vlp import Raw
from tools.experiments.support.report import Work

RATE = 2000.0


def stream(seconds: float, strengths: dict[float, float], noise: float, seed: int = 3) -> Raw:
    """Lamps switched as square waves of given strength (of the fundamental), with offset and mains."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE)) / RATE
    words = 1600.0 + 5.0 * t + 8.0 * np.cos(2 * np.pi * 100.0 * t + 0.3) + noise * rng.standard_normal(len(t))
    for hertz, strength in strengths.items():
        begin = rng.uniform()
        cycles = begin + (hertz + rng.uniform(-0.04, 0.04)) * t
        words += strength * tones.waveform(cycles, tones.square())[0]
    return Raw(words, RATE, tuple(strengths))


def test_joint_solution_is_exact_without_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(400.0)
    rows = np.array([np.cos(2 * np.pi * f * t + p) for f, p in ((0.11, 0.2), (0.115, 1.0), (0.32, 2.0))])
    truth = np.array((3.0, -2.0, 0.5))
    mains = 40.0 + 0.01 * t + 5.0 * np.cos(2 * np.pi * 100.0 / RATE * t + 1.0)
    solved = tones.joint(truth @ rows + mains, rows, RATE)
    np.testing.assert_allclose(solved.found, truth, rtol=1e-6)
    assert solved.noise_var < 1e-6
    noisy = [tones.joint(truth @ rows + mains + rng.normal(size=400), rows, RATE) for _ in range(60)]
    spread = np.std([s.found for s in noisy], axis=0)
    np.testing.assert_allclose(np.sqrt(noisy[0].variance), spread, rtol=0.4)


def test_waveform_is_a_square_with_the_right_derivative() -> None:
    cycles = np.linspace(0.01, 0.99, 50)
    value, slope = tones.waveform(cycles, tones.square())
    assert np.all(value[(cycles > 0.03) & (cycles < 0.2)] > 0.6)
    assert np.all(value[(cycles > 0.3) & (cycles < 0.7)] < -0.6)
    step = 1e-6
    ahead = tones.waveform(cycles + step / (2 * np.pi), tones.square())[0]
    np.testing.assert_allclose(slope, (ahead - value) / step, atol=1e-3)


@pytest.mark.parametrize("method", [next(iter(tones.METHODS)), tones.ONE_BY_ONE])
def test_folded_harmonics_do_not_disturb_the_joint_solution(method: str) -> None:
    """3 x 735 Hz folds to 205 Hz, 10 Hz from a tone a fifth as strong; 50 ms epochs resolve 20 Hz."""
    strengths = {735.0: 30.0, 215.0: 6.0, 640.0: 15.0}
    raw = stream(6.0, strengths, 0.3)
    shapes = [tones.square() for _ in strengths]
    values, _ = tones.amplitudes(raw, tones.tracked(raw, shapes), shapes, 0.05, method)
    error = np.sqrt(np.mean((values[10:] / list(strengths.values()) - 1.0) ** 2, axis=0))
    if method == tones.ONE_BY_ONE:
        assert error[1] > 0.3
    else:
        assert error.max() < 0.03


@pytest.mark.slow
def test_waveforms_are_learnt() -> None:
    """A lamp that loses its upper harmonics, among others that do not."""
    raw = stream(17.0, {735.0: 20.0, 305.0: 25.0}, 1.0)
    t = np.arange(len(raw.words)) / RATE
    soft = tones.square() * np.exp(-0.1 * np.array(tones.HARMONICS))
    soft /= soft[0]
    words = raw.words + 30.0 * tones.waveform(0.1 + 520.02 * t, soft)[0]
    _, shapes = tones.demodulated(Raw(words, RATE, (*raw.tones, 520.0)), rounds=2)
    np.testing.assert_allclose(np.abs(shapes[2][:8]), np.abs(soft[:8]), atol=0.01)
    np.testing.assert_allclose(np.abs(shapes[1][:8]), np.abs(tones.square()[:8]), atol=0.01)


def test_recorded_stream(log_root: Path) -> None:
    report = tones.run(True, Work())
    rows = {row[0]: np.array(row[1:], dtype=float) for row in report.tables[0].rows}
    joint = rows["200 ms, joint, folded waveforms"]
    assert joint.max() < 2.0
    assert np.all(joint < 1.5 * rows["200 ms, predicted by the solver"])
    third = {row[0]: row[1:] for row in report.tables[1].rows}["harmonic 3"]
    assert all(0.25 < float(share) < 0.36 for share in third)

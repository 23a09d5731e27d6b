"""The joint fit: unbiased, with honest variances, and it finds phases, lag and clock that it is not told."""

import numpy as np
import pytest

from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.chip_pulse import pulse_table
from estimator.cdma.data_bits import data_signs, side_lobe, without
from estimator.cdma.gold_codes import gold_codes
from estimator.cdma.joint_fit import joint_fit
from estimator.cdma.mains_rejection import Mains
from estimator.cdma.sample_block import Prior, Sampled
from tests.estimator.cdma_scene import SAMPLES, ceiling
from tools.sim.light.waveform import Block, Ceiling

pytestmark = pytest.mark.jit

LSB = PROFILE_A.front_end.lsb_a
TABLE = pulse_table(PROFILE_A)[None]


class Bench:
    """Blocks with priors that are wrong by what the test orders."""

    def __init__(self, seed: int, current: np.ndarray | None = None) -> None:
        self.ceiling: Ceiling = ceiling(seed, current)
        self.mains = Mains(PROFILE_A.sample_rate, 10)

    def block(self, t: float) -> tuple[Block, Sampled]:
        block = self.ceiling.block(t, SAMPLES)
        y = block.words - 2048.0
        x = (np.arange(SAMPLES) - 0.5 * (SAMPLES - 1)) * PROFILE_A.chip_rate / PROFILE_A.sample_rate
        return block, Sampled(y, x, np.ones(SAMPLES), self.mains.rows(y))

    def phases(self, block: Block) -> np.ndarray:
        middle = 0.5 * (block.t_sample[0] + block.t_sample[-1])
        return np.array([middle * 5000.0 * (1 + 1e-6 * la.ppm) + la.phase_chips for la in self.ceiling.lamps])

    def prior(self, block: Block, x: np.ndarray, off: np.ndarray | float = 0.0, sigma: float = 0.01) -> Prior:
        lamps = self.ceiling.lamps
        rate = np.array([1 + 1e-6 * lamp.ppm for lamp in lamps])
        phase = self.phases(block)
        first = np.floor((phase + rate * x[0]) / 127.0)
        few, amplitude = len(lamps), block.truth_a / LSB
        return Prior(
            gold_codes(7)[[lamp.code for lamp in lamps]], phase - 127.0 * first + off, rate, np.full(few, sigma**2),
            0.05**2, (1e-4) ** 2, amplitude, np.zeros(few), np.zeros(few), np.zeros(few),
        )  # fmt: skip


def test_amplitudes_are_unbiased_and_their_variances_honest() -> None:
    bench, z, rng = Bench(1), [], np.random.default_rng(0)
    relative = []
    for k in range(25):
        block, sampled = bench.block(1.0 + 0.0507 * k)
        prior = bench.prior(block, sampled.x, 0.02 + rng.normal(0.0, 0.003, 16))
        fit = joint_fit(sampled, prior, TABLE)
        truth = block.truth_a / LSB
        z.append((fit.amplitude - truth) / np.sqrt(fit.amplitude_var))
        relative.append(fit.amplitude / truth - 1.0)
        assert np.sqrt(fit.noise_var) == pytest.approx(0.49, rel=0.2)
    assert np.std(z) == pytest.approx(1.0, abs=0.12)
    assert abs(np.mean(z)) < 0.15
    rms = np.sqrt(np.mean(np.square(relative), axis=0))
    assert rms[0] < 1e-3
    assert rms[7] < 3e-3


def test_it_finds_lag_clock_and_phases() -> None:
    bench, rng = Bench(2), np.random.default_rng(1)
    block, sampled = bench.block(1.0)
    own = rng.normal(0.0, 0.01, 16)
    prior = bench.prior(block, sampled.x * (1.0 - 8e-5), 0.05 + own, 0.02)
    sampled.x = sampled.x * (1.0 - 8e-5)
    fit = joint_fit(sampled, prior, TABLE)
    strong = slice(0, 8)
    np.testing.assert_allclose((fit.lag + fit.phase)[strong], -(0.05 + own)[strong], atol=0.004)
    assert fit.clock == pytest.approx(8e-5, abs=4e-6)
    assert np.sqrt(fit.clock_var) < 3e-6


def test_a_weak_lamp_keeps_the_phase_it_was_predicted_at() -> None:
    bench = Bench(3, np.array([2e-6, 1.5e-6, 3e-9]))
    block, sampled = bench.block(1.0)
    fit = joint_fit(sampled, bench.prior(block, sampled.x, np.array([0.01, -0.01, 0.0]), 0.01), TABLE)
    assert abs(fit.phase[2]) < 0.01
    assert np.sqrt(fit.phase_var[2]) == pytest.approx(0.01, rel=0.1)
    assert np.sqrt(fit.phase_var[0]) < 0.008  # two strong lamps share what the lag leaves open


def true_signs(bench: Bench, block: Block, width: int) -> np.ndarray:
    rows = []
    for lamp in bench.ceiling.lamps:
        start = block.t_sample[0] * 5000.0 * (1 + 1e-6 * lamp.ppm) + lamp.phase_chips
        frame = lamp.frame()
        rows.append([1 - 2 * int(frame[(int(start // 127) + k) % 116]) for k in range(width)])
    return np.array(rows)


def test_data_signs_are_right_where_they_are_claimed() -> None:
    bench, claimed, left_out = Bench(4), 0, 0
    for k in range(20):
        block, sampled = bench.block(1.0 + 0.0507 * k)
        first = data_signs(sampled, bench.prior(block, sampled.x, 0.015), TABLE)
        there = np.isfinite(first.soft_var)
        wrong = there & (first.signs != 0) & (first.signs != true_signs(bench, block, first.signs.shape[1]))
        assert not wrong.any()
        claimed += int(np.count_nonzero(first.signs[there]))
        left_out += int(np.count_nonzero(there & (first.signs == 0)))
    assert claimed > 800
    assert left_out < 0.1 * claimed


def test_a_lamp_beside_its_peak_is_noticed() -> None:
    bench = Bench(5, np.array([2e-6, 1e-6]))
    block, sampled = bench.block(1.0)
    for shift in (0.0, 0.5, -0.5):
        prior = bench.prior(block, sampled.x, np.array([0.0, shift]), 0.01)
        fit = joint_fit(sampled, prior, TABLE)
        assert side_lobe(sampled, prior, fit, 1, TABLE) == -shift
        assert side_lobe(sampled, prior, fit, 0, TABLE) == 0.0


def test_without_takes_lamps_out_roughly() -> None:
    bench = Bench(6, np.array([2e-6, 1e-6]))
    block, sampled = bench.block(1.0)
    before = float(np.std(sampled.clean))
    after = float(np.std(without(sampled, bench.prior(block, sampled.x, 0.03), TABLE)))
    assert after < 0.05 * before

"""PWM-dimmed lamps among coded ones: no lamp is lost, no code is invented, and the dimmed lamp is named."""

import numpy as np
import pytest

from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.epoch import BlockFlag
from estimator.cdma.interference.pwm_detection import fundamental
from estimator.cdma.interference.pwm_kernels import FALL, RISE
from estimator.cdma.interference.pwm_waveform import Chain, Pulses, explained, orthonormal
from tests.estimator.cdma_scene import SAMPLES, Run, ceiling, currents
from tools.sim.light.transmitter import PwmLamp
from tools.sim.light.waveform import Ambient

pytestmark = pytest.mark.jit

MICRO = 1e-6
RATE = PROFILE_A.sample_rate


def dimmed(seed: int, *lamps: PwmLamp) -> Run:
    world = ceiling(seed, currents(4.6, 5.3)[:12])
    world.dimmed = list(lamps)
    return Run(world)


@pytest.mark.parametrize("swing_a", [0.5 * MICRO, 5.0 * MICRO])
@pytest.mark.parametrize("hertz", [200.0, 237.0, 490.0, 1000.0, 1010.0, 2400.0, 5000.0, 8300.0, 15000.0, 25000.0])
def test_a_dimmed_lamp_costs_no_coded_lamp(hertz: float, swing_a: float) -> None:
    run = dimmed(int(hertz), PwmLamp(hertz, swing_a, 0.5, 0.37))
    run.settle(40)
    eighth = []
    for block, epoch in run.blocks(30):
        ids = epoch.ids.tolist()
        assert set(ids) <= set(run.codes())
        assert len(ids) >= 11
        eighth.append(run.errors(block, epoch)[7])
    assert np.sqrt(np.nanmean(np.square(eighth))) < 0.02
    (named,) = epoch.pwm
    assert named.hertz == pytest.approx(hertz, rel=1e-3)
    assert named.swing_a == pytest.approx(swing_a, rel=0.15)
    assert len(run.decoder.background.pwm) == 1


@pytest.mark.parametrize("duty", [0.1, 0.3, 0.9])
def test_a_frequency_above_the_sample_rate_is_named(duty: float) -> None:
    """At nine eighths of the sample rate all harmonics fall on four lines."""
    (named,) = dimmed(25000, PwmLamp(25000.0, 2.0 * MICRO, duty, 0.37)).settle(60).pwm
    assert named.hertz == pytest.approx(25000.0, rel=1e-3)


@pytest.mark.parametrize("duty", [0.05, 0.2, 0.8])
@pytest.mark.parametrize("hertz", [220.0, 1000.0, 3000.0])
def test_every_duty_cycle(hertz: float, duty: float) -> None:
    run = dimmed(3, PwmLamp(hertz, 3.0 * MICRO, duty))
    run.settle(60)
    errors = []
    for block, epoch in run.blocks(20):
        assert set(epoch.ids.tolist()) <= set(run.codes())
        errors.append(run.errors(block, epoch))
    assert np.sqrt(np.nanmean(np.square(errors), axis=0))[7] < 0.02
    assert np.isfinite(errors).sum(axis=1).min() >= 11


def test_no_code_is_invented_from_the_first_block_on() -> None:
    for hertz in (1000.0, 5000.0):
        run = dimmed(4, PwmLamp(hertz, 5.0 * MICRO))
        for _, epoch in run.blocks(60):
            assert set(epoch.ids.tolist()) <= set(run.codes())


def test_variances_are_honest_beside_a_dimmed_lamp() -> None:
    run = dimmed(5, PwmLamp(1000.0, 5.0 * MICRO, 0.3))
    run.settle(40)
    z = []
    for block, epoch in run.blocks(30):
        order = [run.codes().index(code) for code in epoch.ids]
        z += ((epoch.amplitude - block.truth_a[order]) / np.sqrt(epoch.variance)).tolist()
    assert np.sqrt(np.mean(np.square(z))) < 1.3


def test_two_dimmed_lamps() -> None:
    run = dimmed(6, PwmLamp(1000.0, 3.0 * MICRO, 0.4), PwmLamp(1300.0, 1.0 * MICRO, 0.7))
    run.settle(60)
    for _, epoch in run.blocks(20):
        assert set(epoch.ids.tolist()) == set(run.codes())
    assert sorted(lamp.hertz for lamp in epoch.pwm) == pytest.approx([1000.0, 1300.0], rel=1e-3)


def test_a_dimmed_lamp_goes_and_another_comes() -> None:
    run = dimmed(7, PwmLamp(600.0, 2.0 * MICRO))
    run.settle(40)
    run.ceiling.dimmed = []
    assert run.settle(40).pwm == ()
    run.ceiling.dimmed = [PwmLamp(900.0, 2.0 * MICRO)]
    epoch = run.settle(60)
    assert [lamp.hertz for lamp in epoch.pwm] == pytest.approx([900.0], rel=1e-3)
    assert set(epoch.ids.tolist()) == set(run.codes())


def test_nothing_is_named_where_nothing_is_dimmed() -> None:
    run = dimmed(8)
    for _, epoch in run.blocks(80):
        assert epoch.pwm == ()
    assert len(run.decoder.background.pwm) == 0
    assert epoch.block == BlockFlag.NONE


@pytest.mark.parametrize("hertz", [210.0, 1000.0, 3000.0, 5000.0])
def test_the_waveform_is_that_of_the_receiver(hertz: float) -> None:
    """The simulator steps through the same chain edge by edge, and shares no code with the closed form."""
    world = ceiling(1, np.array([]))
    world.ambient = Ambient(flicker_a=0.0)
    world.dimmed = [PwmLamp(hertz, 20.0 * MICRO, 0.3)]
    block = world.block(1.0, SAMPLES)
    seen = block.words - block.words.mean()
    times = np.arange(SAMPLES) - 0.5 * (SAMPLES - 1)
    middle = 0.5 * (block.t_sample[0] + block.t_sample[-1])
    rise = middle * hertz % 1.0
    trains = Chain(PROFILE_A).trains(Pulses(hertz / RATE, rise, rise - 0.3), times)
    light = trains[RISE] - trains[FALL]
    light -= light.mean()
    weight = float(light @ seen) / float(light @ light)
    assert weight == pytest.approx(20.0 * MICRO / PROFILE_A.front_end.lsb_a, rel=2e-3)
    assert np.std(seen - weight * light) < 1.0
    mean = np.full((1, SAMPLES), SAMPLES**-0.5)
    spanned = explained(Chain(PROFILE_A).rows(Pulses(hertz / RATE, rise, rise - 0.3), times), mean, seen)[0]
    assert np.std(seen - spanned) < 0.6  # noise of the converter: no harmonic is left out


def test_derivatives_of_the_edge_trains() -> None:
    chain, times, step = Chain(PROFILE_A), np.arange(-200.0, 201.0), 1e-3
    frequency = 0.0137
    here, before, after = (
        chain.trains(Pulses(frequency, 0.2 + d * frequency, 0.9 + d * frequency), times) for d in (0.0, -step, step)
    )
    away = np.abs((frequency * times + 0.2 + 0.5) % 1.0 - 0.5) > 2.0 * frequency * step
    for value, slope in ((0, 1), (1, 2)):
        numeric = (after[value] - before[value]) / (2.0 * step)
        np.testing.assert_allclose(here[slope][away], numeric[away], atol=2e-3 * np.abs(here[slope]).max())


def test_rows_are_orthonormal_also_where_they_are_alike() -> None:
    times = np.arange(SAMPLES) - 0.5 * (SAMPLES - 1)
    rows = Chain(PROFILE_A).rows(Pulses(0.45, 0.1, 0.6), times)  # only three lines: most rows are alike
    known = orthonormal(np.array([np.ones(SAMPLES), times]), np.empty((0, SAMPLES)))
    both = np.concatenate((known, orthonormal(rows.copy(), known)))
    np.testing.assert_allclose(both @ both.T, np.eye(len(both)), atol=1e-6)
    for row in rows:
        left = row - (both @ row) @ both
        assert left @ left < 1e-5 * (row @ row)


@pytest.mark.parametrize("line", [0.0123, 0.09, 0.31, 0.487])
def test_the_fundamental_of_a_comb_is_found(line: float) -> None:
    rng, n = np.random.default_rng(2), np.arange(SAMPLES)
    comb = sum(np.cos(2.0 * np.pi * k * line * n + k) / k for k in (1, 3, 5, 7))
    found = fundamental(comb + rng.normal(0.0, 0.7, SAMPLES))
    assert found == pytest.approx(line, abs=5e-5)


def test_noise_has_no_comb() -> None:
    rng = np.random.default_rng(3)
    assert all(fundamental(rng.normal(0.0, 1.0, SAMPLES)) is None for _ in range(300))

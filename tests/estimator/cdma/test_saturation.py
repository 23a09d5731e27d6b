"""A first stage that saturates part of the time: flagged, its samples left out, and the variances honest."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.cdma.anomalies.saturation import saturated
from estimator.cdma.epoch import UNUSABLE, BlockFlag
from tests.estimator.cdma_scene import Run, ceiling, currents
from tests.estimator.oversampled_ceiling import OversampledCeiling
from tools.sim.light.waveform import Ambient

pytestmark = pytest.mark.jit

LIMIT_A = 1.72e-3


def overdriven(current_a: float) -> Run:
    world = ceiling(31, currents(4.6, 5.3)[:10])
    world.ambient = Ambient(current_a=current_a, flicker_a=16e-6)
    return Run(OversampledCeiling(world, 6.0, LIMIT_A))  # type: ignore[arg-type]  # it has what a run needs


@pytest.mark.parametrize("below_a", [25e-6, 15e-6, 5e-6])
def test_flagged_and_honest(below_a: float) -> None:
    run = overdriven(LIMIT_A - below_a)
    run.settle(40)
    z, flagged, usable = [], 0, 0
    for block, epoch in run.blocks(60):
        assert set(epoch.ids.tolist()) <= set(run.codes())
        flagged += bool(epoch.block & BlockFlag.OVERDRIVEN)
        usable += not epoch.block & UNUSABLE
        order = [run.codes().index(code) for code in epoch.ids]
        z += ((epoch.amplitude - block.truth_a[order]) / np.sqrt(epoch.variance)).tolist()
    assert flagged > 50
    assert usable > 40
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_far_from_the_limit_nothing_is_flagged() -> None:
    run = overdriven(LIMIT_A - 100e-6)
    run.settle(30)
    assert all(not epoch.block & BlockFlag.OVERDRIVEN for _, epoch in run.blocks(60))


def test_still_samples_are_found() -> None:
    rng = np.random.default_rng(1)
    words = 2048.0 + np.round(rng.normal(0.0, 60.0, 1111))
    assert saturated(words, np.ones(1111)) is None
    words[400:520] = 2100.0 + np.round(rng.normal(0.0, 0.5, 120))
    found = saturated(words, np.ones(1111))
    assert found is not None
    assert found[404:516].all()
    assert not found[:385].any()
    assert not found[535:].any()


def test_noise_alone_is_not_still() -> None:
    rng = np.random.default_rng(2)
    for scale in (0.5, 2.0, 60.0):
        assert all(saturated(np.round(rng.normal(2048.0, scale, 1111)), np.ones(1111)) is None for _ in range(100))

"""Lamps that rise slowly: flagged, their amplitudes corrected, and the variances honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.cdma.epoch import LinkFlag
from tests.estimator.cdma_scene import Run, ceiling, currents
from tests.estimator.oversampled_ceiling import OversampledCeiling

pytestmark = pytest.mark.jit


def judged(run: Run, settle: int = 60, count: int = 30) -> tuple[float, dict[int, float]]:
    """RMS of the normalised amplitude errors, and for each code how often it was flagged as slow."""
    run.settle(settle)
    z, flagged = [], dict.fromkeys(run.codes(), 0.0)
    for block, epoch in run.blocks(count):
        assert set(epoch.ids.tolist()) == set(run.codes())
        order = [run.codes().index(code) for code in epoch.ids]
        z += ((epoch.amplitude - block.truth_a[order]) / np.sqrt(epoch.variance)).tolist()
        for code in epoch.ids[(epoch.flags & LinkFlag.SLOW) != 0].tolist():
            flagged[code] += 1.0 / count
    return float(np.sqrt(np.mean(np.square(z)))), flagged


@pytest.mark.parametrize("rise_s", [10e-6, 30e-6])
def test_all_lamps_are_slow(rise_s: float) -> None:
    world = ceiling(21, currents(4.6, 5.3)[:12])
    world.receiver = replace(world.receiver, led_tau_s=rise_s)
    z, flagged = judged(Run(world))
    assert z < 1.5
    assert min(flagged.values()) > 0.9


@pytest.mark.parametrize("rise_s", [10e-6, 30e-6])
@pytest.mark.parametrize("which", [0, 4])
def test_one_lamp_is_slow(which: int, rise_s: float) -> None:
    world = OversampledCeiling(ceiling(22, currents(4.6, 5.3)[:8]), seconds=6.0, rise_s={which: rise_s})
    run = Run(world)  # type: ignore[arg-type]  # it has what a run needs of a ceiling
    z, flagged = judged(run)
    assert z < 1.5
    assert flagged[world.lamps[which].code] > 0.9


def test_lamps_of_the_air_interface_are_not_slow() -> None:
    _, flagged = judged(Run(ceiling(23)))
    assert max(flagged.values()) == 0.0


def test_a_low_pass_within_its_tolerance_is_not_a_slow_lamp() -> None:
    world = ceiling(24, currents(4.6, 5.3)[:12])
    world.receiver = replace(world.receiver, lpf_hz=0.88 * world.receiver.lpf_hz)
    z, flagged = judged(Run(world))
    assert z < 1.5
    assert max(flagged.values()) < 0.1


def test_lamps_come_and_go() -> None:
    """What is known of lamps out of view stays consistent with what is learned of the others."""
    world = ceiling(21, np.full(16, 2e-6))
    world.receiver = replace(world.receiver, led_tau_s=30e-6)
    lamps, run = world.lamps, Run(world)
    for some in (lamps[:1], lamps[1:], lamps):
        world.lamps = some
        run.settle(80)
        assert np.linalg.eigvalsh(run.decoder.slow_lamps._covariance).min() > 0.0


def test_a_lamp_in_the_place_of_a_slow_one_is_not_slow() -> None:
    usual, slow = (ceiling(22, currents(4.6, 5.3)[:4]) for _ in range(2))
    first = usual.lamps[0]
    usual.lamps[0] = replace(first, code=next(k for k in range(129) if k not in {lamp.code for lamp in slow.lamps}))
    run = Run(OversampledCeiling(slow, seconds=9.0, rise_s={0: 30e-6}))  # type: ignore[arg-type]  # as above
    run.settle(60)
    run.ceiling = usual
    run.ceiling.lamps, new = usual.lamps[1:], usual.lamps[0]
    run.settle(25)
    usual.lamps.append(new)
    for _, epoch in run.blocks(20):
        assert not (epoch.flags[epoch.ids == new.code] & LinkFlag.SLOW).any()
    block, epoch = run.block()
    assert abs(run.errors(block, epoch)[-1]) < 0.01

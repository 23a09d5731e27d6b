"""Blocks in which the bus stalls or the converter saturates."""

import numpy as np
import pytest

from estimator.cdma.anomalies.saturation import saturated
from estimator.cdma.epoch import UNUSABLE, BlockFlag
from tests.estimator.cdma_scene import Run, ceiling, currents
from tests.estimator.oversampled_ceiling import OversampledCeiling
from tools.sim.light.waveform import Ambient

pytestmark = pytest.mark.jit

FLAGGED = BlockFlag.STALLED | BlockFlag.NOISY


def stalled_blocks(run: Run, count: int, longest_s: float, seed: int = 0) -> tuple[list[float], list[BlockFlag]]:
    """Every third block has one pause, log-uniform in length; worst error of lamps above 80 nA, and flags."""
    rng, worst, flags = np.random.default_rng(seed), [], []
    for _ in range(count):
        pause = float(np.exp(rng.uniform(np.log(2e-6), np.log(longest_s))))
        block, epoch = run.block(((int(rng.integers(5, run.samples - 5)), pause),))
        error = run.errors(block, epoch)[block.truth_a > 80e-9]
        flags.append(epoch.block)
        worst.append(0.0 if epoch.block & FLAGGED else float(np.nanmax(np.abs(error))))
        for _ in range(2):
            _, epoch = run.block()
            assert epoch.block == BlockFlag.NONE
            assert sorted(epoch.ids) == sorted(run.codes())
    return worst, flags


@pytest.mark.parametrize("current", [None, np.array([2.7e-6]), np.array([1.2e-6, 0.4e-6])])
def test_true_or_flagged(current: np.ndarray | None) -> None:
    run = Run(ceiling(4, current))
    run.settle(30)
    worst, flags = stalled_blocks(run, 24, 500e-6)
    assert max(worst) < 0.01
    mended = sum(bool(flag & BlockFlag.MENDED) for flag in flags)
    assert mended > 0.75 * len(flags)


def test_without_flicker_the_lamps_alone_tell() -> None:
    world = ceiling(5)
    world.ambient = Ambient(flicker_a=0.0)
    run = Run(world)
    run.settle(30)
    worst, _ = stalled_blocks(run, 20, 500e-6)
    assert max(worst) < 0.01


@pytest.mark.slow
def test_a_thousand_stalled_blocks() -> None:
    for seed in range(5):
        run = Run(ceiling(60 + seed))
        run.settle(30)
        worst, _ = stalled_blocks(run, 200, 500e-6, seed)
        assert max(worst) < 0.01


def test_two_pauses_in_one_block_are_not_mended_wrongly() -> None:
    run = Run(ceiling(6))
    run.settle(30)
    for first, second in ((200, 800), (100, 500), (600, 1000)):
        block, epoch = run.block(((first, 150e-6), (second, 220e-6)))
        errors = run.errors(block, epoch)
        assert epoch.block & UNUSABLE or epoch.block & BlockFlag.NOISY or np.nanmax(np.abs(errors[:8])) < 0.01
        assert epoch.block != BlockFlag.NONE
        run.settle(2)


def test_undisturbed_blocks_are_not_flagged() -> None:
    run = Run(ceiling(7))
    run.settle(20)
    assert all(epoch.block == BlockFlag.NONE for _, epoch in run.blocks(100))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_two_thousand_undisturbed_blocks_are_not_flagged(seed: int) -> None:
    """Code periods that begin or end with a block's first or last samples come once in a few hundred blocks."""
    run = Run(ceiling(seed))
    run.settle(30)
    for _, epoch in run.blocks(2000):
        assert epoch.block == BlockFlag.NONE
        assert sorted(epoch.ids) == sorted(run.codes())


def test_a_new_lamp_is_not_taken_for_a_stall() -> None:
    world = ceiling(8)
    late = world.lamps.pop(2)
    run = Run(world)
    run.settle(30)
    world.lamps.insert(2, late)
    seen = [(late.code in epoch.ids, epoch.block) for _, epoch in run.blocks(6)]
    assert seen[3][0]
    assert seen[5] == (True, BlockFlag.NONE)


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

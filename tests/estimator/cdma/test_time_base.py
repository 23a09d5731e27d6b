"""Pauses of the bus at the same samples of every block: learned and corrected, or flagged with honest variances."""

import numpy as np
import pytest

from estimator.cdma.anomalies.time_base import BLOCKS, TimeBase
from estimator.cdma.epoch import UNUSABLE, BlockFlag
from tests.estimator.cdma_scene import Run, ceiling, currents

pytestmark = pytest.mark.jit

ODD = BlockFlag.UNEVEN | BlockFlag.STALLED


def every(samples: int, seconds: float, size: int = 1111) -> tuple[tuple[int, float], ...]:
    return tuple((k, seconds) for k in range(samples, size, samples))


@pytest.mark.parametrize(
    ("stalls", "lamps"),
    [
        (((555, 5e-6),), 12),
        (((555, 30e-6),), 12),
        (((200, 12e-6), (700, 20e-6)), 12),
        (every(256, 10e-6), 11),
        (every(64, 10e-6), 11),
        (every(30, 10e-6), 11),
        (every(22, 5e-6), 11),
        (every(128, 30e-6), 11),
        (every(256, 50e-6), 11),
        (every(64, 50e-6), 11),
    ],
)
def test_flagged_and_honest(stalls: tuple[tuple[int, float], ...], lamps: int) -> None:
    run, z, flagged, counts = Run(ceiling(41, currents(4.6, 5.3)[:12])), [], 0, []
    for k in range(160):
        block, epoch = run.block(stalls)
        assert set(epoch.ids.tolist()) <= set(run.codes())
        if k < 80:
            continue
        flagged += bool(epoch.block & ODD)
        if not epoch.block & UNUSABLE:
            counts.append(len(epoch.ids))
            order = [run.codes().index(code) for code in epoch.ids]
            z += ((epoch.amplitude - block.truth_a[order]) / np.sqrt(epoch.variance)).tolist()
    assert flagged > 70
    assert np.sqrt(np.mean(np.square(z))) < 1.5
    assert np.median(counts) >= lamps


def test_an_even_bus_is_not_flagged() -> None:
    run = Run(ceiling(42))
    assert all(not epoch.block & BlockFlag.UNEVEN for _, epoch in run.blocks(200))


@pytest.mark.parametrize("places", [(5, 1100), (500, 501)])
def test_single_stalled_blocks_are_no_pattern(places: tuple[int, int]) -> None:
    """Neither at any place nor at one."""
    run = Run(ceiling(43))
    run.settle(30)
    rng = np.random.default_rng(4)
    for _ in range(30):
        run.block(((int(rng.integers(*places)), 60e-6),))
        for _, epoch in run.blocks(3):
            assert not epoch.block & BlockFlag.UNEVEN


def test_the_shift_is_the_median_of_blocks() -> None:
    rng, base = np.random.default_rng(5), TimeBase()
    true = np.where(np.arange(1111) < 500, 0.0, 0.03)
    for k in range(BLOCKS):
        slope = rng.normal(0.0, 200.0, 1111)
        shift = true if k else true + np.where(np.arange(1111) < 300, 0.0, 0.2)
        base.learn(slope, slope * shift + rng.normal(0.0, 0.5, 1111), 0.25)
    ramp = np.linspace(-1.0, 1.0, 1111)
    right = true - true.mean() - ramp * (ramp @ true) / (ramp @ ramp)
    base.on_stamps(late=False)
    assert base.uneven
    assert np.std(base.moved(np.zeros(1111)) - right) < 0.002

"""Lamps with slow edges, and two lamps of one code."""

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


RATIOS = (1.0, 0.3, 0.1)


def twins(seed: int, apart: float, ratio: float, ppm: float = 0.5) -> Run:
    world = ceiling(seed, np.array([2.3e-6, 1e-6, 1e-6]))
    first = world.lamps[0]
    world.lamps.append(
        replace(
            first, current_a=ratio * first.current_a, phase_chips=first.phase_chips + apart, ppm=first.ppm + ppm,
            lamp_id=7,
        )
    )  # fmt: skip
    return Run(world)


def look(run: Run, count: int, settle: int = 10) -> None:
    """No code but those of lamps from the first block on; after some blocks both lamps, flagged and right."""
    code = run.codes()[0]
    for k, (block, epoch) in enumerate(run.blocks(count)):
        ids = np.array(epoch.ids)
        assert set(ids.tolist()) <= set(run.codes())
        if k >= settle:
            both = ids == code
            assert np.count_nonzero(both) == 2
            assert (np.array(epoch.flags)[both] & LinkFlag.TWIN).all()
            right = sorted(block.truth_a[[0, 3]])
            np.testing.assert_allclose(sorted(epoch.amplitude[both]), right, rtol=0.03, atol=1e-9)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("apart", [0.3, 0.5, 0.8, 1.0, 1.2, 1.5, -0.3, -0.9])
def test_twins_are_separated(apart: float, ratio: float) -> None:
    look(twins(11, apart, ratio), 40)


@pytest.mark.parametrize(("seed", "apart", "ratio"), [(1, 1.5, 0.3), (6, 1.2, 0.3), (7, 1.5, 1.0)])
def test_candidates_do_not_shift_twins_by_their_distance(seed: int, apart: float, ratio: float) -> None:
    """Beside twins that are just found, most candidates are their cross-correlations."""
    look(twins(seed, apart, ratio), 15)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("apart", np.round(np.linspace(0.3, 1.5, 12), 2).tolist())
def test_no_false_code_in_two_thousand_blocks(apart: float, ratio: float) -> None:
    run = twins(12, apart, ratio, ppm=0.001)
    for _, epoch in run.blocks(2000):
        assert set(epoch.ids.tolist()) <= set(run.codes())


def test_twins_drift_through_each_other() -> None:
    """Where they cannot be separated they are one lamp, and no third code appears."""
    run = twins(13, -0.6, 0.5, ppm=50.0)
    for _, epoch in run.blocks(120):
        assert set(epoch.ids.tolist()) <= set(run.codes())
    code = run.codes()[0]
    assert epoch.ids.tolist().count(code) == 2


def test_a_single_lamp_has_no_twin() -> None:
    run = Run(ceiling(14))
    for _, epoch in run.blocks(100):
        assert len(set(epoch.ids.tolist())) == len(epoch.ids)
        assert not (epoch.flags & LinkFlag.TWIN).any()

"""Mains flicker: whatever its frequency and shape, nothing of it is left; a torn block moves the tracker little."""

import numpy as np
import pytest

from estimator.cdma.mains_rejection import Mains, orthonormal
from tools.sim.light.waveform import Ambient, Bus, Ceiling

pytestmark = pytest.mark.jit

RATE = 400e3 / 18
RECTIFIED = tuple(3.0 / (4.0 * h * h - 1.0) for h in range(1, 11))
NOISE_LSB = 0.47


def left_over(mains: Mains, y: np.ndarray) -> float:
    q = mains.rows(y)
    return float(np.std(y - q.T @ (q @ y)))


@pytest.mark.parametrize("scl_error", [-0.01, 0.0, 0.01])
@pytest.mark.parametrize("hertz", [99.7, 100.2, 119.8, 120.1])
def test_nothing_is_left_of_either_grid_with_any_clock(hertz: float, scl_error: float) -> None:
    ceiling = Ceiling([], Ambient(mains_hz=hertz, harmonics=RECTIFIED), bus=Bus(scl_error=scl_error))
    mains = Mains(RATE, 10)
    for k in range(10):
        y = ceiling.block(0.0507 * k, 1111).words - 2048.0
        assert left_over(mains, y) < 1.15 * NOISE_LSB
        mains.learn(y)
    assert mains.hertz * (1 + scl_error) == pytest.approx(hertz, abs=0.01)
    assert np.std(y) > 600.0


def test_it_follows_a_grid_that_wanders() -> None:
    ceiling, mains = Ceiling([], Ambient(mains_hz=100.0)), Mains(RATE, 10)
    for k in range(80):
        ceiling.ambient = Ambient(mains_hz=100.0 + 0.002 * k)
        y = ceiling.block(0.0507 * k, 1111).words - 2048.0
        assert left_over(mains, y) < 1.3 * NOISE_LSB
        mains.learn(y)
    assert mains.hertz == pytest.approx(100.158, abs=0.02)


def test_a_torn_block_moves_it_little() -> None:
    ceiling, mains = Ceiling([], Ambient()), Mains(RATE, 10)
    for k in range(5):
        mains.learn(mains_block(ceiling, 0.0507 * k))
    mains.learn(ceiling.block(1.0, 1111, ((555, 400e-6),)).words - 2048.0)
    assert mains.hertz == pytest.approx(100.0, abs=0.03)


def test_a_torn_first_block_is_soon_forgotten() -> None:
    ceiling, mains = Ceiling([], Ambient()), Mains(RATE, 10)
    mains.learn(ceiling.block(0.0, 1111, ((500, 700e-6),)).words - 2048.0)
    for k in range(1, 10):
        mains.learn(mains_block(ceiling, 0.0507 * k))
    assert mains.hertz == pytest.approx(100.0, abs=0.01)


@pytest.mark.parametrize("hertz", [100.0, 120.0])
def test_either_grid_is_found_after_darkness(hertz: float) -> None:
    """Noise alone decides for one of the two."""
    for seed in range(4):
        ceiling, mains = Ceiling([], Ambient(flicker_a=0.0), seed=seed), Mains(RATE, 10)
        for k in range(3):
            mains.learn(mains_block(ceiling, 0.0507 * k))
        ceiling.ambient = Ambient(mains_hz=hertz)
        for k in range(10, 20):
            mains.learn(mains_block(ceiling, 0.0507 * k))
        assert mains.hertz == pytest.approx(hertz, abs=0.01)


def mains_block(ceiling: Ceiling, t: float) -> np.ndarray:
    return np.asarray(ceiling.block(t, 1111).words - 2048.0)


def test_masked_rows_are_orthonormal_and_zero_where_masked() -> None:
    mains = Mains(RATE, 10)
    mains.rows(mains_block(Ceiling([]), 0.0))
    mask = np.ones(1111)
    mask[300:420] = 0.0
    rows = mains.masked(np.arange(1111.0), mask)
    np.testing.assert_allclose(rows @ rows.T, np.eye(25), atol=1e-9)
    assert not rows[:, 300:420].any()


def test_no_flicker_at_all() -> None:
    y = mains_block(Ceiling([], Ambient(flicker_a=0.0)), 0.0)
    mains = Mains(RATE, 10)
    assert left_over(mains, y) < 1.1 * NOISE_LSB
    before = mains.hertz
    for row in (y, np.zeros(1111)):
        mains.learn(row)
    assert mains.hertz == before


def test_orthonormal_gives_the_factor_too() -> None:
    rows = np.random.default_rng(0).normal(size=(5, 40))
    q, lower = orthonormal(rows)
    np.testing.assert_allclose(lower @ rows, q, atol=1e-12)
    np.testing.assert_allclose(q @ q.T, np.eye(5), atol=1e-12)

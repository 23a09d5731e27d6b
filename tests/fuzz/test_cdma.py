"""The light decoder under words, sizes, rates and times at random: it never raises, and claims no lamp that is not."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.decoder import decode, new_decoder, search
from estimator.cdma.epoch import UNUSABLE, BlockFlag, LightEpoch, LinkFlag, SampleBlock
from tests.estimator.cdma_scene import Run, ceiling, currents, sampled

pytestmark = pytest.mark.jit

RATE = PROFILE_A.sample_rate
ODD = [0.0, -0.0, -1.0, 1e-300, 1e300, float("nan"), float("inf"), float("-inf")]
ODD_FLOAT = st.one_of(st.sampled_from(ODD), st.floats(allow_nan=True, allow_infinity=True))


def sound(epoch: LightEpoch) -> None:
    """An epoch says nothing that contradicts itself."""
    count = len(epoch.ids)
    assert len(epoch.amplitude) == len(epoch.variance) == len(epoch.flags) == len(epoch.lamps) == count
    assert np.isfinite(epoch.amplitude).all()
    assert (epoch.amplitude >= 0.0).all()
    assert np.isfinite(epoch.variance).all()
    assert (epoch.variance > 0.0).all()
    assert np.isfinite(epoch.noise_a)
    assert not count or not epoch.block & UNUSABLE


def words(kind: str, size: int, seed: int) -> np.ndarray:
    rng, n = np.random.default_rng(seed), np.arange(size)
    match kind:
        case "uniform":
            return rng.integers(0, 4096, size).astype(np.float64)
        case "walk":
            return np.clip(2048.0 + np.cumsum(rng.integers(-40, 41, size)), 0.0, 4095.0)
        case "square":
            return np.where(np.sin(rng.uniform(0.01, 3.0) * n) > 0.0, 2900.0, 1100.0)
        case "sparse":
            return np.where(rng.random(size) < 0.01, 4095.0, 2048.0)
        case "wild":
            return rng.normal(2048.0, 10.0 ** rng.uniform(0.0, 6.0), size)
        case _:
            return np.where(rng.random(size) < 0.01, rng.choice(ODD, size), 2048.0)


KINDS = ("uniform", "walk", "square", "sparse", "wild", "odd")
BLOCK = st.tuples(
    st.sampled_from(KINDS),
    st.one_of(st.just(1111), st.sampled_from([0, 1, 2, 26, 564, 565, 566, 5646]), st.integers(0, 6000)),
    st.integers(0, 2**32 - 1),
    st.one_of(st.just(RATE), ODD_FLOAT, st.floats(0.9 * RATE, 1.1 * RATE)),
    st.one_of(st.floats(-0.2, 0.5), ODD_FLOAT),
    st.one_of(st.just(0.05), st.floats(0.0, 1.0), ODD_FLOAT),
)
"""Words, how many, seed, rate, time since the last block, and how long the read took."""


@settings(max_examples=40, deadline=None)
@given(st.lists(BLOCK, min_size=1, max_size=12))
@example([("uniform", 1111, 0, RATE, 0.0, 0.05)] * 4 + [("uniform", 1111, 0, RATE, 0.0, 1e300)])
def test_whatever_comes_is_answered(blocks: list[tuple[str, int, int, float, float, float]]) -> None:
    decoder, t = new_decoder(PROFILE_A, 0.0), 1.0
    for kind, size, seed, rate, pause, span in blocks:
        begin = t + pause
        sound(decode(decoder, SampleBlock(begin, begin + span, words(kind, size, seed), rate)))
        search(decoder, 150)
        t = begin + span if np.isfinite(begin + span) else t


@pytest.mark.parametrize("kind", ["uniform", "walk", "square", "sparse"])
@pytest.mark.parametrize("clock", [0.0, None])
def test_no_lamp_is_seen_where_there_is_none(kind: str, clock: float | None) -> None:
    decoder = new_decoder(PROFILE_A, clock)
    for k in range(40):
        epoch = decode(decoder, SampleBlock(0.051 * k, 0.051 * k + 0.05, words(kind, 1111, 7 + k), RATE))
        sound(epoch)
        assert not len(epoch.ids)
        for _ in range(2):
            search(decoder, 150)


def damaged(block: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Words as a bus that misbehaves might hand them over."""
    row, n = block.copy(), len(block)
    at, length = int(rng.integers(0, n - 80)), int(rng.integers(1, 80))
    match int(rng.integers(0, 7)):
        case 0:  # bits that flip
            hit = rng.random(n) < 0.003
            row[hit] = (row[hit].astype(int) ^ (1 << rng.integers(0, 12, hit.sum()))).astype(float)
        case 1:  # words that are lost, the rest moves up
            row = np.append(np.delete(row, slice(at, at + length)), row[n - length :])
        case 2:  # words that come twice
            row = np.insert(row, at, row[at : at + length])[:n]
        case 3:  # a converter that holds its value
            row[at : at + length] = row[at]
        case 4:  # a step of the light
            row[at:] = np.clip(row[at:] + rng.normal(0.0, 300.0), 0.0, 4095.0)
        case 5:  # another gain
            row = np.clip(2048.0 + 1.5 * (row - 2048.0), 0.0, 4095.0)
        case _:  # an old block once more
            row = np.roll(row, int(rng.integers(0, n)))
    return row


def test_damaged_blocks_are_told_or_do_no_harm() -> None:
    """Every third block is damaged: what is reported as good is good, and the next clean block is as if nothing was."""
    run, rng = Run(ceiling(70, currents(4.6, 5.3)[:8])), np.random.default_rng(70)
    run.settle(30)
    for k in range(90):
        block = run.ceiling.block(run.t, run.samples)
        run.t = block.t1 + 5e-4
        told = sampled(block)
        if k % 3 == 0:
            told = SampleBlock(told.t_begin, told.t_end, damaged(block.words, rng), told.rate)
        epoch = decode(run.decoder, told)
        search(run.decoder, 150)
        sound(epoch)
        assert set(epoch.ids.tolist()) <= set(run.codes())
        if k % 3:
            assert sorted(epoch.ids[epoch.flags & LinkFlag.FAINT == 0]) == sorted(run.codes())
            assert np.nanmax(np.abs(run.errors(block, epoch))) < 0.05


def test_time_that_goes_back_is_malformed_and_in_the_end_believed() -> None:
    run = Run(ceiling(71, currents(4.6, 5.3)[:4]))
    run.settle(15)
    block = run.ceiling.block(run.t, run.samples)
    late = decode(run.decoder, SampleBlock(block.t0 - 1.0, block.t1 - 1.0, block.words, block.nominal_rate))
    assert late.block == BlockFlag.MALFORMED
    assert not len(late.ids)
    run.t = block.t1 + 5e-4
    assert sorted(run.block()[1].ids) == sorted(run.codes())
    run.t = -1000.0
    seen = [run.block()[1] for _ in range(12)]
    assert [epoch.block for epoch in seen[:3]] == 3 * [BlockFlag.MALFORMED]
    assert sorted(seen[-1].ids) == sorted(run.codes())

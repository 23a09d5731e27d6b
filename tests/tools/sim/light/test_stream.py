"""The waveform of a whole ceiling against the plain numerical one; the decoder's errors against the link level's."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.decoder import decode, new_decoder, search
from estimator.cdma.epoch import SampleBlock
from tools.sim.ceiling.ceiling import Array, Effects, paper_ceiling
from tools.sim.ceiling.links import ACQUIRE, Links
from tools.sim.light.stream import IN_VIEW_A, LightStream
from tools.sim.light.waveform import Ceiling

RATE = 400e3 / 18


def at_rest(x: float = 0.7, y: float = -0.3):  # type: ignore[no-untyped-def]
    return lambda t: np.tile([x, y, 0.4], (len(t), 1))


def instants(begin: float, samples: int = 1111) -> Array:
    return begin + (8 + 18 * np.arange(samples)) / 400e3


def test_blocks_in_a_row_are_the_plain_simulators_blocks() -> None:
    """The fast stream carries its state on; the plain one follows every lamp's past anew."""
    stream = LightStream(paper_ceiling(Effects(warm_up=0.0, drift=0.0), seed=1), at_rest())
    amplitude = stream.track.at(1.0)
    seen = amplitude > IN_VIEW_A
    lamps = [replace(lamp, current_a=float(a / 0.3)) for lamp, a in zip(stream.lamps, amplitude, strict=True)]
    plain = Ceiling([lamp for lamp, lit in zip(lamps, seen, strict=True) if lit])
    for begin in (1.0, 1.0503, 1.1009, 9.0):
        np.testing.assert_allclose(stream.coded(instants(begin)), plain._signal(instants(begin)), atol=5e-11)


def errors_of_decoder(seed: int, blocks: int) -> tuple[Array, Array, Array, int]:
    """Errors over reported sigmas and errors (A) by lamp of a decoder at rest; lamps told; reported at which block."""
    rng = np.random.default_rng(seed)
    stream = LightStream(paper_ceiling(seed=seed), at_rest(*rng.uniform(-3.0, 3.0, 2)), seed=seed)
    decoder, t = new_decoder(PROFILE_A, 0.0), 1.0
    codes = {f.code: k for k, f in enumerate(stream.ceiling.fixtures)}
    ratio, error, found = np.full((blocks, 16), np.nan), np.full((blocks, 16), np.nan), blocks
    told = np.zeros(blocks)
    for n in range(blocks):
        when = instants(t)
        words = np.floor(4096.0 * np.clip(stream(when), 0.0, 1.0 - 1e-9))
        epoch = decode(decoder, SampleBlock(t - 30e-6, float(when[-1]) + 20 / 400e3 + 30e-6, words, RATE))
        search(decoder, 129)
        truth = stream.track.at(0.5 * float(when[0] + when[-1]))
        rows = [codes[code] for code in epoch.ids.tolist()]
        error[n, rows] = epoch.amplitude - truth[rows]
        ratio[n, rows] = error[n, rows] / np.sqrt(epoch.variance)
        told[n] = sum(lamp is not None for lamp in epoch.lamps)
        found = min(found, n) if len(rows) >= 8 else found
        t = float(when[-1]) + 20 / 400e3 + float(rng.uniform(1e-4, 4e-4))
    return ratio, error, told, found


def errors_of_links(seed: int, blocks: int) -> tuple[Array, Array, Array, int]:
    """The same at link level."""
    rng = np.random.default_rng(seed)
    ceiling, place = paper_ceiling(seed=seed), at_rest(*rng.uniform(-3.0, 3.0, 2))
    links = Links(ceiling, seed=seed)
    ratio, error, found = np.full((blocks, 16), np.nan), np.full((blocks, 16), np.nan), blocks
    told = np.zeros(blocks)
    for n in range(blocks):
        t = 1.0 + 0.0503 * n
        report = links.report(t, t + 0.05, ceiling.amplitudes(place(np.zeros(1)), np.array([t]))[0])
        error[n, report.lamp] = report.amplitude - report.truth
        ratio[n, report.lamp] = error[n, report.lamp] / np.sqrt(report.variance)
        told[n] = report.told.sum()
        found = min(found, n) if len(report.lamp) >= 8 else found
    return ratio, error, told, found


def compare(seeds: range, blocks: int, slack: float) -> None:
    """Both fidelities err alike: size of errors, honesty of variances, links reported, time to the first report."""
    a = [errors_of_decoder(seed, blocks) for seed in seeds]
    b = [errors_of_links(seed, blocks) for seed in seeds]
    settled = slice(20, None)
    rms = [np.sqrt(np.nanmean(np.concatenate([run[1][settled] for run in runs]) ** 2)) for runs in (a, b)]
    nis = [np.nanmean(np.concatenate([run[0][settled] for run in runs]) ** 2) for runs in (a, b)]
    bias = [np.nanmean(np.concatenate([run[1][settled] for run in runs])) for runs in (a, b)]
    links = [np.mean([np.isfinite(run[1][settled]).sum(axis=1).mean() for run in runs]) for runs in (a, b)]
    assert rms[0] == pytest.approx(rms[1], rel=slack)
    assert nis[0] == pytest.approx(nis[1], rel=2.0 * slack)
    assert np.abs(bias).max() < 0.3 * rms[0]
    assert links[0] == pytest.approx(links[1], abs=1.0)
    for run_a, run_b in zip(a, b, strict=True):
        assert abs(run_a[3] - run_b[3]) <= ACQUIRE


def test_both_fidelities_err_alike_in_a_quick_sample() -> None:
    compare(range(2), 60, slack=0.2)


@pytest.mark.slow
def test_both_fidelities_err_alike() -> None:
    compare(range(8), 250, slack=0.1)

"""The light half of a step: what is loaded when, and blocks and epochs on their way to the links."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from estimator.cdma import decoder as cdma_decoder
from estimator.cdma.epoch import BlockFlag, LightEpoch
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import UNLIMITED, Imu, Limits
from estimator.pipeline import new_state, step
from estimator.result import LinkState
from tests.estimator.cdma_scene import SAMPLES, ceiling, currents, sampled


def epoch_of(t: float, ids: list[int], amplitude: list[float]) -> LightEpoch:
    """An epoch as if a decoder had made it, 50 ms long and ending at ``t``."""
    n = len(ids)
    seen = (np.array(ids), np.array(amplitude), np.full(n, 1e-18), np.zeros(n, np.int64))
    return LightEpoch(t - 0.05, t, *seen, (None,) * n, BlockFlag.NONE, 1e-9, None)


def test_without_a_photodiode_nothing_of_light_is_loaded() -> None:
    code = (
        "import sys\nfrom estimator.pipeline import new_state, step\nfrom estimator.measurements import UNLIMITED\n"
        "assert step(new_state(), [], UNLIMITED).lights is None\n"
        "unwanted = 'estimator.cdma.decoder', 'estimator.light_filter.light_'\n"
        "loaded = [name for name in sys.modules if name.startswith(unwanted)]\n"
        "assert not loaded, loaded"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_light_without_a_photodiode_in_the_setup_is_passed_over() -> None:
    state = new_state()
    assert step(state, [epoch_of(0.05, [3], [1e-6])], UNLIMITED).lights is None


def test_links_come_strongest_first() -> None:
    state = new_state(lights=LightsSetup())
    lights = step(state, [epoch_of(0.05, [3, 7, 9], [1e-6, 2e-8, 2e-6])], UNLIMITED).lights
    assert lights is not None
    assert [link.code for link in lights.links] == [9, 3, 7]
    assert {link.state for link in lights.links} == {LinkState.UNSURVEYED}


@pytest.mark.jit
@pytest.mark.parametrize("codes", [129, 33])
def test_blocks_are_decoded_and_the_search_keeps_to_its_cap(codes: int) -> None:
    scene, state, t = ceiling(1, currents(4.6, 5.3)[:6]), new_state(lights=LightsSetup(clock_ppm=0.0)), 1.0
    limits, seen, blocks = Limits(50, 1000, update_map=True, codes=codes), set[int](), 0
    while len(seen) < 6 and blocks < 30:
        block = scene.block(t, SAMPLES, ())
        t = block.t1 + 2e-4
        lights = step(state, [sampled(block)], limits).lights
        assert lights is not None
        seen, blocks = {link.code for link in lights.links}, blocks + 1
    assert seen == {lamp.code for lamp in scene.lamps}
    assert blocks <= 5 if codes == 129 else 5 < blocks < 25


def test_a_stored_clock_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="clock_ppm"):
        new_state(lights=LightsSetup(clock_ppm=5e4))


@pytest.mark.jit
def test_where_blocks_come_every_other_cycle_the_search_is_done_in_the_one_between(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, state, t = ceiling(1, currents(4.6, 5.3)[:6]), new_state(lights=LightsSetup(clock_ppm=0.0)), 1.0
    efforts: list[int] = []
    search = cdma_decoder.search

    def watched(decoder: cdma_decoder.Decoder, codes: int) -> None:
        efforts.append(codes)
        search(decoder, codes)

    monkeypatch.setattr(cdma_decoder, "search", watched)
    for _ in range(12):
        block = scene.block(t, SAMPLES, ())
        t = block.t1 + 2e-4
        lights = step(state, [sampled(block)], UNLIMITED).lights
        with_block, efforts = len(efforts), []
        step(state, [Imu(t - 2e-4, t, 0.0)], UNLIMITED)
        between, efforts = list(efforts), []
    assert lights is not None
    assert {link.code for link in lights.links} == {lamp.code for lamp in scene.lamps}
    assert with_block == 0, "lamps are followed: the cycle has enough to do"
    assert between == [2 * UNLIMITED.codes], "and nothing of the effort is lost"
    for _ in range(3):  # now every cycle brings a block: there is none in between
        efforts.clear()
        block = scene.block(t, SAMPLES, ())
        t = block.t1 + 2e-4
        step(state, [sampled(block)], UNLIMITED)
    assert efforts == [UNLIMITED.codes]

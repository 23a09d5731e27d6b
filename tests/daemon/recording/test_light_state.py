"""A decoder among PWM-dimmed, slow and equal lamps goes on from a state as it would have without a stop."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from daemon.recording.checkpoint import Taken
from daemon.recording.restore import build
from estimator.cdma.decoder import Decoder, decode, search
from estimator.cdma.epoch import LightEpoch, LinkFlag
from tests.estimator.cdma_scene import EFFORT, SAMPLES, Run, ceiling, currents, sampled
from tests.estimator.oversampled_ceiling import OversampledCeiling
from tools.sim.light.transmitter import PwmLamp

pytestmark = pytest.mark.jit


def copied(decoder: Decoder) -> Decoder:
    taken = Taken()
    taken.seal(decoder)
    found = build(list(taken.nodes()))
    assert isinstance(found, Decoder)
    return found


def same(one: LightEpoch, other: LightEpoch) -> None:
    for mine, yours in ((one.ids, other.ids), (one.amplitude, other.amplitude), (one.variance, other.variance)):
        np.testing.assert_array_equal(mine, yours)
    assert (one.pwm, one.slow, one.block) == (other.pwm, other.slow, other.block)


def dimmed() -> Run:
    world = ceiling(5, currents(4.6, 5.3)[:8])
    world.dimmed = [PwmLamp(1000.0, 5e-6, 0.5, 0.37)]
    return Run(world)


def equal() -> Run:
    world = ceiling(6, currents(4.6, 5.3)[:8])
    world.lamps[1] = replace(world.lamps[1], code=world.lamps[0].code)
    return Run(world)


def slow_and_saturated() -> Run:
    world = ceiling(7, currents(4.6, 5.3)[:8])
    mean = world.ambient.current_a + sum(lamp.current_a for lamp in world.lamps)
    sampled = OversampledCeiling(world, 3.0, limit_a=mean + 2e-5, rise_s={0: 3e-5})
    return Run(sampled)  # type: ignore[arg-type]  # it has what a run needs of a ceiling


@pytest.mark.parametrize(
    ("make", "shows"),
    [
        (dimmed, lambda epoch: epoch.pwm),
        (equal, lambda epoch: (epoch.flags & LinkFlag.TWIN).any()),
        (slow_and_saturated, lambda epoch: epoch.slow),
    ],
)
def test_a_decoder_goes_on_from_a_state(make: Callable[[], Run], shows: Callable[[LightEpoch], object]) -> None:
    run = make()
    run.settle(30)
    other = copied(run.decoder)
    for k in range(5):
        block = sampled(run.ceiling.block(run.t + 0.0505 * k, SAMPLES))
        mine, yours = decode(run.decoder, block), decode(other, block)
        assert len(mine.ids) > 3
        assert shows(mine)
        same(mine, yours)
        search(run.decoder, EFFORT)
        search(other, EFFORT)

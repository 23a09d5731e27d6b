"""Light in the whole-daemon harness: a fake converter on a memory bus, or decoded epochs past decoder and bus."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

import numpy as np

from daemon.app import Environment
from daemon.config.schema import PhotodiodeConfig
from daemon.devices.conversion import SampleBridge
from daemon.devices.light_setup import Lights
from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.epoch import LightEpoch
from hal.adc import AdcStatus, Blemish, RawSamples
from hal.bus.i2c import BusOpener
from hal.clock import Clock
from hal.fake.adc.converter import FakeBuses
from hal.fake.faults.schedule import Target
from hal.lidar import Link
from tools.sim.ceiling.links import EPOCH_S, PERIOD_S
from tools.sim.light.scene import LINK, SceneLight
from tools.sim.light.serve import converter
from tools.sim.scene import Scene

BUS: Final = "/dev/i2c-simulated"
LEVEL: Final = "ads1115@0x48/0"
SAMPLES: Final = 1111
_OPENING_S: Final = 0.5
"""A converter at link level is found after this long."""


def lights_of(scene: Scene) -> SceneLight | None:
    """The lamps over a scene, None if there are none."""
    light = getattr(scene, "light", None)
    return light if isinstance(light, SceneLight) else None


def light_up(world: Environment, light: SceneLight, clock: Clock) -> dict[str, Target]:
    """Give the daemon's surroundings a converter under the lamps; returns what faults may be ordered of."""
    world.lights = Lights(light.survey, PROFILE_A)
    if light.lights.fidelity == LINK:
        world.make_adc = _no_converter
        return {}
    device = converter(light, clock)
    buses = FakeBuses(clock)
    buses.plug(BUS, device)
    world.buses = buses
    return {"adc": device}


class _Ticking:
    """An :class:`hal.adc.Adc` that delivers blocks of nothing in the rhythm of a converter."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.status = AdcStatus()

    async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
        """See :class:`hal.adc.Adc`."""
        await asyncio.sleep(_OPENING_S)
        self.status.link = Link.STREAMING
        words = np.full(SAMPLES, 2048, dtype=np.uint16)
        while True:
            t0 = self._clock.now()
            await asyncio.sleep(PERIOD_S)
            seq, self.status.blocks = self.status.blocks, self.status.blocks + 1
            rate = SAMPLES / EPOCH_S
            on_samples(RawSamples(seq, t0, t0 + EPOCH_S, t0, rate, words, 12, Blemish.NONE))


def _no_converter(config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> _Ticking:
    return _Ticking(clock)


class LinkBridge(SampleBridge):
    """Puts what a decoder would have said in the place of each block."""

    def __init__(self, light: SceneLight) -> None:
        super().__init__(PROFILE_A)
        self._light = light

    def block(self, raw: RawSamples) -> LightEpoch:  # type: ignore[override]  # `step` takes either
        """An epoch for each block."""
        self.rate_hz = raw.rate_hz
        return self._light.epoch(raw.t_first, raw.t_first + EPOCH_S)

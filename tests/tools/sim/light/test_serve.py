"""The lights of a simulated building, read by another process over a socket."""

from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np

from hal.bus.i2c import read
from hal.bus.opening import open_bus
from tools.sim.light.scene import Lights
from tools.sim.light.serve import serve_light
from tools.sim.scene import Scenario, SimulatedScene


def lit(**lights: object) -> SimulatedScene:
    return SimulatedScene(Scenario("corridor_loop", people=False, lights=Lights(**lights)))  # type: ignore[arg-type]


async def test_a_block_is_read_over_the_socket(tmp_path: Path) -> None:
    scene = lit()
    assert scene.light is not None
    async with AsyncExitStack() as stack:
        _, where = await serve_light(scene.light, f"unix:{tmp_path}/i2c", stack)
        bus = await open_bus(where)
        try:
            done = await bus.transfer((read(0x4D, 2222),))
        finally:
            await bus.close()
    words = np.frombuffer(done.reads[0], dtype=">u2").astype(float)
    assert len(words) == 1111
    assert words.max() < 4096
    swing = np.abs(np.fft.rfft(words - words.mean()))
    chips = swing[(np.fft.rfftfreq(1111, 18 / 400e3) > 2000)]  # above all mains harmonics
    assert np.sqrt(np.mean(chips**2)) / np.sqrt(1111 / 2) > 3.0  # LSB: the converter's own noise is 0.5

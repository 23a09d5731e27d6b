"""The light of a scene as devices: a fake converter under the lamps, its bus on a socket, the plan as a survey file."""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

from hal.bus.i2c_server import BusServer
from hal.clock import Clock, SystemClock
from hal.fake.adc.converter import FakeAdc, FakeBuses
from tools.sim.light.scene import SceneLight

BUS: Final = "simulated"


def converter(light: SceneLight, clock: Clock) -> FakeAdc:
    """A fake MCP3221, and an ADS1115 as DC channel if the scenario has one, under the lamps."""
    device = FakeAdc(light.sample, clock)
    device.bus.scl_error = light.lights.scl_error
    if light.lights.level:
        device.add_level(light.level)
    return device


async def serve_light(light: SceneLight, where: str, stack: AsyncExitStack) -> tuple[FakeAdc, str]:
    """Serve the converter's bus at ``unix:/path`` or ``tcp://host:port`` in real time.

    Returns:
        The converter, for faults, and what the daemon's ``photodiode.bus`` has to be.

    Raises:
        DeviceRefused: the address cannot be used.
    """
    clock = SystemClock()
    light.prepare()
    device, buses = converter(light, clock), FakeBuses(clock)
    buses.plug(BUS, device)
    server = BusServer(buses, BUS, clock)
    stack.push_async_callback(server.close)
    return device, await server.listen(where)


def write_plan(light: SceneLight, path: Path) -> None:
    """The plan of the lamps as the survey file that ``lights.survey`` names; a file that is there is replaced.

    Raises:
        SurveyError: it cannot be written.
    """
    from daemon.config.survey_loader import write_survey

    write_survey(
        path, light.survey, notes=("As planned: where lamps really hang, and how bright, differs.",), force=True
    )

"""A recorded teach drive: the whole daemon on the simulated robot under simulated lamps, in virtual time."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

from daemon.app import Daemon
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount, OdometryConfig, PhotodiodeConfig
from daemon.recording.recorder import Recorder
from hal.clock import LoopClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import Unit
from hal.fake.transport.memory_host import FakeOpener
from hal.net.inputs import InputPort
from tools.sim.building.buildings import building
from tools.sim.feed import feed_odometry
from tools.sim.harness import DEVICE, world
from tools.sim.light.harness import BUS, light_up
from tools.sim.light.link_drive import ROOM_BODY, ROOM_ROUTE
from tools.sim.light.scene import Lights
from tools.sim.scene import Scenario, SimulatedScene


def scene() -> SimulatedScene:
    """The paper's room with its lamps and nobody in it; the robot drives up and down and across it."""
    place = replace(building("paper_room"), route=ROOM_ROUTE)
    return SimulatedScene(Scenario(people=False, laps=1, body=ROOM_BODY, lights=Lights()), place)


def record(folder: Path, seconds: float) -> SimulatedScene:
    """Record that many seconds; returns the scene, which knows the truth."""
    return run_virtual(_record(folder, seconds))


async def _record(folder: Path, seconds: float) -> SimulatedScene:
    made = scene()
    clock = LoopClock(asyncio.get_running_loop(), utc_at_zero=1.7e9)
    opener = FakeOpener(clock)
    device = FakeHokuyo(made.model, made.scan, unit=Unit(seed=1), rotor=made.rotor())
    opener.plug(DEVICE, device)
    around = world(clock, opener, lambda snapshot: None)
    assert made.light is not None
    light_up(around, made.light, clock)
    x, y, _ = made.mount
    settings = Config(
        lidar=LidarConfig(device=DEVICE, mount=Mount(x, y, 0.0)),
        odometry=OdometryConfig(port=1),
        modbus=ModbusConfig(port=0),
        photodiode=PhotodiodeConfig(bus=BUS),
    )
    recorder = Recorder(folder, settings, clock, around.lights)
    daemon = Daemon(settings, around, recorder)
    for part in ("odometry", "imu"):
        daemon.network.parts.pop(part)
    port = InputPort(clock, "", 1)
    port.send_odometry_to(recorder.on_odometry(daemon.cycle.inbox.put_odometry))
    wheels = asyncio.create_task(feed_odometry(made, lambda data: port.receive(data, clock.now())))
    stop = asyncio.Event()
    asyncio.get_running_loop().call_later(seconds, stop.set)
    try:
        await daemon.run(stop)
    finally:
        wheels.cancel()
        device.close()
    return made

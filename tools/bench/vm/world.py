"""The world outside the emulated computer: a room, a robot that drives through it, its lidar, wheels and photodiode.

``python -m tools.bench.vm.world ODOMETRY TRUTH CONTROL``: ports for UDP datagrams, and a socket for fault orders. Says
in one line of JSON where its lidar and its I2C bus are. The robot stands until SIGUSR1, then drives lap after lap with
a pause before each. The lamps over it are ordinary ones: looking for others' codes takes an emulated processor long
enough.
"""

import asyncio
import json
import secrets
import signal
import sys
from contextlib import AsyncExitStack
from pathlib import Path

from hal.bus.i2c_server import BusServer
from hal.clock import SystemClock
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.adc.light import OrdinaryLamps
from hal.fake.faults.control import Control, serve_control
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import Unit
from hal.fake.transport.tcp_server import TcpServer
from tools.bench.world.room import LIDAR, room
from tools.bench.world.stage import ForeignSender
from tools.sim.feed import UdpSender, feed_odometry, feed_truth
from tools.sim.robot.drive import Body
from tools.sim.robot.hands import Hands
from tools.sim.robot.odometry import Wheels
from tools.sim.scene import Scenario, SimulatedScene

BUS = "bench"
DWELL_S = 4.0
WHEELS_HZ = 20.0
"""Each datagram costs the emulated processor a millisecond."""
ROBOT = Body(speed=0.4, turn_rate=0.6)
"""Slow: what a pose is late by is way, and the emulated computer hears of a scan when its processor comes to it."""


def scenario() -> Scenario:
    """What is driven."""
    return Scenario(lidar=LIDAR, people=False, dwell_s=DWELL_S, body=ROBOT, wheels=Wheels(rate_hz=WHEELS_HZ))


async def serve(odometry: int, truth: int, control: Path) -> None:
    """Until SIGINT or SIGTERM."""
    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    scene = SimulatedScene(scenario(), room(), held=True)
    loop.add_signal_handler(signal.SIGUSR1, scene.release)
    async with AsyncExitStack() as stack:
        device = FakeHokuyo(scene.model, scene.scan, unit=Unit(serial="H0000001"))
        stack.callback(device.close)
        server = TcpServer(device)
        stack.push_async_callback(server.close)
        lidar = await server.listen("127.0.0.1", 0)
        converter = FakeAdc(OrdinaryLamps(), SystemClock())
        buses = FakeBuses(SystemClock())
        buses.plug(BUS, converter)
        bus_server = BusServer(buses, BUS, SystemClock())
        stack.push_async_callback(bus_server.close)
        bus = await bus_server.listen("tcp://127.0.0.1:0")
        schedule = FaultSchedule({"lidar": device, "robot": Hands(scene, loop.time), "adc": converter})
        stack.callback(schedule.close)
        stack.callback((await serve_control(Control(schedule), control)).close)
        wheels, sight = ForeignSender(f"udp://127.0.0.1:{odometry}"), UdpSender(f"udp://127.0.0.1:{truth}")
        stack.callback(wheels.close)
        stack.callback(sight.close)
        feeds = [
            asyncio.create_task(feed_odometry(scene, wheels.send, session=secrets.randbits(32))),
            asyncio.create_task(feed_truth(scene, sight.tell)),
        ]
        sys.stdout.write(json.dumps({"lidar": lidar, "bus": bus}) + "\n")
        sys.stdout.flush()
        await stop.wait()
        for feed in feeds:
            feed.cancel()
        await asyncio.gather(*feeds, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])))

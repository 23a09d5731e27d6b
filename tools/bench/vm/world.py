"""The world outside the emulated computer: a room, a robot that drives through it, its lidar, wheels and photodiode.

``python -m tools.bench.vm.world ODOMETRY TRUTH CONTROL``: ports for UDP datagrams, and a socket for fault orders. Says
in one line of JSON where its lidar and its I2C bus are. The robot stands until SIGUSR1, then drives lap after lap with
a pause before each. The lamps over it are ordinary ones: looking for others' codes takes an emulated processor long
enough.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import signal
import sys
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path

from hal.clock import SystemClock
from hal.fake.adc import FakeAdc, FakeBuses
from hal.fake.adc_light import OrdinaryLamps
from hal.fake.control import Control, serve_control
from hal.fake.hokuyo import FakeHokuyo
from hal.fake.models import MODELS, PAPER, Unit
from hal.fake.schedule import FaultSchedule
from hal.fake.tcp_server import TcpServer
from hal.i2c_server import BusServer
from hal.input_codec import decode, encode
from tools.sim.buildings import Building
from tools.sim.feed import UdpSender, feed_odometry, feed_truth
from tools.sim.hands import Hands
from tools.sim.robot import Route
from tools.sim.scene import Scenario, SimulatedScene
from tools.sim.world import Plan

MODEL, BUS = "bench", "bench"
DWELL_S = 4.0
LAP_CORNERS = ((-2.6, -1.9), (2.4, -1.9), (2.4, 1.6), (-2.6, 1.6))


def register() -> None:
    """A lidar whose scans an emulated computer can keep up with: 180 deg, 181 beams, 5 Hz, on USB."""
    modl = "BENCH-180[180 degrees, 181 beams, 5 Hz]"
    MODELS[MODEL] = replace(PAPER, modl=modl, ares=360, amax=180, afrt=90, rpm=300, true_period_s=0.2)


def room() -> Building:
    """9 x 7 m with things that make every place in it look like no other."""
    plan = Plan()
    for start, end in (((-4.5, -3.5), (4.5, -3.5)), ((4.5, -3.5), (4.5, 3.5)), ((4.5, 3.5), (-4.5, 3.5))):
        plan.line(start, end)
    plan.line((-4.5, 3.5), (-4.5, 1.0))
    plan.line((-4.5, 1.0), (-5.3, 1.0))
    plan.line((-5.3, 1.0), (-5.3, -3.5))
    plan.line((-5.3, -3.5), (-4.5, -3.5))
    plan.box((3.6, 2.8), (1.4, 0.8), 0.0, "wood")
    plan.box((-3.4, -3.0), (0.7, 0.7), 0.4, "wood")
    plan.circle((0.3, 0.2), 0.3)
    plan.circle((-1.2, 3.0), 0.2)
    return Building("bench", plan.build(), Route(LAP_CORNERS, 1.2))


class ForeignSender(UdpSender):
    """Odometry of another computer: its clock means nothing to the daemon, so the bit that says so is cleared."""

    def send(self, data: bytes) -> None:
        """See :class:`UdpSender`."""
        super().send(encode(replace(decode(data), flags=0)))


async def serve(odometry: int, truth: int, control: Path) -> None:
    """Until SIGINT or SIGTERM."""
    register()
    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    scene = SimulatedScene(Scenario(lidar=MODEL, people=False, dwell_s=DWELL_S), room(), held=True)
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

"""The simulated world as a process of its own, in real time: lidar, light, odometry datagrams, the truth.

::

    python -m tools.sim --building paper_room --pty /tmp/lidar --odometry udp://127.0.0.1:5601
    python -m tools.sim --building office_floor --lidar UST-20LX --tcp 127.0.0.1:10940 --truth truth.tum
    python -m tools.sim --pty /tmp/lidar --odometry udp://127.0.0.1:5601 --light unix:/tmp/i2c --survey lamps.toml
    python -m tools.sim --log intel.clf.gz --pty /tmp/lidar --odometry udp://127.0.0.1:5601

It meets the daemon only there. The robot stands still until the lidar is first read, or until it is told to drive.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import secrets
import signal
import sys
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daemon.config.survey_loader import SurveyError
from hal.errors import HalError
from hal.fake.faults.control import Control, serve_control
from hal.fake.faults.orders import FaultError
from hal.fake.faults.schedule import FaultSchedule, Target
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import MODELS, Unit
from hal.fake.transport.pty_server import PtyServer
from hal.fake.transport.tcp_server import TcpServer
from hal.run_server import run_until_stopped
from tools.sim.building.buildings import BUILDINGS
from tools.sim.ceiling.ceiling import Effects
from tools.sim.feed import TumWriter, UdpSender, feed_odometry, feed_truth
from tools.sim.hybrid import HybridScene
from tools.sim.light.scene import Lights
from tools.sim.light.serve import serve_light, write_plan
from tools.sim.robot.hands import Hands
from tools.sim.scene import Scenario, Scene, SimulatedScene

LOG_LEAD_S = 3.0
"""A log starts this long after the simulator, so that its first scans find a reader."""


@dataclass(slots=True)
class Options:
    """The command line, see :func:`parser`."""

    building: str
    log: Path | None
    lidar: str
    seed: int
    empty: bool
    laps: float
    dwell: float
    hold: bool
    pty: Path | None
    tcp: str | None
    odometry: str | None
    truth: str | None
    light: str | None
    survey: Path | None
    spread: float
    faults: Path | None
    control: Path | None
    clock_ppm: float
    seconds: float


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(prog="python -m tools.sim", description="The simulated world in real time.")
    add = made.add_argument
    add("--building", default="paper_room", choices=sorted(BUILDINGS), help="where (default %(default)s)")
    add("--log", type=Path, help="a CARMEN log whose scans drive the lidar, instead of a building")
    add("--lidar", default="paper", choices=sorted(MODELS), help="type of sensor (default %(default)s)")
    add("--seed", type=int, default=0, help="of noise, slip and people")
    add("--empty", action="store_true", help="nobody walks about")
    add("--laps", type=float, default=np.inf, help="tours to drive, then stand still (default: for ever)")
    add("--dwell", type=float, default=2.0, help="seconds of standing still before each tour (default %(default)s)")
    add("--hold", action="store_true", help="the robot stands still until this process gets SIGUSR1")
    add("--pty", type=Path, metavar="LINK", help="the lidar as a serial port, found by this symbolic link")
    add("--tcp", metavar="HOST:PORT", help="the lidar over TCP; port 0 chooses a free one")
    add("--odometry", metavar="udp://HOST:PORT", help="where wheel odometry datagrams go")
    add("--truth", metavar="udp://HOST:PORT|FILE", help="where the true pose goes: JSON datagrams, or a TUM file")
    add(
        "--light",
        metavar="unix:/PATH|tcp://HOST:PORT",
        help="coded lamps, seen by a converter on an I2C bus served here",
    )
    add("--survey", type=Path, metavar="FILE", help="write the plan of the lamps here, a survey for the daemon")
    add("--spread", type=float, default=0.05, help="of the lamps' powers about the plan (default %(default)s)")
    add(
        "--faults",
        type=Path,
        metavar="FILE",
        help="TOML schedule of orders for `lidar`, `adc`, `robot`; starts at once",
    )
    add("--control", type=Path, metavar="SOCKET", help="accept fault commands on a unix socket")
    add("--clock-ppm", type=float, default=0.0, help="rate error of the sensor's clock, in ppm")
    add("--seconds", type=float, default=0.0, help="end after this time (default: run until interrupted)")
    return made


def make_scene(options: Options, t_mono: float) -> Scene:
    """A building or a log; a log starts a little after ``t_mono``, its clock cannot wait for a reader."""
    if options.log is None:
        scenario = Scenario(
            options.building,
            options.lidar,
            options.seed,
            people=not options.empty,
            dwell_s=options.dwell,
            laps=options.laps,
            lights=Lights(effects=Effects(gain_spread=options.spread)) if options.light or options.survey else None,
        )
        scene = SimulatedScene(scenario, held=options.hold)
        asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, scene.release)
        return scene
    if options.light or options.survey:
        raise ValueError("--light and --survey need a building; a log has no lamps")
    if options.hold:
        raise ValueError("--hold holds a robot in a building; a log goes on by its own clock")
    from hal.replay.carmen import read_carmen

    log = read_carmen(options.log)
    return HybridScene(log.events(t_mono + LOG_LEAD_S), mount=log.mount)


async def serve(options: Options, say: Callable[[dict[str, Any]], None]) -> None:
    """Run until told to stop. ``say`` gets one object when the devices are there and one at the end."""
    loop = asyncio.get_running_loop()
    scene = make_scene(options, loop.time())
    unit = Unit(serial=f"SIM{options.seed:05d}", clock_gain=options.clock_ppm * 1e-6, seed=options.seed)
    device = FakeHokuyo(scene.model, scene.scan, unit=unit, rotor=scene.rotor())
    async with AsyncExitStack() as stack:
        stack.callback(device.close)
        targets: dict[str, Target] = {"lidar": device}
        there = {"model": scene.model.modl, "start": scene.truth(np.array([loop.time()]))[0].tolist()}
        there |= await _light_up(options, scene, targets, stack)
        if isinstance(scene, SimulatedScene):
            targets["robot"] = Hands(scene, loop.time)
        schedule = FaultSchedule(targets)
        stack.callback(schedule.close)
        if options.faults is not None:
            schedule.load(options.faults.read_text(encoding="utf-8"))
        if options.control is not None:
            stack.callback((await serve_control(Control(schedule), options.control)).close)
        lidar = await _connect(options, device, stack)
        feeds = _feeds(options, scene, stack)
        say({"lidar": lidar, **there})
        await run_until_stopped(*feeds, seconds=options.seconds)
    counts = device.counts
    say(
        {"scans": device.scans_sent, "sent": counts.sent, "unheard": counts.without_host, "lost": counts.lost_in_sensor}
    )


async def _light_up(
    options: Options, scene: Scene, targets: dict[str, Target], stack: AsyncExitStack
) -> dict[str, Any]:
    """Offer the light; returns what the daemon's ``photodiode.bus`` has to be."""
    light = scene.light if isinstance(scene, SimulatedScene) else None
    if light is None:
        return {}
    if options.survey is not None:
        write_plan(light, options.survey)
    if options.light is None:
        return {}
    targets["adc"], bus = await serve_light(light, options.light, stack)
    return {"light": bus, "lamps": len(light.ceiling.fixtures)}


async def _connect(options: Options, device: FakeHokuyo, stack: AsyncExitStack) -> str:
    """Offer the lidar; returns what the daemon's ``lidar.device`` has to be."""
    if options.tcp is None:
        pty = PtyServer(device, options.pty)
        stack.callback(pty.close)
        return pty.path
    host, _, port = options.tcp.rpartition(":")
    if not port.isdigit():
        raise ValueError(f"--tcp {options.tcp}: expected HOST:PORT, as 127.0.0.1:10940; port 0 chooses a free one")
    server = TcpServer(device)
    stack.push_async_callback(server.close)
    return f"tcp://{host}:{await server.listen(host, int(port))}"


def _feeds(options: Options, scene: Scene, stack: AsyncExitStack) -> list[Coroutine[Any, Any, None]]:
    feeds = []
    if options.odometry is not None:
        sender = UdpSender(options.odometry)
        stack.callback(sender.close)
        feeds.append(feed_odometry(scene, sender.send, session=secrets.randbits(32)))
    if options.truth is not None:
        sink = UdpSender(options.truth) if options.truth.startswith("udp:") else TumWriter(Path(options.truth))
        stack.callback(sink.close)
        feeds.append(feed_truth(scene, sink.tell))
    return feeds


def _say(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Run until interrupted; 2 when something in the arguments is wrong."""
    options = Options(**vars(parser().parse_args(arguments)))
    if options.pty is not None and options.tcp is not None:
        sys.stderr.write("a sensor has one line; give --pty or --tcp\n")
        return 2
    try:
        asyncio.run(serve(options, _say))
    except (HalError, FaultError, SurveyError, OSError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0

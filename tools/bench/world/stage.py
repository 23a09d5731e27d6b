"""One scenario in real time: devices out of this computer's ports, poses in over Modbus, orders when they are due."""

import asyncio
import math
import re
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from hal.bus.i2c_server import BusServer
from hal.clock import SystemClock
from hal.errors import DeviceRefused, HalError
from hal.fake.adc.converter import FakeBuses
from hal.fake.faults.orders import read_fault
from hal.fake.faults.schedule import FaultSchedule, Target
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import Unit
from hal.fake.transport.pty_server import PtyServer
from hal.fake.transport.tcp_server import TcpServer
from hal.net.input_codec import decode, encode
from tools.bench.support.other_clock import OtherClock
from tools.bench.world.dac import DacThread
from tools.bench.world.judge import Played, Pose, Read
from tools.bench.world.scenario import Scenario
from tools.bench.world.serialend import SerialEnd
from tools.clients.read_lights import Reader as LightReader
from tools.clients.read_modbus import Reader
from tools.sim.feed import UdpSender, feed_odometry
from tools.sim.light.serve import BUS, converter
from tools.sim.robot.hands import Hands
from tools.sim.scene import SimulatedScene

LINES: Final = "/dev/ttyUSB0, /dev/ttyUSB0@115200, pty:PATH or tcp://HOST:PORT"
POLL_S: Final = 0.01
WAIT_S: Final = 0.05
STANDING_S: Final = 2.0
"""Poses of so long, read while it stands, say where the map lies."""
STILL_M, STILL_RAD, FEWEST = 0.05, 0.05, 3
"""They differ by less, and are as many at least: else it is still looking for its place."""
PLACED: Final = ("MAPPING", "TRACKING", "DEGRADED")
LOOKING: Final = ("RELOCATING", "AMBIGUOUS")
HEARD_A: Final = 1e-9
SET_OFF_S: Final = 5.0


class CannotPlay(Exception):
    """The robot computer does not answer, or does not find a place; the text says what to look at."""


@dataclass(frozen=True, slots=True)
class Ends:
    """Where things go.

    Attributes:
        lidar: ``/dev/ttyUSB0@BAUD``, ``pty:PATH`` or ``tcp://HOST:PORT``. modbus: (host, port).
        odometry: ``udp://HOST:PORT`` or empty. light: ``dac:BUS@ADDRESS``, ``unix:PATH``, ``tcp://HOST:PORT`` or empty.
        anyone: a bus served over TCP may be used from other computers.
    """

    lidar: str
    modbus: tuple[str, int]
    odometry: str = ""
    light: str = ""
    anyone: bool = False


def is_port(text: str) -> bool:
    """Whether that is the number of a port which others can reach."""
    return text.isdecimal() and 0 < int(text) < 65536


class Port(Protocol):
    """A port of this computer that may fail while it is played: ``lost`` says how."""

    lost: HalError | None


class ForeignSender(UdpSender):
    """Odometry of another computer: its clock is not the daemon's, so the bit that says it is gets cleared."""

    def send(self, data: bytes) -> None:
        """See :class:`UdpSender`."""
        super().send(encode(replace(decode(data), flags=0)))


class Ears:
    """Reads poses over Modbus, and lamps where they are wanted, in a thread of its own."""

    def __init__(self, host: str, port: int, lamps: bool) -> None:
        self._pose = Reader(host, port)
        self._lamps = LightReader(host, port) if lamps else None
        self.reads: list[Read] = []
        self._seq, self._t_pose, self._clock = -1, math.nan, OtherClock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="modbus", daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stop.wait(POLL_S):
            self.reads.append(self._one())

    def _one(self) -> Read:
        try:
            told: dict[str, Any] = self._pose.read()
            lamps = self._heard()
        except (OSError, ValueError):
            return Read(time.monotonic(), answered=False)
        now = time.monotonic()
        fresh, self._seq = told["seq"] != self._seq, told["seq"]
        placed = told["x"] is not None and told["age"] is not None
        if fresh:  # it lay there unread for up to POLL_S, on a busy computer for longer
            made, age = told["t_mono"], told["age"]
            self._t_pose = self._clock.here(made, made + age, now) if placed else math.nan
        pose = (told["x"], told["y"], told["yaw"]) if placed else None
        sigma = max(told["sigma_x"] or 0.0, told["sigma_y"] or 0.0)
        counts = told["jumps"], told["loops"]
        return Read(
            now, told["state"], told["fault"], self._t_pose, pose, sigma, True, fresh and placed, lamps, *counts
        )

    def _heard(self) -> tuple[tuple[int, float], ...]:
        if self._lamps is None:
            return ()
        links: Any = self._lamps.read()["links"]
        return tuple((one["lamp"], one["strength"]) for one in links if one["lamp"] is not None and one["strength"])

    def close(self) -> None:
        """Stop and hang up."""
        self._stop.set()
        self._thread.join()
        self._pose.close()
        if self._lamps is not None:
            self._lamps.close()


async def play(scenario: Scenario, ends: Ends, say: Callable[[str], None]) -> Played:
    """Play it to its end.

    Raises:
        CannotPlay: nobody answers, or there is no pose within ``settle``. HalError: a port cannot be used.
        FaultError: an order in the file makes no sense.
    """
    scene = scenario.scene(held=True)
    device = FakeHokuyo(scene.model, scene.scan, unit=Unit(serial="H0000001", seed=scenario.world.seed))
    async with AsyncExitStack() as stack:
        stack.callback(device.close)
        targets: dict[str, Target] = {"lidar": device, "robot": Hands(scene, time.monotonic)}
        ports = [] if scene.light is None else await _light(scene, ends, targets, stack)
        schedule = FaultSchedule(targets)
        stack.callback(schedule.close)
        faults = [read_fault(one, f"fault[{k}]", schedule.vocabularies) for k, one in enumerate(scenario.faults)]
        ports += await _connect(device, ends.lidar, stack)
        if ends.odometry and scenario.world.odometry:
            await _roll(scene, ends.odometry, stack)
        ears = Ears(*ends.modbus, lamps=scene.light is not None)
        stack.callback(ears.close)
        standing = await _settled(scenario, ends, ears, ports, say)
        scene.release()
        t_go = await _set_off(scene)
        for fault in faults:
            schedule.order(fault)
        say(f"it drives for {scenario.drive.seconds:g} s")
        until = time.monotonic() + scenario.drive.seconds
        while (left := until - time.monotonic()) > 0.0:
            await asyncio.sleep(min(left, WAIT_S))
            _all_there(ports)
        reads = [_since(one, t_go) for one in ears.reads if one.t >= t_go]
    return _played(scenario, scene, reads, standing, t_go)


def _all_there(ports: list[Port]) -> None:
    """Raise what has become of the first that failed: what is read without it says nothing of the robot computer."""
    for port in ports:
        if port.lost is not None:
            raise port.lost


async def _set_off(scene: SimulatedScene) -> float:
    """Wait for the scan with which it sets off; the instant."""
    for _ in range(round(SET_OFF_S / WAIT_S)):
        if scene.t_go is not None:
            return scene.t_go
        await asyncio.sleep(WAIT_S)
    raise CannotPlay(
        f"the robot computer has read no scan for {SET_OFF_S:g} s since it had a pose: is its line still in?"
    )


def _since(one: Read, t_go: float) -> Read:
    return replace(one, t=one.t - t_go, t_pose=one.t_pose - t_go)


def _played(scenario: Scenario, scene: SimulatedScene, reads: list[Read], standing: list[Pose], t_go: float) -> Played:
    light = scene.light
    if light is None:
        return Played(scenario, reads, lambda t: scene.truth(t + t_go), standing)
    names = [lamp.lamp_id for lamp in light.ceiling.fixtures]

    def strongest(t: float) -> int | None:
        strengths = light.stream.track.at(t + t_go)
        best = int(np.argmax(strengths))
        return names[best] if strengths[best] > HEARD_A else None

    return Played(scenario, reads, lambda t: scene.truth(t + t_go), standing, frozenset(names), strongest)


async def _light(scene: SimulatedScene, ends: Ends, targets: dict[str, Target], stack: AsyncExitStack) -> list[Port]:
    """The lamps' light: as a voltage, or as a converter on a bus that is served."""
    light = scene.light
    assert light is not None
    if not ends.light:
        raise CannotPlay("the scenario has coded lamps: say with --light where their light goes")
    bus, _, address = ends.light.removeprefix("dac:").rpartition("@")
    if ends.light.startswith("dac:") and not (bus and re.fullmatch("0x[0-9a-f]{1,2}", address.lower())):
        raise DeviceRefused(ends.light, "not the name of a DAC", "expected dac:/dev/i2c-1@0x60")
    light.prepare()
    if ends.light.startswith("dac:"):
        thread = await asyncio.to_thread(DacThread, bus, int(address, 16), light.sample)
        stack.callback(thread.close)
        return [thread]
    device = converter(light, SystemClock())
    targets["adc"] = device
    buses = FakeBuses(SystemClock())
    buses.plug(BUS, device)
    server = BusServer(buses, BUS, SystemClock(), anyone=ends.anyone)
    stack.push_async_callback(server.close)
    await server.listen(ends.light)
    return []


def is_line(where: str) -> bool:
    """Whether it is a serial line by its form: a path, and a rate if there is one."""
    path, at, baud = where.partition("@")
    return path.startswith("/") and (not at or baud.isdigit())


async def _connect(device: FakeHokuyo, where: str, stack: AsyncExitStack) -> list[Port]:
    """Offer the lidar."""
    if where.startswith("tcp://"):
        host, _, port = where.removeprefix("tcp://").rpartition(":")
        if not is_port(port):
            raise DeviceRefused(
                where, "not an address to listen on", "expected tcp://HOST:PORT, as tcp://0.0.0.0:10940"
            )
        server = TcpServer(device)
        stack.push_async_callback(server.close)
        await server.listen(host, int(port))
        return []
    if where.startswith("pty:"):
        pty = PtyServer(device, Path(where.removeprefix("pty:")))
        stack.callback(pty.close)
        return []
    if not is_line(where):
        raise DeviceRefused(where, "not a line", f"expected {LINES}")
    path, _, baud = where.partition("@")
    line = SerialEnd(device, path, int(baud or 115200))
    stack.callback(line.close)
    return [line]


async def _roll(scene: SimulatedScene, where: str, stack: AsyncExitStack) -> None:
    sender = ForeignSender(where)
    stack.callback(sender.close)
    feed = asyncio.create_task(feed_odometry(scene, sender.send, session=secrets.randbits(32)))

    async def end() -> None:
        feed.cancel()
        await asyncio.wait([feed])

    stack.push_async_callback(end)


async def _settled(
    scenario: Scenario, ends: Ends, ears: Ears, ports: list[Port], say: Callable[[str], None]
) -> list[Pose]:
    """Wait until the standing robot has a place, and says for a while that it is there."""
    host, port = ends.modbus
    say(f"{scenario.title}: waiting for a pose from {host} port {port}")
    begun = time.monotonic()
    while (poses := standing(ears.reads, begun)) is None:
        _all_there(ports)
        if time.monotonic() - begun > scenario.drive.settle + STANDING_S:
            last = ears.reads[-1] if ears.reads else Read(0.0, answered=False)
            raise CannotPlay(why_no_pose(last, ends, scenario.drive.settle))
        await asyncio.sleep(WAIT_S)
    return poses


def standing(reads: list[Read], begun: float) -> list[Pose] | None:
    """Poses of the latest `STANDING_S`, where the robot has said all that time that it is in one place; else None.

    What stood in the registers when the line was opened, ``begun``, is of a drive before, which ended elsewhere.
    """
    latest = reads[-1].t if reads else begun
    heard = [one for one in reads if one.t >= max(begun, latest - STANDING_S)]
    if latest - begun < STANDING_S or not all(one.state in PLACED and one.t_pose > begun for one in heard):
        return None
    poses = [one.pose for one in heard if one.fresh and one.pose is not None]
    if len(poses) < FEWEST:
        return None
    x, y, yaw = np.array(poses).T
    turned = np.remainder(yaw - yaw[0] + np.pi, 2.0 * np.pi) - np.pi
    still = max(np.ptp(x), np.ptp(y)) < STILL_M and np.ptp(turned) < STILL_RAD
    return poses if still else None


def why_no_pose(last: Read, ends: Ends, settle: float) -> str:
    """What to look at, by the last that was read, where there is no pose after ``settle`` s."""
    host, port = ends.modbus
    if not last.answered:
        return (
            f"nobody answers at {host} port {port}: is lumiloop running there, does its `bind` and `allow` let this "
            f"computer in, is UDP port {port} open in its firewall?"
        )
    if last.state in LOOKING:
        return (
            f"no pose within {settle:g} s: state {last.state}: it looks for its place. Has it started with a map, of "
            'another drive or another building? Stop it, give it [map] folder = "none" (--write-config writes that), '
            "and start it again. Under lamps: does their light arrive?"
        )
    if last.pose is not None and last.state in PLACED:
        return (
            f"no pose that stays within {settle:g} s: state {last.state}, fault {last.fault}; it "
            "stands, and its pose must be new, and move by less than 5 cm and 3 deg for 2 s"
        )
    return (
        f"no pose within {settle:g} s: state {last.state}, fault {last.fault}; does its lidar.device name the line "
        f"that comes from {ends.lidar}? On the robot computer: lumiloop probe"
    )

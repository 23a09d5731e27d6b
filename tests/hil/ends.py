"""Two kinds of ends for one test body: fakes in virtual time, and devices that ``--lidar`` and ``--adc`` name.

A body is a coroutine; :meth:`End.play` runs it where its device is.
"""

import asyncio
import errno
import math
import socket
import termios
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Generic, Protocol, TypeVar

import pytest

from daemon.config.endpoints import LidarPlace, parse_lidar
from hal.adc import RawSamples
from hal.bus.i2c import BusOpener
from hal.bus.opening import open_bus
from hal.clock import Clock, LoopClock, SystemClock, run_virtual
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.adc.light import OrdinaryLamps
from hal.fake.faults.control import Control
from hal.fake.faults.schedule import FaultSchedule, Target
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UTM_30LX, Unit
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from hal.hokuyo.driver import HokuyoDriver
from hal.hokuyo.probe import Finding, identify_at
from hal.lidar import RawScan
from hal.photodiode.chips import chip_named
from hal.photodiode.driver import PhotodiodeAdc
from hal.port.opening import open_port
from hal.port.port import PortOpener

FAKE: Final = "fake"
NONE: Final = "none"
"""No device of that kind is tried, because another one is."""
LINE, BUS = "/dev/ttyACM7", "/dev/i2c-7"  # names that stand for a kind; nothing is opened under them
UNIT: Final = Unit(serial="H0000007", clock_gain=30e-6, seed=7)
ANSWER_S: Final = 5.0
Body = Callable[[], Awaitable[None]]
Block = TypeVar("Block")


class Operator(Protocol):
    """Whoever plugs, covers and carries."""

    async def ask(self, request: str, order: str) -> None:
        """Have something done; returns when it has been. ``order`` says it in words of ``hal.fake.faults.control``."""
        ...

    def tell(self, request: str, order: str) -> None:
        """The same, blocking."""
        ...


@dataclass(frozen=True)
class FakeOperator:
    """Does it to the fake."""

    control: Control

    async def ask(self, request: str, order: str) -> None:
        """At once."""
        self.tell(request, order)

    def tell(self, request: str, order: str) -> None:
        """The same."""
        answer = self.control.answer(order)
        assert answer.endswith("ok\n"), f"{request}: {answer}"


@dataclass(frozen=True)
class SocketOperator:
    """A program that takes the same orders on a unix socket: a fake in another process, or a lab's own relays."""

    path: str

    async def ask(self, request: str, order: str) -> None:
        """Returns when it has answered."""
        await asyncio.to_thread(self.tell, request, order)

    def tell(self, request: str, order: str) -> None:
        """The same, blocking."""
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(ANSWER_S)
            link.connect(self.path)
            link.sendall(order.encode() + b"\n")
            answer = b""
            while not answer.endswith(b"ok\n") and b"refused" not in answer:
                part = link.recv(4096)
                assert part, f"{self.path} has hung up"
                answer += part
        assert b"refused" not in answer, f"{request}: {answer.decode()}"


@dataclass(frozen=True)
class Person:
    """Somebody at the terminal, who presses Enter when it is done."""

    async def ask(self, request: str, order: str) -> None:
        """Prompt, and wait for Enter as long as it takes; the devices go on meanwhile."""
        await asyncio.to_thread(self.tell, request, order)

    def tell(self, request: str, order: str) -> None:
        """The same, blocking; keys pressed before the question are no answer. Raises `OSError` if nobody is left."""
        with Path("/dev/tty").open("r+b", buffering=0) as terminal:
            termios.tcflush(terminal, termios.TCIFLUSH)
            terminal.write(f"\n>>> {request}, then press Enter: ".encode())
            if not terminal.readline():
                raise OSError(errno.EIO, f"{request}: nobody answers at the terminal")


def operator_for(text: str) -> Operator | None:
    """By the option's text; None: there is nobody."""
    if text == "terminal":
        try:
            Path("/dev/tty").open("r+b", buffering=0).close()
        except OSError as error:
            raise pytest.UsageError(
                f"--operator terminal: {error.strerror}: nobody can be asked. Run it in a terminal (ssh -t), or "
                "leave it out: what needs an operator is then skipped"
            ) from error
        return Person()
    if text and not Path(text).is_socket():
        raise pytest.UsageError(f"--operator {text}: no socket; say terminal, or the socket of hal.fake --control")
    return SocketOperator(text) if text else None


class Driver(Protocol[Block]):
    """What both drivers have in common."""

    async def run(self, take: Callable[[Block], None]) -> None:
        """Deliver until cancelled."""
        ...


@dataclass
class End(ABC, Generic[Block]):
    """A device. While a body runs, everything in it may be used."""

    name: str
    operator: Operator | None = None
    clock: Clock = field(default_factory=SystemClock)

    @property
    def real(self) -> bool:
        """Whether it is a device of this computer, or one on the network."""
        return self.name != FAKE

    def play(self, body: Body) -> None:
        """Run a body to its end."""
        if self.real:
            asyncio.run(_await(body))
        else:
            run_virtual(self._on_fake(body), start=1000.0)

    async def _on_fake(self, body: Body) -> None:
        self.clock = LoopClock(asyncio.get_running_loop())
        schedule = FaultSchedule(self.plug())
        self.operator = FakeOperator(Control(schedule))
        try:
            await body()
        finally:
            schedule.close()
            self.unplug()

    @abstractmethod
    def plug(self) -> dict[str, Target]:
        """Put a fake where the driver opens its device; what faults can be ordered of, by name."""

    def unplug(self) -> None:
        """Take the fake away."""

    async def follow(self, driver: Driver[Block], seconds: float, none: Callable[[], str]) -> list[Block]:
        """What comes in so many seconds, from the first on, which has to come within 15 s."""
        got: list[Block] = []
        running = asyncio.create_task(driver.run(got.append))
        try:
            await self.until(lambda: bool(got), 15.0, none)
            await asyncio.sleep(seconds)
        finally:
            await ended(running)
        return got

    async def until(self, so: Callable[[], bool], seconds: float, else_: Callable[[], str]) -> float:
        """Wait until something is so; the seconds it took. Fails with the text after ``seconds``."""
        begun = self.clock.now()
        while not so():
            assert self.clock.now() - begun < seconds, f"not within {seconds:g} s: {else_()}"
            await asyncio.sleep(0.005)
        return self.clock.now() - begun


def place_of(name: str) -> LidarPlace:
    """Where the lidar is that ``--lidar`` names, and its rate where one is written behind it, as for the daemon.

    Raises:
        pytest.UsageError: that is no rate.
    """
    try:
        return parse_lidar(name)
    except ValueError as error:
        raise pytest.UsageError(f"--lidar {name}: {error}; without one it is found") from error


@dataclass
class LidarEnd(End[RawScan]):
    """A lidar; ``fake`` is None on a real device."""

    opener: PortOpener = open_port
    fake: FakeHokuyo | None = None

    def __post_init__(self) -> None:
        self.place = place_of(self.name if self.real else LINE)

    @property
    def device(self) -> str:
        """What a driver opens."""
        return self.place.device

    async def identify(self) -> Finding:
        """Who it is, asked as `lumiloop probe` asks."""
        return await identify_at(self.opener, self.device, self.place.baud)

    def plug(self) -> dict[str, Target]:
        """One of the UTM kind, in a room."""
        self.fake = FakeHokuyo(UTM_30LX, Room(UTM_30LX, seed=7, lap_s=math.inf), unit=UNIT)
        plugs = FakeOpener(self.clock)
        plugs.plug(LINE, self.fake)
        self.opener = plugs
        return {"lidar": self.fake}

    def unplug(self) -> None:
        """Take the fake away."""
        if self.fake is not None:
            self.fake.close()

    async def measure(self, seconds: float, driver: HokuyoDriver | None = None) -> list[RawScan]:
        """Scans of so many seconds, from the first on that comes within 15 s."""
        asked = driver or self.driver()
        return await self.follow(asked, seconds, lambda: f"no scan has come: {asked.status.error}")

    def driver(self) -> HokuyoDriver:
        """A driver of our own on it."""
        place = self.place
        return HokuyoDriver(place.device, clock=self.clock, opener=self.opener, serial=place.serial, baud=place.baud)


def where_on_a_bus(name: str) -> tuple[str, int, str]:
    """Bus, address and kind of chip that ``--adc`` names.

    Raises:
        pytest.UsageError: it does not.
    """
    bus, at, rest = (f"{BUS}@0x4d" if name == FAKE else name).rpartition("@")
    address, _, chip = rest.partition(",")
    try:
        number = int(address, 0) if at and bus else None
    except ValueError:
        number = None
    if number is None:
        raise pytest.UsageError(f"--adc {name}: expected BUS@ADDRESS[,CHIP], as /dev/i2c-1@0x4d")
    try:
        kind = chip_named(chip or "mcp3221")
    except ValueError as error:
        raise pytest.UsageError(f"--adc {name}: {error}") from error
    if number not in kind.addresses:
        possible = ", ".join(f"{one:#04x}" for one in sorted(kind.addresses))
        raise pytest.UsageError(f"--adc {name}: an {kind.name} answers at one of {possible}")
    return bus, number, kind.name


@dataclass
class AdcEnd(End[RawSamples]):
    """A photodiode's converter; as :class:`LidarEnd`."""

    opener: BusOpener = open_bus
    fake: FakeAdc | None = None

    def __post_init__(self) -> None:
        self.bus, self.address, self.chip = where_on_a_bus(self.name)

    def plug(self) -> dict[str, Target]:
        """One under ordinary lamps."""
        self.fake = FakeAdc(OrdinaryLamps(seed=7), self.clock, address=self.address, seed=7)
        buses = FakeBuses(self.clock)
        buses.plug(self.bus, self.fake)
        self.opener = buses
        return {"adc": self.fake}

    async def measure(self, seconds: float) -> list[RawSamples]:
        """Blocks of so many seconds, from the first on that comes within 15 s."""
        driver = self.driver()
        return await self.follow(driver, seconds, lambda: f"no samples have come: {driver.status.error}")

    def driver(self) -> PhotodiodeAdc:
        """A driver of our own on it."""
        return PhotodiodeAdc(self.bus, self.address, self.chip, clock=self.clock, opener=self.opener)


async def ended(running: asyncio.Task[None]) -> None:
    """Cancel a driver and see that it ends by that and by nothing else."""
    assert not running.done(), "a driver must never end by itself"
    running.cancel()
    await asyncio.wait([running])
    assert running.cancelled(), "the driver swallowed its cancellation"


def asked(end: LidarEnd | AdcEnd) -> Operator:
    """The operator of an end whose test has said that it needs one."""
    assert end.operator is not None
    return end.operator


async def _await(body: Body) -> None:
    await body()

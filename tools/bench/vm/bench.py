"""What a scenario has at hand: the emulated computer, the world around it, and the daemon as others see it."""

import json
import math
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from tools.bench.support.children import LEASH
from tools.bench.support.other_clock import OtherClock
from tools.bench.vm.booted import Booted
from tools.bench.vm.image import ROOT
from tools.bench.vm.machine import OUTSIDE, Machine, Order, Ports, started
from tools.bench.vm.places import CannotBench
from tools.clients.read_modbus import Reader
from tools.sim.ports import free_port
from tools.sim.robot.truth import Pose, at_time, in_map

UNIT: Final = "lumiloop.service"
CONFIG: Final = "/etc/lumiloop/lumiloop.toml"
SAVE_MAP, DONE, REFUSED = 3, 2, 3
COME_ID: Final = "0f26ad5c5f9d4f6fa1a3c8a7e7c1d9b4"
FIRST_FAULT, FAULTS = 407, 12
"""Registers that name the faults that are present."""
PLACED: Final = ("MAPPING", "TRACKING", "DEGRADED")
KEPT: Final = 30_000
WORLD_S: Final = 240.0
WORLD_ANSWERS_S: Final = 5.0
LOOK_S: Final = 0.2
READS: Final = 4
BUSY: Final = 5.0
"""No bound is stretched beyond so many times its seconds."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A pose datagram: when it came, when its pose was true (both this computer's clock), what it says.

    ``loops``: how many have been closed since the daemon's start; ``missed``: scans, ``overruns``: cycles over their
    budget, as counted. ``fault``: the gravest.
    """

    t_came: float
    t_pose: float
    state: int
    pose: Pose | None
    sigma_m: float
    loops: int = 0
    missed: int = 0
    overruns: int = 0
    fault: int = 0


@dataclass(slots=True)
class Ears:
    """Everything that has come by UDP, collected by a thread of its own."""

    truth: deque[tuple[float, Pose]] = field(default_factory=lambda: deque(maxlen=KEPT))
    poses: deque[Heard] = field(default_factory=lambda: deque(maxlen=KEPT))

    def listen(self, truth: socket.socket, poses: socket.socket, stop: threading.Event) -> None:
        """Until told to stop."""
        clock = OtherClock()
        while not stop.is_set():
            for ready in select.select([truth, poses], [], [], 0.2)[0]:
                data = ready.recv(2048)
                if ready is truth:
                    told = json.loads(data)
                    self.truth.append((told["t_mono"], (told["x"], told["y"], told["yaw"])))
                elif data[:4] == b"LUMI":
                    self.poses.append(heard(data, time.monotonic(), clock))

    def true_pose(self, t: float) -> Pose | None:
        """Where the robot really was at ``t`` (this computer's clock, s): x, y, yaw in the room's frame, m and rad."""
        told = list(self.truth)
        return told[-1][1] if told and t > told[-1][0] else at_time(told, t)


def heard(data: bytes, now: float, clock: OtherClock) -> Heard:
    """A pose datagram's values."""
    (state,) = struct.unpack_from("<H", data, 12)
    age, t_mono = struct.unpack_from("<HQ", data, 22)
    x, y, yaw = struct.unpack_from("<iii", data, 40)
    sigma = max(struct.unpack_from("<HH", data, 76)) / 1e4
    (loops,), (fault,) = struct.unpack_from("<H", data, 108), struct.unpack_from("<H", data, 16)
    counts = (loops, *struct.unpack_from("<II", data, 116), fault)
    pose = None if x == -(2**31) else (x / 1e4, y / 1e4, yaw / 1e6)
    if pose is None:
        return Heard(now, now, state, None, sigma, *counts)
    return Heard(now, clock.here(t_mono / 1e6, t_mono / 1e6 + age / 1e4, now), state, pose, sigma, *counts)


class Bench:
    """The whole of it. Made by :func:`bench`."""

    slower = 1.0
    """So many times as long as is reckoned with its emulated processor takes for a fixed piece of work."""

    def __init__(self, machine: Machine, world: subprocess.Popen[str], folder: Path, there: dict[str, Any]) -> None:
        self.machine, self.world, self.folder, self.there = machine, world, folder, there
        self.booted_s = 0.0
        self.ears = Ears()
        self.start: Pose | None = None
        self.memory: dict[str, Any] = {}
        self.life = (0, 0)

    def orders(self, text: str) -> str:
        """An order to the world's devices (`python -m hal.fake`'s control socket): ``order silence for=2``.

        Raises:
            Order: it is refused, or the world hangs up or says nothing.
        """
        try:
            with socket.socket(socket.AF_UNIX) as link:
                link.settimeout(WORLD_ANSWERS_S)
                link.connect(str(self.folder / "control"))
                link.sendall(text.encode() + b"\n")
                answer = self._answered(link)
        except OSError as error:
            raise Order(f"{text}: the simulated world does not take it: {error}") from error
        if b"refused" in answer:
            raise Order(f"{text}: {answer.decode()}")
        return answer.decode()

    def _answered(self, link: socket.socket) -> bytes:
        """The world's answer to an order, to its end; raises `OSError` where there is none."""
        answer, end = b"", time.monotonic() + WORLD_ANSWERS_S
        while not answer.endswith(b"ok\n") and b"refused" not in answer:
            self.machine.check()
            if time.monotonic() > end:
                raise TimeoutError(f"no answer within {WORLD_ANSWERS_S:g} s")
            if select.select([link], [], [], LOOK_S)[0]:
                piece = link.recv(4096)
                if not piece:
                    raise ConnectionError("it has hung up")
                answer += piece
        return answer

    def drive(self) -> None:
        """The robot sets off."""
        self.world.send_signal(signal.SIGUSR1)

    def read(self, tcp: bool = False, tries: int = READS) -> dict[str, Any]:
        """The daemon's block over Modbus; empty where nobody answers, asked so many times."""
        for _ in range(tries):
            with suppress(OSError, ValueError):
                reader = Reader("127.0.0.1", self.machine.ports.modbus, tcp)
                try:
                    return dict(reader.read())
                finally:
                    reader.close()
        return {}

    def ask(self, request: bytes) -> bytes:
        """Any Modbus request over UDP (function and data), and its answer."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(2.0)
            link.connect(("127.0.0.1", self.machine.ports.modbus))
            for left in reversed(range(READS)):  # a datagram may be lost; repeated, it does no harm
                link.send(struct.pack(">HHHB", 7, 0, len(request) + 1, 1) + request)
                with suppress(*(() if left == 0 else (TimeoutError,))):
                    return link.recv(512)[7:]
        raise TimeoutError("Modbus does not answer")

    def registers(self, address: int, count: int, function: int = 4) -> bytes:
        """Registers as bytes."""
        answer = self.ask(struct.pack(">BHH", function, address, count))
        if answer[0] != function:
            raise Order(f"Modbus exception {answer[1]} for {count} registers from {address}")
        return answer[2:]

    def command(self, number: int, seconds: float = 20.0) -> int:
        """Give a command; its result (2: done, 3: refused)."""
        request = int(time.monotonic() * 10) % 60000 + 1
        self.ask(struct.pack(">BHHBHH", 16, 1000, 2, 4, request, number))
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            acknowledge, result = struct.unpack_from(">HH", self.registers(1008, 2, 3))
            if acknowledge == request:
                return int(result)
            self.wait(0.1)
        raise Order(f"command {number} was not acknowledged within {seconds:.0f} s")

    def until(self, what: str, seconds: float, happens: Callable[[], object], every: float = 0.1) -> float:
        """Wait until it happens; returns how long it took. Raises `Order` with the daemon's log.

        While the emulated processor waits for one of this computer's, its time does not run: ``seconds`` are those in
        which it could have done something, more of them where it is slower than usual. ``every``: between two looks,
        which cost it something where it is asked.
        """
        seconds *= max(1.0, self.slower)
        begun, waited = time.monotonic(), self.machine.waited_s()
        while not happens():
            took = time.monotonic() - begun
            if took - (self.machine.waited_s() - waited) > seconds or took > BUSY * seconds:
                told = f"not within {seconds:.0f} s of its own, {took:.0f} s in all: {what}"
                raise Order(f"{told}; Modbus says {self.read()}\n{self.log(12)}")
            self.wait(every)
        return time.monotonic() - begun

    def wait(self, seconds: float) -> None:
        """Let time pass, while the machine runs."""
        self.machine.broken_off.wait(seconds)
        self.machine.check()

    def placed(self, seconds: float, states: tuple[str, ...] = ("TRACKING",)) -> float:
        """Wait until the pose may be used."""
        return self.until(f"state {' or '.join(states)}", seconds, lambda: self.read().get("state") in states)

    def present(self, *codes: int) -> list[int]:
        """Which of these faults the daemon names, over Modbus."""
        named = struct.unpack(f">{FAULTS}H", self.registers(FIRST_FAULT, FAULTS))
        return [code for code in codes if code in named]

    def journaled(self, code: int) -> bool:
        """Whether this boot's journal has that fault coming, found by its fields."""
        words = ["journalctl", "-q", "-b", "--no-pager", "-o", "cat", "-u", UNIT, f"MESSAGE_ID={COME_ID}"]
        return bool(self.machine.run(*words, f"LUMILOOP_FAULT={code}", check=False).strip())

    def fault(self, *codes: int) -> None:
        """Wait until Modbus shows one of these faults as the gravest."""
        self.until(f"fault {codes}", 30.0, lambda: self.read().get("fault") in codes)

    def main_pid(self) -> int:
        """The daemon's process inside."""
        return self.lives()[0]

    def lives(self) -> tuple[int, int]:
        """The daemon's process inside, 0: there is none; how often it was started anew without a person."""
        seen = self.machine.show(UNIT, "MainPID", "NRestarts")
        return int(seen["MainPID"]), int(seen["NRestarts"])

    def log(self, lines: int) -> str:
        """The end of the daemon's log."""
        with suppress(Order, OSError):
            return self.machine.run("journalctl", "--no-pager", "-u", UNIT, "-n", str(lines), check=False)
        return ""

    def configure(self, *more: str) -> None:
        """Write the configuration, with where the datagrams go and ``more`` tables."""
        text = (ROOT / "tools/bench/vm/guest/lumiloop.toml").read_text()
        port = self.there["poses"]
        self.machine.write(CONFIG, "\n".join([text, "[pose]", f'receivers = ["{OUTSIDE}:{port}"]', "", *more, ""]))

    def error_m(self, one: Heard) -> float | None:
        """How far a pose is from the truth, in the map's frame, which begins where the robot stood first."""
        true = self.ears.true_pose(one.t_pose)
        if one.pose is None or true is None or self.start is None:
            return None
        x, y, _ = in_map(true, self.start, (0.0, 0.0, 0.0))
        return math.hypot(one.pose[0] - x, one.pose[1] - y)

    def collect(self, seconds: float) -> list[Heard]:
        """The pose datagrams of the next seconds."""
        begun = time.monotonic()
        self.wait(seconds)
        return [one for one in list(self.ears.poses) if one.t_came >= begun]


def _start_world(folder: Path, odometry: int, truth: int, stack: ExitStack) -> tuple[subprocess.Popen[str], Any]:
    words = [str(odometry), str(truth), str(folder / "control")]
    command = [*LEASH, sys.executable, "-m", "tools.bench.vm.world", *words]
    with (folder / "world").open("w") as said:
        world = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=said, text=True)
    stack.callback(_end, world)
    assert world.stdout is not None
    if not select.select([world.stdout], [], [], WORLD_S)[0] or not (line := world.stdout.readline()):
        raise CannotBench(f"the simulated world does not start:\n{(folder / 'world').read_text()}")
    return world, json.loads(line)


def _end(child: subprocess.Popen[str]) -> None:
    child.send_signal(signal.SIGINT)
    try:
        child.wait(10.0)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    if child.stdout is not None:
        child.stdout.close()


@contextmanager
def bench(booted: Booted, folder: Path, broken_off: threading.Event, nice: int = 0) -> Iterator[Bench]:
    """Everything running, the emulated computer held where its boot has ended; nothing of it is left at the end."""
    with ExitStack() as stack:
        truth, poses = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
        for one in (truth, poses):
            one.bind(("127.0.0.1", 0))
        odometry = free_port()
        world, there = _start_world(folder, odometry, truth.getsockname()[1], stack)
        there["poses"] = poses.getsockname()[1]
        ports = Ports(free_port(), odometry, int(there["lidar"]))
        machine = stack.enter_context(started(booted.start, folder, ports, broken_off, nice))
        made = Bench(machine, world, folder, there)
        made.booted_s = booted.seconds
        stop = threading.Event()
        ears = threading.Thread(target=made.ears.listen, args=(truth, poses, stop))
        ears.start()
        stack.callback(ears.join)
        stack.callback(stop.set)
        yield made

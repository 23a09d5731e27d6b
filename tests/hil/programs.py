"""Programs of their own: the shipped one, and the fakes where they have to be other processes."""

import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest

from tests.hil.ends import Operator, SocketOperator
from tools.bench.support.children import LEASH
from tools.clients.read_modbus import Reader
from tools.sim.ports import free_port

ROOT: Final = Path(__file__).parents[2]
START_S: Final = 60.0
ANSWER_S: Final = 30.0
"""In which a program has to say its version, on a small computer that reads it from its card for the first time."""
INSTALLED: Final = "an installation has /opt/lumiloop/bin/lumiloop"
TOLD_TO_END: Final = ("setpriv", "--pdeathsig", "TERM")
"""Before the words of the program under test: when the suite is killed it ends as it should, the laser off."""


@dataclass(frozen=True)
class Served:
    """A device as another program names it, who plugs it, and a folder for what comes of it."""

    device: str
    operator: Operator | None
    folder: Path


def program(named: str) -> list[str]:
    """The words that start lumiloop: the one that is named, or this tree's."""
    if not named:
        return [sys.executable, "-m", "daemon"]
    found = shutil.which(named)
    if found is None:
        wrong = "it may not be executed" if Path(named).is_file() else "no such program"
        raise pytest.UsageError(f"--program {named}: {wrong}; {INSTALLED}")
    return [str(Path(found).absolute())]  # it is started in another folder


def demand_lumiloop(named: str, patience_s: float = ANSWER_S) -> None:
    """Raise `pytest.UsageError` unless this program says, asked for its version, that it is lumiloop."""
    words = [*program(named), "--version"]
    try:
        done = subprocess.run(words, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, timeout=patience_s)
    except subprocess.TimeoutExpired as error:
        wrong = f"asked for its --version it says nothing within {patience_s:g} s"
        raise pytest.UsageError(f"--program {named}: {wrong}; {INSTALLED}") from error
    except OSError as error:
        raise pytest.UsageError(f"--program {named}: it cannot be started: {error.strerror}; {INSTALLED}") from error
    said = done.stdout.decode(errors="replace").strip()
    if done.returncode or not re.fullmatch(r"lumiloop \S+", said):
        complained = done.stderr.decode(errors="replace").strip()
        line = said.splitlines()[0] if said else complained.splitlines()[-1] if complained else "nothing"
        wrong = f"no lumiloop: asked for its --version it ends with {done.returncode} and says {line[:60]!r}"
        raise pytest.UsageError(f"--program {named}: {wrong}; {INSTALLED}")


@contextmanager
def process(command: list[str], ready: Callable[[str], bool]) -> Generator[subprocess.Popen[bytes]]:
    """A program of ours that says on stdout when it is ready; ended with the block."""
    words = [*LEASH, *command]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as child:
        try:
            assert child.stdout is not None
            said, end = "", time.monotonic() + START_S
            while not ready(said):
                assert select.select([child.stdout], [], [], max(end - time.monotonic(), 0.0))[0], f"silent: {said}"
                part = os.read(child.stdout.fileno(), 4096)
                assert part, f"{' '.join(command)} has ended:\n{said}"
                said += part.decode()
            yield child
        finally:
            child.send_signal(signal.SIGINT)
            try:
                child.communicate(timeout=10.0)
            except subprocess.TimeoutExpired:
                child.kill()


@contextmanager
def served_lidar(folder: Path, *where: str) -> Generator[Served]:
    """A UHG-08LX (15 Hz) that stands still, on a pty or as ``where`` says, which takes orders."""
    control = folder / "lidar.control"
    place = where or ("--pty", str(folder / "lidar"))
    command = [sys.executable, "-m", "hal.fake", "--model", "UHG-08LX", "--world", "still", *place]
    with process([*command, "--control", str(control)], lambda said: "fault commands on" in said):
        yield Served(str(folder / "lidar"), SocketOperator(str(control)), folder)


@contextmanager
def served_receiver(folder: Path) -> Generator[str]:
    """A converter on a bus of its own; what ``--adc`` has to be."""
    bus = f"unix:{folder / 'bus'}"
    command = [sys.executable, "-m", "hal.fake.adc.receiver", bus, "--control", str(folder / "adc.control")]
    with process(command, lambda said: "fault commands on" in said):
        yield f"{bus}@0x4d"


@dataclass
class Daemon:
    """The program under test while it runs, as others see it."""

    child: subprocess.Popen[bytes]
    port: int
    log: Path

    def read(self) -> dict[str, Any]:
        """The block over Modbus UDP; empty where nobody answers yet."""
        reader = Reader("127.0.0.1", self.port)
        try:
            return dict(reader.read())
        except (OSError, ValueError):
            return {}
        finally:
            reader.close()

    def until(self, seconds: float, *states: str) -> float:
        """Wait for one of the states; the seconds it took. Fails with the end of the log."""
        begun = time.monotonic()
        while (now := self.read()).get("state") not in states:
            assert self.child.poll() is None, f"it has ended\n{self.tail()}"
            late = time.monotonic() - begun > seconds
            assert not late, f"no {states} within {seconds} s: {now}\n{self.tail()}"
            time.sleep(0.05)
        return time.monotonic() - begun

    def tail(self) -> str:
        """The end of its log."""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-20:])

    def stop(self) -> tuple[int, float]:
        """End it as a service manager does: exit code, seconds it took."""
        begun = time.monotonic()
        self.child.send_signal(signal.SIGTERM)
        return self.child.wait(timeout=20.0), time.monotonic() - begun


@contextmanager
def daemon(words: list[str], served: Served, *more: str) -> Generator[Daemon]:
    """`lumiloop run` on a lidar, with its Modbus port on loopback; ended with the block."""
    port = free_port()
    log = served.folder / "daemon.log"
    command = [*TOLD_TO_END, *words, "run", "--lidar", served.device, "--set", f"modbus.port={port}", *more]
    with log.open("wb") as said, subprocess.Popen(command, cwd=ROOT, stderr=said) as child:
        try:
            yield Daemon(child, port, log)
        finally:
            if child.poll() is None:
                child.kill()


def probed(words: list[str], *devices: str) -> list[dict[str, Any]]:
    """What `lumiloop probe` finds."""
    done = subprocess.run([*words, "probe", "--json", *devices], cwd=ROOT, capture_output=True, text=True, timeout=60)
    found: list[dict[str, Any]] = json.loads(done.stdout)
    assert (done.returncode == 0) == all("problem" not in one for one in found), done.stderr
    return found

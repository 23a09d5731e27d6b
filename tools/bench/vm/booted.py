"""The emulated computer as it is once it is up, kept beside its image: a run goes on from there instead of booting.

It is booted once for each image, as a person would switch it on, and must come up without a failed unit. Then it is
held, and its memory and what it has written to its disk are kept (QEMU's migration to a file). A real boot remains in
each run: the reboot and the power cut. What is kept fits one QEMU and one command line only, which its name tells.
"""

import hashlib
import json
import os
import shutil
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tools.bench.vm.image import Image, Say
from tools.bench.vm.machine import Order, Ports, Start, all_well, command_line, started
from tools.bench.vm.places import CannotBench, clear, missing_of, remedy, workspace
from tools.sim.ports import free_port

ROOM: Final = 2_000_000_000
QEMU: Final = "qemu-system-x86_64"
READ: Final = ("/opt/lumiloop/bin/python", "-c", "import numba")
"""What each run would read from its disk first, in each of its computers, is in memory already."""


@dataclass(frozen=True, slots=True)
class Booted:
    """What a run goes on from: changes of the image's disk, memory, and how the boot went."""

    image: Image
    folder: Path

    @property
    def disk(self) -> Path:
        """The changes of the disk against the image's; never written to."""
        return self.folder / "disk"

    @property
    def memory(self) -> Path:
        """The state of the computer (QEMU's migration stream)."""
        return self.folder / "memory"

    @property
    def start(self) -> Start:
        """What a run begins with."""
        return Start(self.image, self.disk, self.memory)

    @property
    def seconds(self) -> float:
        """How long it took from being switched on until it was up."""
        return float(json.loads((self.folder / "told.json").read_text())["seconds"])

    def lacks(self) -> str:
        """What is missing or empty; empty text: it is whole."""
        return missing_of(self.parts)

    @property
    def parts(self) -> tuple[Path, ...]:
        """All that is kept."""
        return self.disk, self.memory, self.folder / "told.json"


def booted(image: Image, say: Say) -> Booted:
    """The computer of this image, up; booted now where that has not been done yet.

    Raises:
        CannotBench: it does not come up, or a unit has failed; says which.
    """
    made = Booted(image, image.folder / f"booted-{_key(image)}")
    lacks = made.lacks()
    if not lacks:
        return made
    if made.folder.exists():
        clear(made.folder, lacks)
        say(f"{made.folder} was not whole ({lacks}); it is booted anew")
    for old in image.folder.glob("booted-*"):  # of another QEMU, or not whole
        shutil.rmtree(old, ignore_errors=True)
    say("booting the emulated computer for the first time")
    part = image.folder / f"part-{os.getpid()}"
    try:
        with workspace("lumiloop-vm-boot", ROOM) as folder:
            shutil.rmtree(part, ignore_errors=True)  # of a process that was killed and had our number
            part.mkdir()
            seconds = _boot(folder, Booted(image, part))
        (part / "told.json").write_text(json.dumps({"seconds": seconds}))
        part.replace(made.folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    say(f"up after {seconds:.0f} s")
    return made


def _boot(folder: Path, made: Booted) -> float:
    disk = ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", str(made.image.disk), str(made.disk)]
    done = subprocess.run(disk, capture_output=True, text=True)
    if done.returncode:
        raise CannotBench(f"making room for what the first boot writes failed: {done.stderr}")
    ports = Ports(free_port(), free_port(), free_port())
    with started(Start(made.image, made.disk, keep=True), folder, ports, threading.Event()) as machine:
        begun = time.monotonic()
        try:
            machine.wait_until_up()
            all_well(machine)
            seconds = time.monotonic() - begun
            machine.run(*READ, seconds=60.0)
            machine.run("sync")
        except (Order, CannotBench) as error:
            wrong = f"the emulated computer has not come up well: {error}"
            raise CannotBench(f"{wrong}\nif it never does: {remedy(made.image.folder)}") from error
        machine.keep(made.memory)
    return seconds


def _key(image: Image) -> str:
    """Of the program and of all words of its command line but the places of files and sockets."""
    version = subprocess.run([QEMU, "--version"], capture_output=True, text=True).stdout
    words = (*command_line(Start(image, image.disk), Path("/"), Ports(0, 0, 0)), *READ)
    return hashlib.sha256(json.dumps([version, *words]).encode()).hexdigest()[:16]

"""The emulated computer: QEMU with the image's kernel and disk, its network, its two wires, and its reset button."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from tools.bench.vm.image import Image
from tools.bench.vm.places import LEASH, CannotBench

BOOT_S, QUIT_S = 400.0, 10.0
MODBUS, ODOMETRY = 1502, 5601
UNUSED = ("serial-getty@ttyS0", "getty@tty1", "systemd-logind", "systemd-update-utmp", "systemd-update-utmp-runlevel")
COMMAND_LINE = " ".join([
    "root=/dev/vda rw console=ttyS0 net.ifnames=0 panic=5 mitigations=off systemd.show_status=false",
    *(f"systemd.mask={unit}.service" for unit in UNUSED),
])  # fmt: skip
OUTSIDE = "10.0.2.2"
"""This computer, as the emulated one sees it."""


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """A port of the loopback address that nobody has taken."""
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def free_for_both() -> int:
    """A port that is free for TCP and UDP."""
    for _ in range(20):
        port = free_port()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            try:
                one.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise CannotBench("no port of the loopback address is free for TCP and UDP")


@dataclass(slots=True)
class Ports:
    """Ports of this computer: the daemon's Modbus and odometry inside, and the simulated lidar's out here."""

    modbus: int
    odometry: int
    lidar: int


class Order(Exception):
    """A command inside ended with an error; the text says which and what it said."""


class Machine:
    """A running one. Made by :func:`started`."""

    def __init__(self, process: subprocess.Popen[bytes], folder: Path, ports: Ports) -> None:
        self.process, self.folder, self.ports = process, folder, ports
        self._agent: socket.socket | None = None
        self._lines: IO[bytes] | None = None
        self._qmp: tuple[socket.socket, IO[bytes]] | None = None

    def wait_until_up(self) -> float:
        """Wait for the agent inside; returns seconds since this was called."""
        begun = time.monotonic()
        while time.monotonic() - begun < BOOT_S:
            self.check()
            if self._greeted():
                return time.monotonic() - begun
        raise CannotBench(f"the emulated computer does not boot:\n{self.console()[-3000:]}")

    def _greeted(self) -> bool:
        """Whether the agent has said that it is up, within a second."""
        if self._agent is None:
            self._agent = _connected(self.folder / "agent")
            self._lines = self._agent.makefile("rb")
        self._agent.settimeout(1.0)
        try:
            assert self._lines is not None
            return b'"up"' in self._lines.readline()
        except TimeoutError:
            self._drop()
            return False

    def _drop(self) -> None:
        if self._agent is not None and self._lines is not None:
            self._lines.close()
            self._agent.close()
        self._agent = self._lines = None

    def order(self, patience: float, **order: Any) -> dict[str, Any]:
        """Have the agent do something; its answer."""
        assert self._agent is not None
        assert self._lines is not None
        self._agent.settimeout(patience)
        self._agent.sendall(json.dumps(order).encode() + b"\n")
        try:
            answer: dict[str, Any] = json.loads(self._lines.readline())
        except (TimeoutError, ValueError) as error:
            raise Order(f"no answer to {order} within {patience:.0f} s") from error
        if "code" not in answer:
            raise Order(f"the agent inside was started anew while it was to do {order}")
        return answer

    def run(self, *words: str, check: bool = True, seconds: float = 60.0) -> str:
        """Run a command inside, as root; what it wrote, both streams.

        Raises:
            Order: it failed, and ``check``.
        """
        answer = self.order(seconds + 30.0, run=words, seconds=seconds)
        if check and answer["code"]:
            raise Order(f"{' '.join(words)} ended with {answer['code']}:\n{answer['out']}")
        return str(answer["out"])

    def write(self, path: str, text: str) -> None:
        """Write a file inside."""
        self.order(30.0, write=path, text=text)

    def show(self, unit: str, *names: str) -> dict[str, str]:
        """Properties of a unit (systemctl show)."""
        lines = self.run("systemctl", "show", unit, *(f"--property={name}" for name in names)).splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def power_cut(self) -> None:
        """Off and on again, without a word to the system inside; its disk keeps what had been written."""
        self._monitor("system_reset")
        self._drop()

    def reboot(self) -> None:
        """As a person would ask for it; what is asked is answered first, for the agent is among what is ended."""
        self.run("sh", "-c", "(sleep 0.5; systemctl reboot) > /dev/null 2>&1 &")
        self._drop()

    def check(self) -> None:
        """Raise `CannotBench` if it has ended."""
        if self.process.poll() is not None:
            said = (self.folder / "qemu").read_text(errors="replace")
            raise CannotBench(f"QEMU has ended with {self.process.returncode}:\n{said}{self.console()[-2000:]}")

    def console(self) -> str:
        """What the kernel has written."""
        path = self.folder / "console"
        return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", path.read_text(errors="replace")) if path.exists() else ""

    def _monitor(self, command: str) -> None:
        if self._qmp is None:
            link = _connected(self.folder / "qmp")
            self._qmp = (link, link.makefile("rb"))
            self._qmp[1].readline()
            self._tell("qmp_capabilities")
        self._tell(command)

    def _tell(self, command: str) -> None:
        assert self._qmp is not None
        self._qmp[0].sendall(json.dumps({"execute": command}).encode() + b"\n")
        while b'"return"' not in (line := self._qmp[1].readline()):
            if not line or b'"error"' in line:
                raise CannotBench(f"QEMU does not take {command}: {line.decode()}")

    def stop(self) -> None:
        """Off."""
        self._drop()
        self.process.terminate()
        try:
            self.process.wait(QUIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self._qmp is not None:
            self._qmp[1].close()
            self._qmp[0].close()


def _connected(path: Path) -> socket.socket:
    link = socket.socket(socket.AF_UNIX)
    end = time.monotonic() + QUIT_S
    while True:
        try:
            link.connect(str(path))
            return link
        except OSError as error:
            if time.monotonic() > end:
                raise CannotBench(f"QEMU does not offer {path.name}: {error}") from error
            time.sleep(0.1)


def _words(image: Image, folder: Path, ports: Ports) -> list[str]:
    """QEMU's command line. ``snapshot=on``: what is written stays until it ends, and never reaches the image.

    Everything is emulated, on a computer with KVM too: where virtual machines are nested, /dev/kvm may open and then
    run nothing.
    """
    forwards = f"hostfwd=tcp:127.0.0.1:{ports.modbus}-:{MODBUS},hostfwd=udp:127.0.0.1:{ports.modbus}-:{MODBUS}"
    return [
        "qemu-system-x86_64", "-nodefaults", "-no-user-config", "-display", "none", "-machine", "q35",
        "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", "1536",
        "-kernel", str(image.kernel), "-initrd", str(image.initrd), "-append", COMMAND_LINE,
        "-drive", f"file={image.disk},if=none,id=disk,format=raw,snapshot=on,cache=unsafe",
        "-device", "virtio-blk-pci,drive=disk", "-device", "virtio-rng-pci",
        "-netdev", f"user,id=net,{forwards},hostfwd=udp:127.0.0.1:{ports.odometry}-:{ODOMETRY}",
        "-device", "virtio-net-pci,netdev=net,romfile=",
        "-device", "virtio-serial-pci",
        "-chardev", f"socket,id=agent,path={folder / 'agent'},server=on,wait=off",
        "-device", "virtserialport,chardev=agent,name=bench.agent",
        "-chardev", f"socket,id=lidar,host=127.0.0.1,port={ports.lidar},reconnect=1",
        "-device", "virtserialport,chardev=lidar,name=bench.lidar",
        "-chardev", f"file,id=console,path={folder / 'console'}", "-serial", "chardev:console",
        "-qmp", f"unix:{folder / 'qmp'},server=on,wait=off",
    ]  # fmt: skip


@contextmanager
def started(image: Image, folder: Path, ports: Ports) -> Iterator[Machine]:
    """Switch it on; it is off at the end, whatever happens.

    Args:
        image: what it starts from.
        ports: where it can be reached, and where its lidar is.
        folder: for sockets and console; its disk's changes go there too, and are gone at the end.
    """
    with ExitStack() as stack:
        said = stack.enter_context((folder / "qemu").open("wb"))
        environment = {**os.environ, "TMPDIR": str(folder)}
        process = subprocess.Popen(
            [*LEASH, *_words(image, folder, ports)], stdin=subprocess.DEVNULL, stdout=said, stderr=said, env=environment
        )
        machine = Machine(process, folder, ports)
        stack.callback(machine.stop)
        yield machine

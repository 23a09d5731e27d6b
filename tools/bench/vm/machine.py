"""The emulated computer: QEMU with the image's kernel and disk, its network, its two wires, and its reset button."""

import json
import os
import re
import select
import shlex
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from tools.bench.support.children import LEASH
from tools.bench.vm.image import Image
from tools.bench.vm.places import BrokenOff, CannotBench, remedy

BOOT_S, QUIT_S, LOOK_S, KEEP_S = 400.0, 10.0, 0.5, 120.0
DEAF_S = 60.0
"""What QEMU itself may take to hear a word or to answer one, on a busy computer too."""
MODBUS, ODOMETRY = 1502, 5601
UNUSED = (
    *(f"{unit}.service" for unit in ("serial-getty@ttyS0", "getty@tty1", "systemd-logind", "systemd-binfmt")),
    *(f"{unit}.service" for unit in ("systemd-update-utmp", "systemd-update-utmp-runlevel")),
    *(f"modprobe@{module}.service" for module in ("dm_mod", "efi_pstore", "fuse", "loop")),
    "systemd-network-generator.service",
    "dev-hugepages.mount",
    "proc-sys-fs-binfmt_misc.automount",
)
"""Of what a small Debian does at every boot."""
NOBODYS = "ahci,libahci,libata,cfg80211,kvm,kvm_amd,iTCO_wdt,aesni_intel,ghash_clmulni_intel,powernow_k8,psmouse,pcspkr"
"""Modules of devices that nothing here needs."""
COMMAND_LINE = " ".join([
    "rdinit=/bench-init console=ttyS0 net.ifnames=0 panic=5 mitigations=off highres=off norandmaps",
    "systemd.show_status=false",
    f"modprobe.blacklist={NOBODYS}",
    *(f"systemd.mask={unit}" for unit in UNUSED),
])  # fmt: skip
"""``highres=off``: dummy_hcd looks after its bus at every tick of 4 ms, not 8000 times a second. ``norandmaps``: QEMU
keeps what it has translated by virtual address, and a program lies where it lay when it was last started."""
PROCESSOR = "Nehalem"
"""The oldest that everything inside runs on (numpy wants x86-64-v2): wide vectors are the dearest to emulate."""
OUTSIDE = "10.0.2.2"
"""This computer, as the emulated one sees it."""


@dataclass(frozen=True, slots=True)
class Start:
    """What it starts from: the image; changes of its disk (qcow2); memory, where it goes on from a state that was kept.

    ``keep``: what it writes to its disk stays in the file of changes; otherwise it is gone when it ends.
    """

    image: Image
    disk: Path
    memory: Path | None = None
    keep: bool = False


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

    kept: Path | None = None
    """The folder of what it goes on from."""

    def __init__(
        self, process: subprocess.Popen[bytes], folder: Path, ports: Ports, broken_off: threading.Event
    ) -> None:
        self.process, self.folder, self.ports, self.broken_off = process, folder, ports, broken_off
        self._agent: socket.socket | None = None
        self._heard = b""
        self._orders = 0
        self._qmp: tuple[socket.socket, IO[bytes]] | None = None

    def wait_until_up(self) -> float:
        """Wait for the agent inside; returns seconds since this was called."""
        begun = time.monotonic()
        while time.monotonic() - begun < BOOT_S:
            self.check()
            if self._greeted():
                return time.monotonic() - begun
        raise CannotBench(f"the emulated computer does not boot:\n{self.console()[-3000:]}")

    def go_on(self) -> float:
        """Let a computer whose state was kept go on, and tell it what time it is; how many seconds that took.

        Raises:
            CannotBench: QEMU does not take the state, or nobody answers inside.
        """
        begun = time.monotonic()
        try:
            self._until_status("paused", "taking the state that was kept")
            self._agent, self._heard = self._connected("agent"), b""
            self._monitor("cont")
            self.run("date", "-s", f"@{time.time():.3f}")
        except (Order, CannotBench) as error:
            wrong = f"the emulated computer does not go on: {error}"
            raise CannotBench(f"{wrong}\nif it never does: {remedy(self.kept)}" if self.kept else wrong) from error
        return time.monotonic() - begun

    def keep(self, path: Path) -> None:
        """Stop it for good, and write its memory to a file, for :meth:`go_on` of another one with the same disk."""
        self._monitor("stop")
        self._monitor("migrate", uri=f"exec:cat > {shlex.quote(str(path))}")
        self._until_status("postmigrate", "keeping its memory")

    def _until_status(self, status: str, what: str) -> None:
        until = time.monotonic() + KEEP_S
        while self._monitor("query-status")["status"] != status:
            self.check()
            if time.monotonic() > until:
                raise CannotBench(f"{what} has not come to its end within {KEEP_S:.0f} s")
            time.sleep(0.1)

    def _greeted(self) -> bool:
        """Whether the agent has said that it is up, within a second."""
        if self._agent is None:
            self._agent, self._heard = self._connected("agent"), b""
        said = self._line(time.monotonic() + 1.0)
        if said is None:
            self._drop()
        return b'"up"' in (said or b"")

    def _drop(self) -> None:
        if self._agent is not None:
            self._agent.close()
        self._agent = None

    def _line(self, until: float) -> bytes | None:
        """The agent's next line; None: there is none by then. What has come of one that is not whole is kept."""
        assert self._agent is not None
        while b"\n" not in self._heard:
            self.check()
            left = until - time.monotonic()
            if left <= 0.0:
                return None
            if select.select([self._agent], [], [], min(left, LOOK_S))[0]:
                piece = b""
                with suppress(OSError):  # it may end at any word
                    piece = self._agent.recv(65536)
                if not piece:
                    raise self._cut()
                self._heard += piece
        line, _, self._heard = self._heard.partition(b"\n")
        return line

    def _cut(self) -> Order:
        """What is wrong when the line to the agent has been cut; `CannotBench` instead if QEMU ends, as it will."""
        self._see_it_end()
        return Order("the line to the agent inside has been cut")

    def _see_it_end(self) -> None:
        """A line of it has been cut: raise `CannotBench` if that is because it ends, which takes it a moment."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(QUIT_S)
        self.check()

    def order(self, patience: float, **order: Any) -> dict[str, Any]:
        """Have the agent do something; its answer.

        Orders are numbered: the answer to one that was waited for in vain may still come, before that to the next.

        Raises:
            Order: there was none in time, or the agent began anew.
        """
        assert self._agent is not None
        self._orders += 1
        try:
            self._agent.sendall(json.dumps({"id": self._orders, **order}).encode() + b"\n")
        except OSError as error:
            raise self._cut() from error
        until = time.monotonic() + patience
        while (line := self._line(until)) is not None:
            try:
                answer: dict[str, Any] = json.loads(line)
            except ValueError:  # the rest of what an agent said that was ended in the middle of it
                continue
            if "up" in answer:
                raise Order(f"the agent inside was started anew while it was to do {order}")
            if answer["id"] == self._orders:
                return answer
        raise Order(f"no answer to {order} within {patience:.0f} s")

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

    def worked_s(self) -> float | None:
        """Seconds of processor time that it has taken of this computer; None: it has ended."""
        with suppress(OSError):
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return None

    def waited_s(self) -> float:
        """Seconds that its processor would have run and had to wait for one of this computer's."""
        return _waited_s(Path(f"/proc/{self.process.pid}/task"))

    def power_cut(self) -> None:
        """Off and on again, without a word to the system inside; its disk keeps what had been written."""
        self._monitor("system_reset")
        self._drop()

    def reboot(self) -> None:
        """As a person would ask for it; what is asked is answered first, for the agent is among what is ended."""
        self.run("sh", "-c", "(sleep 0.5; systemctl reboot) > /dev/null 2>&1 &")
        self._drop()

    def check(self) -> None:
        """Raise `CannotBench` if it has ended, `BrokenOff` if it is to."""
        if self.broken_off.is_set():
            raise BrokenOff
        if self.process.poll() is not None:
            said = (self.folder / "qemu").read_text(errors="replace")
            raise CannotBench(f"QEMU has ended with {self.process.returncode}:\n{said}{self.console()[-2000:]}")

    def console(self) -> str:
        """What the kernel has written."""
        path = self.folder / "console"
        return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", path.read_text(errors="replace")) if path.exists() else ""

    def _monitor(self, command: str, **arguments: str) -> dict[str, Any]:
        try:
            if self._qmp is None:
                link = self._connected("qmp")
                self._qmp = (link, link.makefile("rb"))
                self._qmp[1].readline()
                self._tell("qmp_capabilities", {})
            return self._tell(command, arguments)
        except OSError as error:  # it may end at any word of this
            self._see_it_end()
            raise CannotBench(f"QEMU does not take {command}: {error}") from error

    def _connected(self, name: str) -> socket.socket:
        """To one of its sockets; raises `CannotBench` where it has ended, or does not offer it."""
        link, end = socket.socket(socket.AF_UNIX), time.monotonic() + QUIT_S
        link.settimeout(DEAF_S)
        while True:
            try:
                link.connect(str(self.folder / name))
                return link
            except OSError as error:
                if self.process.poll() is not None or time.monotonic() > end:
                    link.close()
                    self.check()
                    raise CannotBench(f"QEMU does not offer {name}: {error}") from error
                time.sleep(0.1)

    def _tell(self, command: str, arguments: dict[str, str]) -> dict[str, Any]:
        assert self._qmp is not None
        self._qmp[0].sendall(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        while b'"return"' not in (line := self._qmp[1].readline()):
            if not line:
                raise ConnectionError("it has hung up")
            if b'"error"' in line:
                raise CannotBench(f"QEMU does not take {command}: {line.decode()}")
        answer: dict[str, Any] = json.loads(line)["return"]
        return answer

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


def all_well(machine: Machine) -> None:
    """Raise `Order` unless the system inside runs, and no unit has failed."""
    state = machine.run("systemctl", "is-system-running", "--wait", check=False, seconds=120).strip()
    if state != "running":
        failed = machine.run("systemctl", "list-units", "--failed", "--no-legend", "--plain")
        raise Order(f"the system is {state}: {failed}")


def _waited_s(task: Path) -> float:
    """Of the threads in a folder of /proc those that are emulated processors, which QEMU names ``CPU 0/TCG``."""
    waited = 0.0
    for thread in task.glob("*"):
        with suppress(OSError, IndexError, ValueError):  # it has ended; or a kernel that does not tell
            if (thread / "comm").read_text().startswith("CPU "):
                waited += 1e-9 * int((thread / "schedstat").read_text().split()[1])
    return waited


def command_line(start: Start, folder: Path, ports: Ports) -> list[str]:
    """QEMU's. ``snapshot=on``: what is written stays until it ends, and reaches neither the image nor what was kept.

    Everything is emulated, on a computer with KVM too: where virtual machines are nested, /dev/kvm may open and then
    run nothing.
    """
    temporary = "off" if start.keep else "on"
    incoming = ["-incoming", f"exec:cat {shlex.quote(str(start.memory))}"] if start.memory else []
    forwards = f"hostfwd=tcp:127.0.0.1:{ports.modbus}-:{MODBUS},hostfwd=udp:127.0.0.1:{ports.modbus}-:{MODBUS}"
    return [
        "qemu-system-x86_64", "-nodefaults", "-no-user-config", "-name", "debug-threads=on", "-display", "none",
        "-machine", "q35",
        "-accel", "tcg,thread=multi", "-cpu", PROCESSOR, "-smp", "1", "-m", "1536",
        "-kernel", str(start.image.kernel), "-initrd", str(start.image.initrd), "-append", COMMAND_LINE,
        "-drive", f"file={start.disk},if=none,id=disk,format=qcow2,snapshot={temporary},cache=unsafe",
        "-device", "virtio-blk-pci,drive=disk", "-device", "virtio-rng-pci",
        "-netdev", f"user,id=net,ipv6=off,{forwards},hostfwd=udp:127.0.0.1:{ports.odometry}-:{ODOMETRY}",
        "-device", "virtio-net-pci,netdev=net,romfile=",
        "-device", "virtio-serial-pci",
        "-chardev", f"socket,id=agent,path={folder / 'agent'},server=on,wait=off",
        "-device", "virtserialport,chardev=agent,name=bench.agent",
        "-chardev", f"socket,id=lidar,host=127.0.0.1,port={ports.lidar},reconnect=1",
        "-device", "virtserialport,chardev=lidar,name=bench.lidar",
        "-chardev", f"file,id=console,path={folder / 'console'}", "-serial", "chardev:console",
        "-qmp", f"unix:{folder / 'qmp'},server=on,wait=off", *incoming,
    ]  # fmt: skip


@contextmanager
def started(start: Start, folder: Path, ports: Ports, broken_off: threading.Event, nice: int = 0) -> Iterator[Machine]:
    """Switch it on; it is off at the end, whatever happens.

    Args:
        start: what it starts from.
        ports: where it can be reached, and where its lidar is.
        folder: for sockets and console; its disk's changes go there too, and are gone at the end.
        broken_off: once set, whoever waits for it gets `BrokenOff`.
        nice: how far it stands back behind the others (nice(1)).
    """
    with ExitStack() as stack:
        said = stack.enter_context((folder / "qemu").open("wb"))
        environment = {**os.environ, "TMPDIR": str(folder)}
        process = subprocess.Popen(
            [*LEASH, "nice", "-n", str(nice), *command_line(start, folder, ports)],
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            env=environment,
        )
        machine = Machine(process, folder, ports, broken_off)
        machine.kept = start.memory.parent if start.memory else None
        stack.callback(machine.stop)
        yield machine

"""A Debian with a real systemd as its first process, in a container of this machine (systemd-nspawn(1)).

The base is built once and kept as a tar; each test session unpacks a fresh copy, in memory where there is enough of
it. Nothing is left behind: the container is stopped, its files are removed, and it has no mounts of its own outside of
its name spaces. What a killed session could not remove, the next one does.
"""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tools.bench.support.children import LEASH
from tools.bench.vm.image import APART
from tools.bench.vm.places import workspace

SUITE = "bookworm"
PACKAGES = "systemd,systemd-sysv,dbus,python3,udev"
TOOLS = {"systemd-nspawn": "systemd-container", "mmdebstrap": "mmdebstrap", "nsenter": "util-linux"}
ROOM = 1_500_000_000
"""Bytes that making the base takes for a while."""
BUILD_S, BOOT_S, COMMAND_S = 900.0, 60.0, 120.0


def missing() -> str:
    """What this machine lacks to run a container, with the remedy; empty if nothing."""
    if os.geteuid() != 0:
        return "a container with its own systemd needs root"
    packages = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    return f"missing programs: apt-get install {' '.join(packages)}" if packages else ""


def base() -> Path:
    """The base system as a tar; made where it is not there yet (two minutes, from the distribution's mirror).

    Broken off, no process of it goes on, and nothing stays mounted: mmdebstrap binds this machine's /dev/shm into what
    it makes.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lumiloop"
    tar = cache / f"{SUITE}.tar"
    if not tar.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with workspace("lumiloop-base", ROOM) as folder:
            part = folder / tar.name  # a name that tells mmdebstrap the format
            command = ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={PACKAGES}", SUITE, str(part)]
            environment = {**os.environ, "TMPDIR": str(folder)}
            subprocess.run([*LEASH, *APART, *command], check=True, timeout=BUILD_S, env=environment)
            whole = cache / f"{SUITE}.{os.getpid()}"
            try:
                shutil.copyfile(part, whole)
                whole.replace(tar)
            finally:
                whole.unlink(missing_ok=True)
    return tar


@dataclass
class Container:
    """A booted container.

    Attributes:
        root: its files. leader: its first process, as this machine numbers it.
    """

    root: Path
    leader: int

    def run(self, *command: str, check: bool = True, seconds: float = COMMAND_S) -> str:
        """Run a command inside; what it wrote, both streams."""
        enter = ["nsenter", "--target", str(self.leader), "--all", "--", *command]
        done = subprocess.run(enter, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=seconds)
        if check and done.returncode:
            raise AssertionError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}")
        return done.stdout

    def show(self, unit: str, *names: str) -> dict[str, str]:
        """Properties of a unit (systemctl show)."""
        lines = self.run("systemctl", "show", unit, *(f"--property={name}" for name in names)).splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def until(self, unit: str, seconds: float, **wanted: str) -> dict[str, str]:
        """Wait until a unit's properties are these."""
        end = time.monotonic() + seconds
        while True:
            seen = self.show(unit, *wanted)
            if seen == wanted:
                return seen
            if time.monotonic() > end:
                log = self.run("journalctl", "--no-pager", "-n", "30", check=False)
                raise AssertionError(f"{unit} is {seen}, not {wanted}, after {seconds} s:\n{log}")
            time.sleep(0.05)


def unpack(root: Path) -> None:
    """A fresh copy of the base system."""
    root.mkdir()
    subprocess.run(["tar", "-C", str(root), "-xf", str(base())], check=True, timeout=BUILD_S)


def inside(root: Path, *command: str, seconds: float = BUILD_S) -> str:
    """Run a command among its files, without booting it."""
    done = subprocess.run(
        ["chroot", str(root), *command],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=seconds,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@contextmanager
def booted(root: Path, *binds: str) -> Iterator[Container]:
    """Boot it; ``binds``: as nspawn's ``--bind``. Pulled off the mains at the end."""
    command = [*LEASH, "systemd-nspawn", "-q", "-D", str(root), "-b", "--register=no", "--keep-unit", "--console=pipe"]
    command += [f"--machine=lumiloop-{os.getpid()}", "--private-network", *(f"--bind={bind}" for bind in binds)]
    command += ["--property=DeviceAllow=char-pts rw"] if binds else []
    with (root.parent / "console").open("w") as console:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT)
    leader = 0
    try:
        leader = _wait_for_boot(process, root.parent / "console")
        yield Container(root, leader)
    finally:
        # all of its processes die with its first one, before that is gone; then nspawn ends, and leaves nothing
        if process.poll() is None:  # else its numbers are somebody else's by now
            with suppress(ProcessLookupError):
                os.kill(leader or process.pid, signal.SIGKILL)
        process.wait(timeout=BOOT_S)


def _wait_for_boot(process: subprocess.Popen[bytes], console: Path) -> int:
    """The leader, once its system is up."""
    end = time.monotonic() + BOOT_S
    while time.monotonic() < end and process.poll() is None:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if children:
            container = Container(Path(), int(children[0]))
            if container.run("systemctl", "is-system-running", check=False).strip() in ("running", "degraded"):
                return container.leader
        time.sleep(0.1)
    raise AssertionError(f"the container does not boot:\n{console.read_text()}")

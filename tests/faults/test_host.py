"""Faults of the computer and of what runs on it, on real processes: the same process all along, and TRACKING again."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from daemon.health.causes import CONSEQUENCES
from daemon.health.faults import Fault
from daemon.publish.modbus.client import NoAnswer, Reader
from daemon.publish.modbus.holding import CommandCode, Outcome
from daemon.publish.modbus.parts_block import FAULTS
from daemon.runtime.heartbeat import BEAT_S, OVER_S
from daemon.snapshot import State
from tests.daemon.processes.test_process import PATIENCE_S, ROOT, Running, fake_lidar, running
from tests.daemon.processes.test_store_process import ask

pytestmark = [pytest.mark.realtime, pytest.mark.system, pytest.mark.timeout(600)]

READY_S, TRACKING_S = 3.0, 5.0
"""From the end of a killed process to READY and TRACKING of the next, on an idle machine; here with fourfold slack."""


def newest(daemon: Running) -> dict[str, object]:
    """A datagram sent from now on."""
    daemon.poses.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            daemon.poses.recv(2000)
    return dict(daemon.reading())


def tracking(daemon: Running, seconds: float = PATIENCE_S) -> None:
    newest(daemon)
    daemon.until(seconds, "state", State.TRACKING)


def present(daemon: Running) -> set[int]:
    """All faults, not the gravest alone: on a loaded machine scans may come late meanwhile."""
    end = time.monotonic() + PATIENCE_S
    with Reader("127.0.0.1", daemon.modbus) as reader:
        while True:
            with contextlib.suppress(NoAnswer):
                reading = reader.read()
                if "fault_1" in reading:
                    return {int(reading[f"fault_{k}"] or 0) for k in range(1, FAULTS + 1)}
            assert time.monotonic() < end, "the table of faults is not answered"


def named(daemon: Running, fault: Fault, seconds: float) -> None:
    end = time.monotonic() + seconds
    while int(fault) not in (there := present(daemon)):
        assert time.monotonic() < end, f"fault {int(fault)} is not named within {seconds} s, but {there}"
        time.sleep(0.05)


def over(daemon: Running, fault: Fault, seconds: float) -> None:
    end = time.monotonic() + seconds
    while int(fault) in present(daemon):
        assert time.monotonic() < end, f"fault {int(fault)} is not over within {seconds} s"
        time.sleep(0.05)


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A file system of its own with no room to speak of."""
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], check=False)
    if mounted.returncode:
        pytest.skip("file systems cannot be mounted here: run as root, in a container that may")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def fill(disk: Path) -> Path:
    """Take all that is left."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    return ballast


def disk_full(daemon: Running, disk: Path) -> None:
    ballast = fill(disk)
    assert ask(daemon, 11, CommandCode.SAVE_MAP) is Outcome.REFUSED
    named(daemon, Fault.MAP_NOT_SAVED, 8.0)
    ballast.unlink()
    assert ask(daemon, 12, CommandCode.SAVE_MAP) is Outcome.DONE
    over(daemon, Fault.MAP_NOT_SAVED, 20.0)


def read_only(daemon: Running, disk: Path) -> None:
    """Another file system lies over the folder's, and may not be written."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", disk], check=True)
    try:
        assert ask(daemon, 13, CommandCode.SAVE_MAP) is Outcome.REFUSED
        named(daemon, Fault.MAP_NOT_SAVED, 8.0)
    finally:
        subprocess.run(["umount", disk], check=True)
    assert ask(daemon, 14, CommandCode.SAVE_MAP) is Outcome.DONE
    over(daemon, Fault.MAP_NOT_SAVED, 20.0)


def stopped(daemon: Running, _disk: Path) -> None:
    daemon.process.send_signal(signal.SIGSTOP)
    time.sleep(3.0)
    daemon.process.send_signal(signal.SIGCONT)
    named(daemon, Fault.LOOP_STALLED, 5.0)
    tracking(daemon)
    over(daemon, Fault.LOOP_STALLED, 40.0)


def stuck_clients(daemon: Running, _disk: Path) -> None:
    """Half a request, and never a word read of what is answered to a thousand whole ones."""
    lines = [socket.create_connection(("127.0.0.1", daemon.modbus), 5.0) for _ in range(4)]
    try:
        lines[0].sendall(b"\0\1\0\0\0\6\1")
        for line in lines[1:]:
            line.setblocking(False)
            with contextlib.suppress(BlockingIOError, ConnectionError):
                for _ in range(1000):
                    line.send(struct.pack(">HHHBBHH", 1, 0, 6, 1, 4, 0, 100))
        steady(daemon)
    finally:
        for line in lines:
            line.close()


def slow_listener(daemon: Running, disk: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect(str(disk.parent / "lumiloop" / "lumiloop.stream"))
        steady(daemon)


def steady(daemon: Running, seconds: float = 3.0) -> None:
    """Poses go on coming, all of them of a robot that is TRACKING."""
    first = newest(daemon)
    time.sleep(seconds)
    last = newest(daemon)
    assert first["state"] == last["state"] == State.TRACKING
    came = int(str(last["seq"])) - int(str(first["seq"]))
    assert came > 40 * seconds / 4, f"{came} poses in {seconds} s"
    loaded = {Fault.COMPUTER_SLOW} | CONSEQUENCES[Fault.COMPUTER_SLOW]
    assert present(daemon) <= {0, *loaded}, "a loaded machine, no more"


def no_descriptors(daemon: Running, _disk: Path) -> None:
    """The limit is lowered to what is open and a few more; then clients take those."""
    pid, before = daemon.process.pid, resource.prlimit(daemon.process.pid, resource.RLIMIT_NOFILE)
    limit = max(int(file.name) for file in Path(f"/proc/{pid}/fd").iterdir()) + 12
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (limit, before[1]))
    with contextlib.ExitStack() as lines:
        for _ in range(20):
            lines.enter_context(socket.create_connection(("127.0.0.1", daemon.modbus), 5.0))
        named(daemon, Fault.NO_DESCRIPTORS, 5.0)
        tracking(daemon)
    over(daemon, Fault.NO_DESCRIPTORS, 20.0)
    resource.prlimit(pid, resource.RLIMIT_NOFILE, before)


CHAIN: list[Callable[[Running, Path], None]] = [
    stopped,
    stuck_clients,
    no_descriptors,
    slow_listener,
    disk_full,
    read_only,
]


def taken(tty: Path) -> list[int]:
    """Ends of terminals, one of which has the number that another one had; lower ones may be free, too."""
    ends: list[int] = []
    while len(ends) < 64:
        ends += os.openpty()
        if os.ttyname(ends[-1]) == str(tty):
            break
    return ends


def test_one_process_survives_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    link = tmp_path / "lidar"
    with small_disk(tmp_path / "disk") as disk:
        keys = ("--set", f"map.folder={disk / 'maps'}", "--set", "modbus.write=true")
        with running(link, *keys) as daemon:
            with fake_lidar(link):
                tracking(daemon)
                before = link.readlink()
                for harm in CHAIN:
                    harm(daemon, disk)
                    tracking(daemon)
                    assert daemon.process.poll() is None, harm.__name__
            named(daemon, Fault.LIDAR_MISSING, 10.0)
            other = taken(before)
            with fake_lidar(link):
                assert link.readlink() != before, "the lidar has come back as another tty"
                tracking(daemon)
                over(daemon, Fault.LIDAR_MISSING, 40.0)
                time.sleep(OVER_S + 2.0 * BEAT_S)  # so long a fault must be gone before the log says so
                code, log, _ = daemon.stop()
            for end in other:
                os.close(end)
    assert code == 0, log
    assert "Traceback" not in log
    for fault in (Fault.LOOP_STALLED, Fault.NO_DESCRIPTORS, Fault.MAP_NOT_SAVED, Fault.LIDAR_MISSING):
        gone = log.count(f"over: fault {int(fault)}: ")
        come = log.count(f" fault {int(fault)}: ") - gone
        still = int(fault is Fault.LOOP_STALLED and come > gone)  # a loaded machine may stall once more at the end
        assert come == gone + still, f"fault {int(fault)}: said {come} times, over {gone} times"
        assert gone >= 1 or f" fault {int(fault)} follows from fault 306" in log
    warned = re.findall(r" (?:WARNING|ERROR) +(.*)", log)
    expected = ("fault ", "Modbus: SAVE_MAP refused", "socket.accept() out of system resource: ")
    assert [line for line in warned if not line.startswith(expected)] == []
    assert sum(line.startswith(expected[2]) for line in warned) <= 3, "a line in ten seconds, not one an attempt"


def test_killed_it_comes_back_with_its_map(tmp_path: Path) -> None:
    link, maps = tmp_path / "lidar", tmp_path / "maps"
    keys = ("--set", f"map.folder={maps}", "--set", "modbus.write=true")
    with fake_lidar(link):
        with running(link, *keys) as daemon:
            tracking(daemon)
            assert ask(daemon, 1, CommandCode.SAVE_MAP) is Outcome.DONE
            map_id = newest(daemon)["map_id"]
            daemon.process.kill()
            daemon.process.wait()
        with running(link, *keys) as again:
            first = again.until(4 * READY_S, "state", *(state for state in State if state is not State.STARTING))
            assert first["map_id"] == map_id
            again.until(4 * (READY_S + TRACKING_S), "state", State.TRACKING)
            again.stop()


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["truncated", "garbage", "empty"])
def test_a_map_that_is_damaged_is_named_and_left_aside(tmp_path: Path, harm: str) -> None:
    link, maps = tmp_path / "lidar", tmp_path / "maps"
    maps.mkdir()
    whole = (ROOT / "tests" / "daemon" / "maps" / "data" / "version-1.lumimap").read_bytes()
    bad = {"truncated": whole[: len(whole) // 2], "garbage": os.urandom(len(whole)), "empty": b""}[harm]
    (maps / "map-00001234-00000001.lumimap").write_bytes(bad)
    with fake_lidar(link), running(link, "--set", f"map.folder={maps}") as daemon:
        named(daemon, Fault.MAP_REFUSED, 20.0)
        tracking(daemon)
        code, log, _ = daemon.stop()
    assert code == 0, log
    assert "is refused" in log
    assert "Traceback" not in log


@pytest.mark.parametrize(
    "text", ["[lidar\ndevice = 'auto'", "[lidar]\ndevice = 'aut", "\0\1\2\3", "[lidar]\ndevise = 1"]
)
def test_a_configuration_that_is_damaged_is_refused_with_its_place(tmp_path: Path, text: str) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(text)
    command = [sys.executable, "-m", "daemon", "run", "--config", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60.0)
    assert done.returncode == 2, done.stderr
    assert "robot.toml" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_memory_that_cannot_be_had_stops_no_pose(tmp_path: Path) -> None:
    """The process may grow by 4 MB and no more for some seconds; what it refuses is refused, poses go on."""
    if shutil.which("prlimit") is None:
        pytest.skip("prlimit is missing: apt-get install util-linux")
    link = tmp_path / "lidar"
    with fake_lidar(link), running(link, "--set", f"map.folder={tmp_path / 'maps'}") as daemon:
        tracking(daemon)
        pid = daemon.process.pid
        size = int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * resource.getpagesize()
        before = resource.prlimit(pid, resource.RLIMIT_AS)
        resource.prlimit(pid, resource.RLIMIT_AS, (size + (4 << 20), before[1]))
        time.sleep(5.0)
        resource.prlimit(pid, resource.RLIMIT_AS, before)
        tracking(daemon)
        assert daemon.process.poll() is None
        code, log, _ = daemon.stop()
    assert code == 0, log

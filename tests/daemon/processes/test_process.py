"""The real program as a process of its own: the fake sensor on a pty, real sockets, real time, signals."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from daemon.publish.modbus import registers
from daemon.publish.modbus.points import Value
from daemon.snapshot import State

ROOT = Path(__file__).parents[3]
START_S = 1.5
RESIDENT_MB = 260.0
PATIENCE_S = 60.0

pytestmark = pytest.mark.realtime


@dataclass
class Running:
    """A daemon process, the socket its pose datagrams arrive at, and what it wrote."""

    process: subprocess.Popen[str]
    poses: socket.socket
    modbus: int
    begun: float

    def reading(self, seconds: float = 5.0) -> dict[str, Value]:
        """The next datagram."""
        self.poses.settimeout(seconds)
        return registers.decode_datagram(self.poses.recv(2000))

    def until(self, seconds: float, name: str, *values: object) -> dict[str, Value]:
        """The first datagram that says one of the values."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            reading = self.reading()
            if reading[name] in values:
                return reading
        raise AssertionError(f"no {name} in {values} within {seconds} s; last: {reading}")

    def stop(self) -> tuple[int, str, float]:
        """End it as the service manager does: exit code, log, seconds it took."""
        asked = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        _, text = self.process.communicate(timeout=20.0)
        return self.process.returncode, text, time.monotonic() - asked


@contextmanager
def fake_lidar(link: Path) -> Iterator[subprocess.Popen[str]]:
    """A UTM-30LX on a pty; ends with the block."""
    command = [sys.executable, "-m", "hal.fake", "--model", "UTM-30LX", "--pty", str(link)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as fake:
        try:
            while not link.exists():
                assert fake.poll() is None, fake.stdout and fake.stdout.read()
                time.sleep(0.02)
            yield fake
        finally:
            fake.send_signal(signal.SIGINT)
            fake.communicate(timeout=10.0)


@contextmanager
def running(device: Path, *more: str, modbus: int = 0) -> Iterator[Running]:
    """The daemon on that device."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as poses:
        poses.bind(("127.0.0.1", 0))
        if not modbus:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                modbus = free.getsockname()[1]
        receivers = f"pose.receivers=['127.0.0.1:{poses.getsockname()[1]}']"
        settings = ["--set", receivers, "--set", f"modbus.port={modbus}"]
        command = [sys.executable, "-m", "daemon", "run", "--lidar", str(device), *settings, *more]
        begun = time.monotonic()
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
            try:
                yield Running(process, poses, modbus, begun)
            finally:
                if process.poll() is None:
                    process.kill()


@pytest.fixture(scope="module", autouse=True)
def _warm() -> None:
    """The figures are for warm caches."""
    subprocess.run([sys.executable, "-c", "from daemon.runtime import warmup; warmup.load()"], cwd=ROOT, check=True)


def resident_mb(process: subprocess.Popen[str]) -> float:
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_a_lidar_in_a_pose_out(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    with fake_lidar(link), running(link) as daemon:
        daemon.until(4 * START_S, "state", State.MAPPING)
        took = time.monotonic() - daemon.begun
        assert took < 4 * START_S, f"first pose after {took:.2f} s"
        tracking = daemon.until(PATIENCE_S, "state", State.TRACKING)
        time.sleep(2.0)
        while daemon.reading()["t_mono"] < tracking["t_mono"] + 2.0:  # type: ignore[operator]  # known in TRACKING
            pass
        later = daemon.reading()
        moved = abs(float(later["map_x"] or 0.0)) + abs(float(later["map_y"] or 0.0))
        assert moved > 0.2, "the pose moves"
        assert later["scan_rate"] == pytest.approx(39.92, abs=1.0)
        assert resident_mb(daemon.process) < RESIDENT_MB
        command = [sys.executable, "-m", "daemon", "status", f"127.0.0.1:{daemon.modbus}", "--json"]
        told = json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)
        assert (told["schema"], told["state"]) == ("lumiloop.status/1", State.TRACKING.name)
        code, log, seconds = daemon.stop()
        assert code == 0
        assert seconds < 3.0
        assert "stopping" in log
        assert "Traceback" not in log
        assert _is_silent(link), "the laser is off"


def _is_silent(link: Path) -> bool:
    """Whether nothing comes out of the port: a sensor whose laser is on would stream to whoever opens it."""
    port = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        termios.tcflush(port, termios.TCIOFLUSH)
        return select.select([port], [], [], 0.5)[0] == []
    finally:
        os.close(port)


@pytest.mark.system
def test_no_lidar_and_a_taken_port_are_said_and_waited_for(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with running(link, modbus=taken.getsockname()[1]) as daemon:
            daemon.until(10.0, "state", State.NO_LIDAR)
            assert daemon.until(10.0, "fault", 101, 401)["map_x"] is None
            taken.close()
            with fake_lidar(link):
                daemon.until(PATIENCE_S, "state", State.TRACKING)
                code, log, _ = daemon.stop()
    assert code == 0
    assert f"{link}: " in log
    assert "modbus.port" in log
    assert "modbus works again" in log


def test_a_stop_while_it_is_still_starting(tmp_path: Path) -> None:
    with running(tmp_path / "lidar") as daemon:
        time.sleep(0.4)
        code, log, seconds = daemon.stop()
    assert seconds < 5.0
    assert code in (0, -signal.SIGTERM), log  # before the handler is installed the signal simply ends it


def test_a_wrong_configuration_is_refused_at_once(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[modbus]\nprot = 1502\n")
    command = [sys.executable, "-m", "daemon", "run", "--config", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "robot.toml:2: unknown key `modbus.prot`; did you mean `modbus.port`?" in done.stderr


@pytest.mark.system
def test_a_recording_is_made_beside(tmp_path: Path) -> None:
    link, folder = tmp_path / "lidar", tmp_path / "drive"
    with fake_lidar(link), running(link, "--record", str(folder)) as daemon:
        daemon.until(PATIENCE_S, "state", State.TRACKING)
        code, log, _ = daemon.stop()
        assert code == 0, log
    out = tmp_path / "out"
    command = [sys.executable, "-m", "daemon", "replay", str(folder), "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len((out / "trajectory.tum").read_text().splitlines()) > 50
    compared = json.loads((out / "summary.json").read_text())["recorded_run"]
    assert compared["cycles"] > 50
    assert compared["differ"] == 0, compared["first_difference"]


def test_a_tap_on_this_computer_gets_poses_and_scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "lidar"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    client = str(ROOT / "tools/clients/watch_stream.py")
    with fake_lidar(link), running(link) as daemon:
        daemon.until(PATIENCE_S, "state", State.MAPPING, State.TRACKING)
        command = [sys.executable, client, str(tmp_path / "lumiloop" / "lumiloop.stream"), "pose", "scan"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as tap:
            assert tap.stdout is not None
            lines = [tap.stdout.readline() for _ in range(9)]
            tap.terminate()
        assert lines[0].startswith("this is lumiloop 'lumiloop', process ")
        assert sum(" scan " in line and "of 1081 beams" in line for line in lines) >= 3
        assert sum("MAPPING" in line or "TRACKING" in line for line in lines) >= 3
        assert not daemon.process.poll()
        daemon.stop()
    assert not (tmp_path / "lumiloop" / "lumiloop.stream").exists()

"""A daemon that is killed: the next one knows where the robot stands, from what the last one kept as it drove."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from daemon.publish.modbus.holding import CommandCode, Outcome
from daemon.snapshot import State
from tests.daemon.processes.test_process import PATIENCE_S, ROOT, running
from tests.daemon.processes.test_store_process import ask
from tests.daemon.support.room import ranges_m

pytestmark = [pytest.mark.realtime, pytest.mark.system]

READY_S = 3.0
TRACKING_S = 5.0
SLACK = 2.0
"""Of processor time: what the clock on the wall says depends on who else uses the computer."""


@contextmanager
def parked_lidar(link: Path) -> Iterator[None]:
    """A lidar of a robot at rest."""
    rng, angle = np.random.default_rng(4), 2.0 * np.pi / 1024 * (np.arange(726) - 384)
    exact = 1000.0 * ranges_m(angle, np.full(726, -0.7), np.full(726, 0.4))
    scans = np.rint(exact + rng.normal(0.0, 8.0, (50, 726))).astype(np.int32)
    world = link.with_suffix(".npz")
    np.savez(world, range_mm=np.tile(scans, (60, 1)))
    command = [sys.executable, "-m", "hal.fake", "--model", "URG-04LX-UG01", "--pty", str(link), "--world", str(world)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as fake:
        try:
            while not link.exists():
                assert fake.poll() is None, fake.stdout and fake.stdout.read()
                time.sleep(0.02)
            yield
        finally:
            fake.send_signal(signal.SIGINT)


def processor_s(pid: int) -> float:
    """Seconds of processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_robot_that_stands_is_tracking_again_soon_after_a_kill(tmp_path: Path) -> None:
    link, folder = tmp_path / "lidar", tmp_path / "maps"
    keys = ("--set", f"map.folder={folder}", "--set", "modbus.write=true")
    with parked_lidar(link):
        with running(link, *keys) as daemon:
            daemon.reading(PATIENCE_S)
            daemon.until(PATIENCE_S, "state", State.TRACKING)
            assert ask(daemon, 1, CommandCode.SAVE_MAP) is Outcome.DONE
            before = daemon.until(5.0, "state", State.TRACKING)
            time.sleep(0.5)
            daemon.process.kill()
            daemon.process.communicate(timeout=10.0)
        with running(link, *keys) as daemon:
            ready = daemon.reading(PATIENCE_S)
            assert ready["state"] != State.TRACKING, "the place has to be found first"
            ready_s = processor_s(daemon.process.pid)
            after = daemon.until(PATIENCE_S, "state", State.TRACKING)
            tracking_s = processor_s(daemon.process.pid)
            code, log, _ = daemon.stop()
    assert code == 0, log
    assert "the last stored pose is x" in log
    assert ready["map_id"] == after["map_id"] == before["map_id"]
    for axis in ("map_x", "map_y", "map_yaw"):
        was, now = before[axis], after[axis]
        assert was is not None
        assert now is not None
        assert abs(now - was) < 0.03
    assert ready_s < SLACK * READY_S
    assert tracking_s < SLACK * TRACKING_S

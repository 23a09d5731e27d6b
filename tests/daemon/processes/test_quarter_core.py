"""The real program under load: 1081 beams at 40 Hz, 41 coded lamps and wheels, with a quarter of one core to itself."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from daemon.devices.light_setup import Lights
from daemon.publish.modbus.points import Value
from daemon.runtime.warmup import load
from daemon.snapshot import State
from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter.survey import Survey
from tests.daemon.processes.cpu_quota import PERIOD_US, cpu_s, held_back
from tests.daemon.processes.test_process import ROOT, Running, running
from tools.sim.ports import free_port

# real time without slack: for a machine that does nothing else, so not among the quick system tests
pytestmark = [pytest.mark.realtime, pytest.mark.system, pytest.mark.slow]

SHARE = 0.25
SCAN_S = 0.02505
SECONDS = 20.0
GAP_S = 2 * SCAN_S + 1e-6 * PERIOD_US
"""Longest step between the instants of two poses in a row. A pose is of its scan's end or of the newest odometry that
came until its cycle began, which is before the next scan was read; and that is read when the limit lets the process run
again. So one scan's end, the end of the next but one, and a period of the limit are the farthest apart."""
SETTLE_S = 5.0
"""Until caps have followed from a whole core to a quarter of one."""


@contextmanager
def simulator(folder: Path, odometry: int) -> Iterator[None]:
    """Robot, lidar, lamps and wheels, outside the limit."""
    devices = [
        "--pty",
        str(folder / "lidar"),
        "--light",
        f"unix:{folder / 'bus'}",
        "--survey",
        str(folder / "lamps.toml"),
    ]
    where = ["--building", "paper_room", "--lidar", "UTM-30LX", "--odometry", f"udp://127.0.0.1:{odometry}"]
    command = [sys.executable, "-m", "tools.sim", *where, *devices]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert json.loads(process.stdout.readline())["lidar"]
            prefer(process.pid)
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=20.0)


def prefer(pid: int) -> None:
    """Ahead of everything else on this machine, where that is allowed: what is to be seen is the limit's effect."""
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, -15)


@dataclass
class Stretch:
    """What was published during a stretch of time, and the processor time it took."""

    readings: list[dict[str, Value]]
    share: float

    def gained(self, name: str) -> int:
        return int(self.readings[-1][name] or 0) - int(self.readings[0][name] or 0)

    def column(self, name: str) -> list[float]:
        return [float(reading[name] or 0.0) for reading in self.readings]


def listen(daemon: Running, seconds: float) -> Stretch:
    pid = daemon.process.pid
    begun, used = time.monotonic(), cpu_s(pid)
    readings = []
    while time.monotonic() < begun + seconds:
        readings.append(daemon.reading())
    return Stretch(readings, (cpu_s(pid) - used) / (time.monotonic() - begun))


def test_no_scan_is_missed_with_a_quarter_of_one_core(tmp_path: Path) -> None:
    load(Lights(Survey(), PROFILE_A))
    odometry = free_port()
    keys = {
        "odometry.port": odometry, "photodiode.bus": f"unix:{tmp_path / 'bus'}",
        "lights.survey": tmp_path / "lamps.toml", "lidar.mount.x": 0.15,
    }  # fmt: skip
    settings = [part for key, value in keys.items() for part in ("--set", f"{key}={value}")]
    with simulator(tmp_path, odometry), running(tmp_path / "lidar", *settings) as daemon:
        prefer(daemon.process.pid)
        daemon.until(90.0, "state", State.TRACKING)
        whole = listen(daemon, SETTLE_S)
        with held_back(daemon.process.pid, SHARE) as means:
            listen(daemon, SETTLE_S)
            held = listen(daemon, SECONDS)
        code, said, _ = daemon.stop()
    assert code == 0
    assert "Traceback" not in said
    report(whole, held, means)
    assert held.share < 1.2 * SHARE, "the limit was in force"
    assert held.gained("missed") == 0, "every scan that the sensor sent was processed"
    stamps = held.column("t_mono")
    assert held.gained("seq") >= (stamps[-1] - stamps[0]) / SCAN_S - 2.0, "and published"
    assert {b - a for a, b in pairwise(held.column("seq"))} == {1.0}, "one by one"
    assert max(b - a for a, b in pairwise(stamps)) < GAP_S, "and none of them late"
    late = sum(seconds > 0.5 * SCAN_S for seconds in held.column("cycle")[1:])
    assert held.gained("overruns") == pytest.approx(late, abs=2), "overruns are said"
    assert {reading["state"] for reading in held.readings} <= {State.TRACKING, State.DEGRADED}


def report(whole: Stretch, held: Stretch, means: str) -> None:
    """For the person who runs it with ``-s``."""
    for name, stretch in (("whole core", whole), (f"held back by {means}", held)):
        cycle = sorted(stretch.column("cycle"))
        middle, worst = 1e3 * cycle[len(cycle) // 2], 1e3 * cycle[-1]
        step = 1e3 * max(b - a for a, b in pairwise(stretch.column("t_mono")))
        sys.stdout.write(
            f"{name}: {100 * stretch.share:.0f} % of a core, {len(cycle)} cycles, median {middle:.1f} ms, "
            f"max {worst:.1f} ms, overruns {stretch.gained('overruns')}, missed {stretch.gained('missed')}, "
            f"longest step {step:.1f} ms\n"
        )

"""A walk: somebody drives the robot about while the shipped program records; a simulated robot where there is none."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.hil.ends import Operator
from tests.hil.programs import Served, daemon, process
from tools.sim.ports import free_port
from tools.sim.robot.drive import Body

SIMULATED_S: Final = 30.0


@dataclass(frozen=True)
class Walked:
    """What came of a walk.

    Attributes:
        recording: folder. way: (x, y) as read over Modbus. tracked: share of the reads that said TRACKING.
        mount: where the laser truly sits on the robot (m, deg), where that is known.
    """

    folder: Path
    recording: Path
    way: list[tuple[float, float]]
    tracked: float
    mount: tuple[float, float, float] | None


@contextmanager
def simulated(folder: Path) -> Generator[tuple[Served, int, subprocess.Popen[bytes]]]:
    """A robot that waits to be told to drive through the paper's room, and the port that its odometry goes to."""
    odometry = free_port()
    where = ["--pty", str(folder / "lidar"), "--odometry", f"udp://127.0.0.1:{odometry}", "--hold", "--empty"]
    command = [sys.executable, "-m", "tools.sim", *where, "--lidar", "UHG-08LX"]
    with process(command, lambda said: '"lidar"' in said) as world:
        yield Served(str(folder / "lidar"), None, folder), odometry, world


def walk_simulated(lumiloop: list[str], folder: Path) -> Walked:
    """Half a minute of it."""
    x, y, yaw = Body().lidar
    with simulated(folder) as (served, odometry, world):

        def go() -> None:
            world.send_signal(signal.SIGUSR1)

        reads = _recorded(lumiloop, served, odometry, go, SIMULATED_S)
    return _walked(folder, reads, (x, y, 57.29578 * yaw))


def walk_real(lumiloop: list[str], served: Served, port: int, seconds: float) -> Walked:
    """As long as the option says; whoever drives is told when to begin."""

    def go() -> None:
        request = f"drive {seconds:.0f} s, curves both ways and turns on the spot, and come back; begin"
        _tell(served.operator, request)

    return _walked(served.folder, _recorded(lumiloop, served, port, go, seconds), None)


def _tell(operator: Operator | None, request: str) -> None:
    """With nobody to ask, the robot's own program is taken to drive by itself."""
    if operator is not None:
        operator.tell(request, "list")


def _recorded(
    lumiloop: list[str], served: Served, odometry: int, go: Any, seconds: float
) -> list[dict[str, float | int | str | None]]:
    recording = ["--record", str(served.folder / "walk"), "--set", f"odometry.port={odometry}"]
    with daemon(lumiloop, served, *recording) as running:
        running.until(90.0, "TRACKING", "MAPPING")
        go()
        reads, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            reads.append(running.read())
            time.sleep(0.05)
        code, _ = running.stop()
        assert code == 0, running.tail()
    return [one for one in reads if one]


def _walked(folder: Path, reads: list[dict[str, Any]], mount: tuple[float, float, float] | None) -> Walked:
    way = [(one["x"], one["y"]) for one in reads if one["x"] is not None]
    (folder / "walk.json").write_text(json.dumps(way))
    tracked = sum(one["state"] == "TRACKING" for one in reads) / max(len(reads), 1)
    (recording,) = [path for path in (folder / "walk").iterdir() if path.is_dir()] or [folder / "walk"]
    return Walked(folder, recording, way, tracked, mount)

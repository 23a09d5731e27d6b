"""A robot computer that is none: `lumiloop run` as a process of this computer, on a pty and loopback."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from daemon.runtime import warmup
from tools.bench.report.page import ROOT
from tools.bench.support.children import LEASH
from tools.bench.world.scenario import Scenario
from tools.bench.world.stage import CannotPlay, Ends
from tools.sim.light.serve import write_plan


def warm(lamps: bool, say: Callable[[str], None]) -> None:
    """Compile what the daemon will load before anybody waits for its pose; that is said where it takes its time.

    In another process, as the daemon is one: this one keeps its memory for the world.

    Raises:
        CannotPlay: it cannot be compiled; says why. CannotLoad: there is nowhere to keep it.
    """
    light = ["--set", "photodiode.bus=unix:/bus"] if lamps else []
    command = [*LEASH, sys.executable, "-m", "daemon", "warm", *light]

    def compiles() -> None:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            raise CannotPlay(f"the daemon's kernels are not compiled: {done.stderr.strip()}")

    warmup.load_aloud(say, "warm-lights" if lamps else "warm", compiles)


@contextmanager
def robot(scenario: Scenario, serial: str = "") -> Generator[Ends]:
    """Start it on ``serial``, or on a pty of its own, with a folder for maps; nothing of it is left at the end."""
    with tempfile.TemporaryDirectory(prefix="lumiloop-world-") as made:
        folder = Path(made)
        modbus, odometry = _free(socket.SOCK_STREAM), _free(socket.SOCK_DGRAM)
        scene = scenario.scene(held=True)
        x, y, _ = scene.mount
        values = {"modbus.port": modbus, "odometry.port": odometry, "lidar.mount.x": x, "lidar.mount.y": y}
        light = ""
        if scene.light is not None:
            light = f"unix:{folder / 'bus'}"
            write_plan(scene.light, folder / "lamps.toml")
            values |= {"photodiode.bus": f'"{light}"', "lights.survey": f'"{folder / "lamps.toml"}"'}
        sets = [word for key, value in values.items() for word in ("--set", f"{key}={value}")]
        command = [*LEASH, sys.executable, "-m", "daemon", "run", "--lidar", serial or str(folder / "lidar"), *sets]
        log = folder / "daemon.log"
        environment = {**os.environ, "XDG_STATE_HOME": str(folder / "state")}
        with log.open("wb") as said, subprocess.Popen(command, cwd=ROOT, stderr=said, env=environment) as child:
            try:
                yield Ends(f"pty:{folder / 'lidar'}", ("127.0.0.1", modbus), f"udp://127.0.0.1:{odometry}", light)
            finally:
                child.send_signal(signal.SIGTERM)
                try:
                    child.wait(20.0)
                except subprocess.TimeoutExpired:
                    child.kill()
                _keep(log)


def _keep(log: Path) -> None:
    """The daemon's log outlives its folder where there is something wrong in it."""
    text = log.read_text(errors="replace")
    if "Traceback" in text:
        sys.stderr.write(text)


def _free(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])

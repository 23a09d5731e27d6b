"""Hours of the real processes: the daemon, which keeps maps and a recording, and the demo's simulator, in real time."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from daemon.publish.modbus.client import NoAnswer, Reader
from daemon.snapshot import State
from tools.demo.run import (
    BUS,
    CONTROL,
    SURVEY,
    DemoError,
    Patience,
    running,
    wait_for_pose,
    wait_for_simulator,
    write_config,
)
from tools.sim.ports import free_port
from tools.soak.watched import Watch

ROW_S: Final = 20.0


class Ended(Exception):
    """A process has ended, or the daemon has stopped answering; the text says which."""


def run(seconds: float, seed: int, out: Path, say: Callable[[str], None]) -> Watch:
    """Watch them for so long; everything is stopped when this returns or raises.

    Raises:
        Ended: one of them did not last.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="lumiloop-soak-") as holder, contextlib.ExitStack() as stack:
        folder, modbus, odometry = Path(holder), free_port(), free_port()
        config, stored = write_config(folder, modbus, odometry), folder / "stored"
        stored.mkdir()
        truth = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        truth.bind(("127.0.0.1", 0))  # a socket of its own, never read
        words = [sys.executable, "-m", "tools.sim", "--building", "paper_room", "--seed", str(seed), "--hold"]
        words += ["--pty", str(folder / "lidar"), "--odometry", f"udp://127.0.0.1:{odometry}"]
        words += ["--truth", f"udp://127.0.0.1:{truth.getsockname()[1]}", "--control", str(folder / CONTROL)]
        words += ["--light", f"unix:{folder / BUS}", "--survey", str(folder / SURVEY)]
        patience = Patience(out)
        try:
            simulator = stack.enter_context(running(words, out / "simulator.log", stdout=subprocess.PIPE))
            wait_for_simulator(simulator, patience)
            daemon_words = [sys.executable, "-m", "daemon", "run", "--config", str(config)]
            daemon_words += [
                "--set",
                f"map.folder={stored / 'maps'}",
                "--record",
                str(stored / "record"),
                "--last",
                "10",
            ]
            space = dict(os.environ, XDG_STATE_HOME=str(stored))
            daemon = stack.enter_context(
                running(daemon_words, out / "daemon.log", stdout=subprocess.DEVNULL, env=space)
            )
            reader = stack.enter_context(Reader("127.0.0.1", modbus))
            wait_for_pose(daemon, reader, patience)
        except DemoError as error:
            raise Ended(str(error)) from error
        simulator.send_signal(signal.SIGUSR1)
        return watched((daemon, simulator), reader, seconds, say, Watch(folder=stored))


def watched(
    children: tuple[subprocess.Popen[str], subprocess.Popen[str]],
    reader: Reader,
    seconds: float,
    say: Callable[[str], None],
    watch: Watch,
) -> Watch:
    """Rows about the daemon, as long as both processes live."""
    begin, unanswered = time.monotonic(), 0
    while (t := time.monotonic() - begin) < seconds:
        for child in children:
            if child.poll() is not None:
                raise Ended(f"a process ended with code {child.returncode} after {t:.0f} s: {child.args}")
        time.sleep(min(ROW_S, seconds - t))
        try:
            reading = reader.read()
        except NoAnswer as error:
            unanswered += 1
            if unanswered > 3:
                raise Ended(f"the daemon does not answer any more: {error}") from error
            continue
        unanswered = 0
        p50, p99, most = (1e3 * float(reading.get(f"cycle_{kind}") or 0.0) for kind in ("p50", "p99", "max"))
        watch.take((time.monotonic() - begin) / 3600.0, children[0].pid, (p50, p99, most))
        say(f"{watch.line()}  {State(int(reading['state'] or 0)).name}")
    return watch

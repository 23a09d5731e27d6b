"""What `run --record` and its ring cost: processor time of a daemon that records less that of one that does not.

The same daemon on the same fake UTM-30LX (1081 beams at 40 Hz), with and without in turns, because what a cycle costs
on a shared machine changes by more than what is sought. All threads count.
"""

import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tools.bench.support.children import child, ended
from tools.ci.figures import Figure, bounded

COMMAND = "make bench ARGS=recording"
PAIRS = 4
SETTLE_S, SPAN_S = 8.0, 20.0
TICK_HZ = os.sysconf("SC_CLK_TCK")


def processor_s(pid: int) -> float:
    """Processor time of a process so far, all threads, user and system."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK_HZ


def share(lidar: Path, *more: str) -> float:
    """Share of a core that a daemon takes that has run for a while."""
    settings = [f"lidar.device={lidar}", "modbus.port=0", "map.folder=none"]
    command = [sys.executable, "-m", "daemon", "run", *(w for s in settings for w in ("--set", s)), *more]
    with child(*command, mute=True) as daemon:
        time.sleep(SETTLE_S)
        _alive(daemon, "the daemon")
        begun, before = time.monotonic(), processor_s(daemon.pid)
        time.sleep(SPAN_S)
        _alive(daemon, "the daemon")
        took = (processor_s(daemon.pid) - before) / (time.monotonic() - begun)
        daemon.send_signal(signal.SIGTERM)
        ended(daemon, "the daemon")
        return took


def _alive(started: subprocess.Popen[bytes], name: str) -> None:
    """A process that has ended takes no processor time, and would look good.

    Raises:
        RuntimeError: it has.
    """
    if started.poll() is not None:
        raise RuntimeError(f"{name} ended with {started.returncode}: nothing can be measured")


def run() -> list[Figure]:
    """The median of several differences, and how far they are apart."""
    added, alone = [], []
    with tempfile.TemporaryDirectory() as folder:
        link, ring = Path(folder, "lidar"), Path(folder, "ring")
        fake = [sys.executable, "-m", "hal.fake", "--model", "UTM-30LX", "--pty", str(link)]
        with child(*fake, mute=True) as sensor:
            while not os.path.lexists(link):
                _alive(sensor, "the fake sensor")
                time.sleep(0.02)
            share(link)  # it may compile
            for _ in range(PAIRS):
                alone.append(share(link))
                added.append(share(link, "--record", str(ring), "--last", "10") - alone[-1])
    return [
        Figure("a daemon that does not record, of a core", 100.0 * statistics.median(alone), "%", command=COMMAND),
        bounded("recording adds, of a core", 100.0 * statistics.median(added), "%", "<= 2", COMMAND),
        Figure("the least of the differences", 100.0 * min(added), "%", command=COMMAND),
        Figure("the largest of the differences", 100.0 * max(added), "%", command=COMMAND),
    ]

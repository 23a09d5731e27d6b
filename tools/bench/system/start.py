"""From process start to the first published pose with warm caches, and the memory it takes."""

import os
import signal
import socket
import statistics
import sys
import tempfile
import time
from pathlib import Path

from daemon.publish.modbus import registers
from tools.bench.support.children import child, ended
from tools.ci.figures import Figure, bounded

COMMAND = "make bench ARGS=start"
RUNS = 5
SETTLE_S = 5.0


def resident_mb(pid: int) -> float:
    """Resident set of a process in MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return float(line.split()[1]) / 1024.0
    raise RuntimeError(f"no VmRSS for process {pid}")


def started(lidar: Path) -> tuple[float, float]:
    """Seconds from the start of the process to the first datagram with a pose, and MB resident after a while."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as poses:  # of its own: nothing of an earlier run waits in it
        poses.bind(("127.0.0.1", 0))
        return _started(lidar, poses)


def _started(lidar: Path, poses: socket.socket) -> tuple[float, float]:
    receiver = f"127.0.0.1:{poses.getsockname()[1]}"
    settings = [f"lidar.device={lidar}", "modbus.port=0", "map.folder=none", f'pose.receivers=["{receiver}"]']
    command = [sys.executable, "-m", "daemon", "run", *(w for s in settings for w in ("--set", s))]
    begun = time.monotonic()
    with child(*command, mute=True) as daemon:
        poses.settimeout(120.0)
        while registers.decode_datagram(poses.recv(2000))["map_x"] is None:
            pass
        seconds = time.monotonic() - begun
        time.sleep(SETTLE_S)
        resident = resident_mb(daemon.pid)
        daemon.send_signal(signal.SIGTERM)
        ended(daemon, "the daemon")
        return seconds, resident


def run() -> list[Figure]:
    """Medians over several starts; the first, which may compile, is not counted."""
    seconds, memory = [], []
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "lidar"
        fake = [sys.executable, "-m", "hal.fake", "--model", "UTM-30LX", "--pty", str(link)]
        with child(*fake, mute=True):
            while not os.path.lexists(link):
                time.sleep(0.02)
            for attempt in range(RUNS + 1):
                took, resident = started(link)
                if attempt:
                    seconds.append(took)
                    memory.append(resident)
    return [
        bounded("process start to first pose, warm", statistics.median(seconds), "s", "<= 1.5", COMMAND),
        bounded("resident memory, 1081 beams at 40 Hz", statistics.median(memory), "MB", "<= 260", COMMAND),
    ]

"""Scenarios: a computer whose robot stands, and what happens to the process."""

from __future__ import annotations

import time
from typing import Final

from tools.bench.vm.bench import DONE, SAVE_MAP, UNIT, Bench
from tools.bench.vm.common import RIGHT_S, TRACKING_S, begin, come_up, map_id, need, right, scenario, start

READY_S: Final = 60.0
CHANGED: Final = "near = 0.06"


def _signal(bench: Bench, name: str, pid: int) -> None:
    bench.machine.run("sh", "-c", f"kill -{name} {pid}")  # the shell's own: a small Debian has no /bin/kill


def _restarted(bench: Bench, before: int, seconds: float) -> str:
    begun = time.monotonic()
    bench.until("another process", seconds, lambda: bench.main_pid() not in (0, before), every=1.0)
    bench.until("started", READY_S, lambda: bench.read().get("state") not in (None, "STARTING"))  # costs it little
    bench.until("READY", READY_S, lambda: bench.machine.show(UNIT, "ActiveState")["ActiveState"] == "active")
    ready = time.monotonic() - begun
    tracking = bench.placed(TRACKING_S)
    need(map_id(bench) == bench.memory["map"], f"map {map_id(bench):08x}, it was {bench.memory['map']:08x}")
    found = right(bench, bench.collect(RIGHT_S))
    told = f"READY {ready:.1f} s later, TRACKING in the same map {tracking:.1f} s after that"
    return f"{told}, {1e3 * max(found):.0f} mm from the truth"


@scenario("anew")
def comes_up_once_more(bench: Bench) -> str:
    """A third computer: its map begins where it stands."""
    said = come_up(bench)
    seconds = start(bench)
    return f"{said}; READY after {seconds:.1f} s; {1e3 * begin(bench):.0f} mm at most"


@scenario("restarted")
def is_killed(bench: Bench) -> str:
    """Kill -9: it is started again, and what was configured meanwhile holds with that start."""
    need(bench.command(SAVE_MAP, 60.0) == DONE, lambda: bench.log(10))
    before = bench.main_pid()
    bench.configure(f"[lidar.mask]\n{CHANGED}")
    _signal(bench, "KILL", before)
    said = _restarted(bench, before, 20.0)
    told = bench.machine.run("journalctl", "--no-pager", "-o", "cat", f"_PID={bench.main_pid()}", "-b", "-n", "100")
    need(CHANGED in told, told)
    return said


@scenario("restarted")
def hangs_itself(bench: Bench) -> str:
    """The process stands still (SIGSTOP): the watchdog ends it, and it is started again."""
    before = bench.main_pid()
    _signal(bench, "STOP", before)
    said = _restarted(bench, before, 60.0)
    journal = bench.machine.run("journalctl", "-b", "--no-pager", "-u", UNIT)
    need("Watchdog timeout" in journal, lambda: bench.log(20))
    return said

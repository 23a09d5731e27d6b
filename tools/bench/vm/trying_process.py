"""Scenarios: a computer whose robot stands, and a process that does nothing any more."""

from __future__ import annotations

from tools.bench.vm.bench import DONE, SAVE_MAP, UNIT, Bench
from tools.bench.vm.common import begin, come_up, need, restarted, scenario, signal, start


@scenario("anew")
def comes_up_once_more(bench: Bench) -> str:
    """A third computer: its map begins where it stands."""
    said = come_up(bench)
    seconds = start(bench)
    return f"{said}; READY after {seconds:.1f} s; {1e3 * begin(bench):.0f} mm at most"


@scenario("restarted")
def hangs_itself(bench: Bench) -> str:
    """The process stands still (SIGSTOP): the watchdog ends it, and it is started again."""
    need(bench.command(SAVE_MAP, 60.0) == DONE, lambda: bench.log(10))
    before = bench.main_pid()
    signal(bench, "STOP", before)
    said = restarted(bench, before, 60.0)
    journal = bench.machine.run("journalctl", "-b", "--no-pager", "-u", UNIT)
    need("Watchdog timeout" in journal, lambda: bench.log(20))
    return said

"""Scenarios: a computer whose robot stands, a process that does nothing any more, power, and boots."""

import re
import time
from typing import Final

from tools.bench.vm.bench import DONE, PLACED, SAVE_MAP, UNIT, Bench
from tools.bench.vm.common import (
    BUDGET,
    RIGHT_S,
    begin,
    come_up,
    map_id,
    need,
    restarted,
    right,
    scenario,
    signal,
    start,
)

LOADING: Final = 0.6
"""So much of what going down and up took later the daemon has been started, and has not come to look for its place."""


def _up_again(bench: Bench, states: tuple[str, ...], sets_off: bool = False) -> str:
    meanwhile = ""
    boot, begun = bench.machine.wait_until_up(), time.monotonic()
    if sets_off:
        bench.wait(LOADING * boot)
        meanwhile = bench.read(tries=1).get("state") or "not there yet"
        bench.drive()
    bench.placed(240.0, states)
    seconds = time.monotonic() - begun
    need(map_id(bench) == bench.memory["map"], f"map {map_id(bench):08x}, it was {bench.memory['map']:08x}")
    found = right(bench, bench.collect(RIGHT_S))
    state = " or ".join(states)
    set_off = f"set off while the daemon was {meanwhile}, " if meanwhile else ""
    told = f"up {boot:.0f} s later, {set_off}{state} in the same map {seconds:.1f} s after that"
    return f"{told}, {1e3 * max(found):.0f} mm off"


@scenario("anew")
def comes_up_once_more(bench: Bench) -> str:
    """A third computer: its map begins where it stands."""
    said = come_up(bench)
    seconds = start(bench, BUDGET)
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


@scenario("anew")
def loses_its_power(bench: Bench) -> str:
    """The power is cut and comes back, the robot standing: comes up by itself, in the same map."""
    need(bench.command(SAVE_MAP, 60.0) == DONE, lambda: bench.log(10))
    bench.machine.run("sync")
    bench.machine.power_cut()
    return _up_again(bench, PLACED)


@scenario("anew")
def is_rebooted(bench: Bench) -> str:
    """Reboot, the robot setting off meanwhile: comes up by itself, and finds itself in the same map."""
    bench.machine.reboot()
    return _up_again(bench, ("TRACKING",), sets_off=True)


@scenario()
def explains_itself(bench: Bench) -> str:
    """The journal of the boots before is there, with explanations."""
    listed = bench.machine.run("journalctl", "--list-boots", "--no-pager").splitlines()
    boots = [line for line in listed if re.match(r" *-?\d+ ", line)]  # newer ones have a headline
    first = ("-b", "-2", "-n", "100")  # all of it takes minutes here
    text = bench.machine.run("journalctl", "--no-pager", "--catalog", "-u", UNIT, *first, seconds=120)
    need(len(boots) >= 3 and "What can be done" in text, f"{boots}\n{text[-500:]}")
    return f"{len(boots)} boots"

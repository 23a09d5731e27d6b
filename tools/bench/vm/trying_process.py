"""Scenarios: what happens to the process while its robot drives."""

import time
from typing import Final

from tools.bench.vm.bench import DONE, SAVE_MAP, UNIT, Bench
from tools.bench.vm.common import BUDGET, has_photodiode, need, restarted, scenario, signal

CHANGED: Final = "near = 0.06"


@scenario("restarted")
def is_killed(bench: Bench) -> str:
    """Kill -9 while it drives: started again, in the same map; what was configured meanwhile holds."""
    need(bench.command(SAVE_MAP, 60.0) == DONE, lambda: bench.log(10))
    before = bench.main_pid()
    need(has_photodiode(bench), "there is no photodiode that could go with its configuration")
    bench.configure(BUDGET, f"[lidar.mask]\n{CHANGED}")
    signal(bench, "KILL", before)
    said = restarted(bench, before, 20.0)
    told = bench.machine.run("journalctl", "--no-pager", "-o", "cat", f"_PID={bench.main_pid()}", "-b", "-n", "100")
    need(CHANGED in told, told)
    need(not has_photodiode(bench), "a photodiode is there that is not configured any more")
    return said


@scenario("gone")
def is_stopped(bench: Bench) -> str:
    """`systemctl stop` ends it cleanly and saves the map, which is the last that happens to this computer."""
    begun = time.monotonic()
    bench.machine.run("systemctl", "stop", UNIT)
    seconds = time.monotonic() - begun
    seen = bench.machine.show(UNIT, "Result", "ExecMainStatus")
    need(seen == {"Result": "success", "ExecMainStatus": "0"}, lambda: f"{seen}\n{bench.log(20)}")
    told = bench.log(20).rpartition("stopping")[2]
    need("map saved" in told, told)
    return f"stopped in {seconds:.1f} s, the map saved"

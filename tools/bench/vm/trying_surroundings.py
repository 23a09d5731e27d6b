"""Scenarios: what happens around the process, to the clock and to the disk."""

from tools.bench.vm.bench import DONE, REFUSED, SAVE_MAP, Bench
from tools.bench.vm.common import back, need, scenario


@scenario()
def meets_a_clock_step(bench: Bench) -> str:
    """The computer's clock is set back by a day and on again."""
    pid = bench.main_pid()
    for step in ("-100000", "100000"):
        bench.machine.run("sh", "-c", f"date -s @$(( $(date +%s) + {step} ))")
        bench.wait(2.0)
    return back(bench, pid)


@scenario()
def meets_a_full_disk(bench: Bench) -> str:
    """No room for a map: refused and named, the pose goes on; room again: saved."""
    pid = bench.main_pid()
    fill = "fallocate -l $(df --output=avail -B1 / | tail -1) /full || dd if=/dev/zero of=/full bs=1M"
    bench.machine.run("sh", "-c", fill, check=False, seconds=120)
    result = bench.command(SAVE_MAP, 60.0)
    bench.machine.run("rm", "-f", "/full")
    need(result == REFUSED, lambda: f"saving said {result}:\n{bench.log(10)}")
    need(bench.command(SAVE_MAP, 60.0) == DONE, lambda: bench.log(10))
    return f"refused, then done; {back(bench, pid)}"

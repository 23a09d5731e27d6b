"""Scenarios: the lidar goes and comes, on a real serial port."""

import time
from typing import Final

from tools.bench.vm.bench import Bench
from tools.bench.vm.common import back, need, right, same_process, scenario

PLUG: Final = "/sys/bus/usb/devices/usb1/1-0:1.0/usb1-port1/disable"
"""Of the hub that the lidar is plugged into: without power at its port there is nothing there."""


@scenario()
def is_unplugged(bench: Bench) -> str:
    """The USB cable is pulled while it drives: said so at once, carried on wheels, the same process."""
    pid = bench.main_pid()
    begun = time.monotonic()
    bench.machine.run("sh", "-c", f"echo 1 > {PLUG}")
    bench.until("state without laser", 10.0, lambda: bench.read().get("state") in ("NO_LIDAR", "DEGRADED"))
    seconds = time.monotonic() - begun
    bench.fault(101, 104)
    need(bench.machine.run("sh", "-c", "ls /dev/ttyACM*", check=False).startswith("ls:"), "/dev/ttyACM0 is still there")
    same_process(bench, pid)
    found = right(bench, bench.collect(3.0))
    return f"shown after {seconds:.1f} s; {1e3 * max(found):.0f} mm off after 3 s on wheels"


@scenario()
def is_plugged_in_again(bench: Bench) -> str:
    """The cable is put back: TRACKING by itself."""
    pid = bench.main_pid()
    bench.machine.run("sh", "-c", f"echo 0 > {PLUG}")
    return back(bench, pid)


@scenario()
def comes_back_under_another_name(bench: Bench) -> str:
    """Another program holds the old device node, so that the lidar comes back as ttyACM1."""
    pid = bench.main_pid()
    bench.machine.run("sh", "-c", "sleep 1000 < /dev/ttyACM0 > /dev/null 2>&1 & echo $! > /run/holder", check=False)
    bench.machine.run("sh", "-c", f"echo 1 > {PLUG}; sleep 2; echo 0 > {PLUG}")
    bench.until("/dev/ttyACM1", 20.0, lambda: "ttyACM1" in _lidar_node(bench))
    said = back(bench, pid)
    bench.machine.run("sh", "-c", f"kill $(cat /run/holder); echo 1 > {PLUG}; sleep 1", check=False)
    bench.machine.run("sh", "-c", f"echo 0 > {PLUG}")
    return f"found as ttyACM1: {said}; and again as ttyACM0: {back(bench, pid)}"


def _lidar_node(bench: Bench) -> str:
    return bench.machine.run("readlink", "-f", "/dev/lumiloop/lidar", check=False)

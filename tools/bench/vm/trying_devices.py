"""Scenarios: lidar and photodiode come, go and err, on a real serial port and a real bus."""

from __future__ import annotations

import struct
import time
from typing import Final

from tools.bench.vm.bench import PLACED, UNIT, Bench
from tools.bench.vm.common import TRACKING_S, back, errors, need, same_process, scenario
from tools.bench.vm.machine import OUTSIDE

PLUG: Final = "/sys/bus/usb/devices/usb1/1-0:1.0/usb1-port1/disable"
"""Of the hub that the lidar is plugged into: without power at its port there is nothing there."""
PHOTODIODE: Final = '[photodiode]\nbus = "adapter:bench"\nconverter = "mcp3221@0x4d"\n'


# the lidar


@scenario
def is_unplugged(bench: Bench) -> str:
    """The USB cable is pulled while it drives: said so at once, carried on wheels, the same process."""
    bench.memory["pid"] = bench.main_pid()
    begun = time.monotonic()
    bench.machine.run("sh", "-c", f"echo 1 > {PLUG}")
    bench.until("state without laser", 10.0, lambda: bench.read().get("state") in ("NO_LIDAR", "DEGRADED"))
    seconds = time.monotonic() - begun
    bench.fault(101, 104)
    need(bench.machine.run("sh", "-c", "ls /dev/ttyACM*", check=False).startswith("ls:"), "/dev/ttyACM0 is still there")
    same_process(bench, bench.memory["pid"])
    found = errors(bench, bench.collect(3.0))
    return f"shown after {seconds:.1f} s; {1e3 * max(found, default=0.0):.0f} mm off after 3 s on wheels"


@scenario
def is_plugged_in_again(bench: Bench) -> str:
    """The cable is put back: TRACKING by itself."""
    bench.machine.run("sh", "-c", f"echo 0 > {PLUG}")
    return back(bench, bench.memory["pid"])


@scenario
def comes_back_under_another_name(bench: Bench) -> str:
    """Another program holds the old device node, so that the lidar comes back as ttyACM1."""
    bench.machine.run("sh", "-c", "sleep 1000 < /dev/ttyACM0 > /dev/null 2>&1 & echo $! > /run/holder", check=False)
    bench.machine.run("sh", "-c", f"echo 1 > {PLUG}; sleep 2; echo 0 > {PLUG}")
    bench.until("/dev/ttyACM1", 20.0, lambda: "ttyACM1" in _lidar_node(bench))
    said = back(bench, bench.memory["pid"])
    bench.machine.run("sh", "-c", f"kill $(cat /run/holder); echo 1 > {PLUG}; sleep 1", check=False)
    bench.machine.run("sh", "-c", f"echo 0 > {PLUG}")
    return f"found as ttyACM1: {said}; and again as ttyACM0: {back(bench, bench.memory['pid'])}"


def _lidar_node(bench: Bench) -> str:
    return bench.machine.run("readlink", "-f", "/dev/lumiloop/lidar", check=False)


@scenario
def falls_silent(bench: Bench) -> str:
    """The lidar says nothing for six seconds, its cable in place."""
    bench.orders("order silence where=lidar for=6")
    seconds = bench.until("silence shown", 5.0, lambda: bench.read().get("state") in ("NO_LIDAR", "DEGRADED"))
    bench.fault(104, 101)
    return f"shown after {seconds:.1f} s; {back(bench, bench.memory['pid'])}"


@scenario
def is_switched_off(bench: Bench) -> str:
    """The lidar loses its power for four seconds and starts up again."""
    bench.orders("order off where=lidar for=4")
    bench.fault(104, 101)
    return back(bench, bench.memory["pid"])


@scenario
def talks_garbage(bench: Bench) -> str:
    """Every second scan is random bytes for five seconds."""
    bench.orders("order garbage where=lidar on=scans share=0.5 for=5")
    time.sleep(5.0)
    return back(bench, bench.memory["pid"])


# the photodiode


@scenario
def reads_the_converter(bench: Bench) -> str:
    """A photodiode on a real /dev/i2c-N: found by its adapter's name, opened by its group, read in blocks."""
    bench.machine.order(10.0, i2c=bench.there["bus"].replace("127.0.0.1", OUTSIDE))
    nodes = bench.machine.run("sh", "-c", "stat -c '%n %G %a' /dev/i2c-*").strip()
    need("i2c 660" in nodes, nodes)
    bench.configure(PHOTODIODE)
    bench.machine.run("systemctl", "restart", UNIT, seconds=300)
    bench.memory["pid"] = bench.main_pid()
    bench.until("samples", 60.0, lambda: struct.unpack(">H", bench.registers(53, 1))[0] != 0xFFFF)
    time.sleep(3.0)
    there = [code for code in (151, 152, 153, 155, 156, 157) if _present(bench, code)]
    need(not there, f"faults {there}\n{bench.log(20)}")
    bench.placed(TRACKING_S, PLACED)
    return f"{nodes}; links are published"


def _present(bench: Bench, code: int) -> bool:
    came, gone = bench.faults(code)
    return came > gone


def _ordered(bench: Bench, order: str, codes: tuple[int, ...]) -> str:
    """A fault of the converter comes, is named, and goes; the laser goes on."""
    bench.orders(order)
    begun = time.monotonic()
    bench.until(f"one of {codes}", 30.0, lambda: any(_present(bench, code) for code in codes))
    code = next(code for code in codes if bench.faults(code)[0])
    seconds = time.monotonic() - begun
    bench.until(f"{code} over", 40.0, lambda: not any(_present(bench, code) for code in codes))
    same_process(bench, bench.memory["pid"])
    bench.placed(TRACKING_S, PLACED)
    return f"fault {code} after {seconds:.1f} s, over after {time.monotonic() - begun:.1f} s; the laser went on"


@scenario
def is_not_acknowledged(bench: Bench) -> str:
    """The converter acknowledges nothing for eight seconds (ENXIO of the kernel's)."""
    return _ordered(bench, "order off where=adc for=8", (153, 156, 157))


@scenario
def hangs(bench: Bench) -> str:
    """SDA is held low for eight seconds: every transfer times out in the kernel."""
    return _ordered(bench, "order hang where=adc for=8", (155, 156, 157))

"""Scenarios: the photodiode's converter is configured, comes, goes and errs, on a real bus.

The emulated bus gives its answers when its processor comes to it, so the daemon finds it paced wrongly for lamps, and
says so (fault 163): what is tried is the way of the samples and of their faults, not the light.
"""

from __future__ import annotations

import struct
import time
from typing import Final

from tools.bench.vm.bench import PLACED, UNIT, Bench
from tools.bench.vm.common import TRACKING_S, back, map_id, need, same_process, scenario
from tools.bench.vm.machine import OUTSIDE

PHOTODIODE: Final = '[photodiode]\nbus = "adapter:bench"\nconverter = "mcp3221@0x4d"\n'
GONE: Final = (151, 152, 153, 155, 156, 157)
"""Faults that say that there are no samples, and why."""


@scenario
def stops_and_starts(bench: Bench) -> str:
    """`systemctl stop` ends it cleanly; a photodiode is configured; `start` finds the map again."""
    begun = time.monotonic()
    bench.machine.run("systemctl", "stop", UNIT)
    seconds = time.monotonic() - begun
    seen = bench.machine.show(UNIT, "Result", "ExecMainStatus")
    need(seen == {"Result": "success", "ExecMainStatus": "0"}, f"{seen}\n{bench.log(20)}")
    bench.machine.order(10.0, i2c=bench.there["bus"].replace("127.0.0.1", OUTSIDE))
    bench.configure(PHOTODIODE)
    bench.machine.run("systemctl", "start", UNIT, seconds=300)
    said = back(bench, bench.main_pid(), PLACED)
    need(map_id(bench) == bench.memory["map"], f"map {map_id(bench):08x}, it was {bench.memory['map']:08x}")
    return f"stopped in {seconds:.1f} s; {said}"


@scenario
def reads_the_converter(bench: Bench) -> str:
    """A photodiode on a real /dev/i2c-N: found by its adapter's name, opened by its group, read in blocks."""
    nodes = bench.machine.run("sh", "-c", "stat -c '%n %G %a' /dev/i2c-*").strip()
    need("i2c 660" in nodes, nodes)
    bench.until("samples", 60.0, lambda: struct.unpack(">H", bench.registers(53, 1))[0] != 0xFFFF)
    _sound(bench)
    return f"{nodes}; links are published"


def _present(bench: Bench, codes: tuple[int, ...]) -> list[int]:
    """Which of the faults have come and not gone."""
    seen = {code: bench.faults(code) for code in codes}
    return [code for code, (came, gone) in seen.items() if came > gone]


def _sound(bench: Bench) -> None:
    """Wait until samples come and have come for a while."""
    bench.until("samples without a fault", 40.0, lambda: not _present(bench, GONE))
    time.sleep(3.0)
    there = _present(bench, GONE)
    need(not there, f"faults {there}\n{bench.log(20)}")
    bench.placed(TRACKING_S, PLACED)


def _ordered(bench: Bench, order: str, codes: tuple[int, ...]) -> str:
    """A fault of the converter comes, is named by one of the codes, and goes; the laser goes on."""
    _sound(bench)
    pid, begun = bench.main_pid(), time.monotonic()
    bench.orders(order)
    bench.until(f"one of {codes}", 30.0, lambda: _present(bench, codes))
    told, seconds = _present(bench, codes), time.monotonic() - begun
    _sound(bench)
    same_process(bench, pid)
    return f"fault {told} after {seconds:.1f} s, over after {time.monotonic() - begun:.1f} s; the laser went on"


@scenario
def is_not_acknowledged(bench: Bench) -> str:
    """The converter acknowledges nothing for five seconds (ENXIO of the kernel's)."""
    return _ordered(bench, "order off where=adc for=5", (153, 156))


@scenario
def hangs(bench: Bench) -> str:
    """SDA is held low for five seconds: every transfer times out in the kernel."""
    return _ordered(bench, "order hang where=adc for=5", (155, 156))

"""What scenarios share: how they are told apart from other functions, and what several of them ask."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Final

from tools.bench.vm.bench import Bench, Heard
from tools.bench.vm.machine import Order

Scenario = Callable[[Bench], str]
WRITTEN: Final[list[Scenario]] = []
"""All scenarios, module by module in the order of their lines."""
TRACKING_S: Final = 60.0
WORST_M: Final = 0.10


def scenario(function: Scenario) -> Scenario:
    """A decorator: it is one of the list."""
    WRITTEN.append(function)
    return function


def need(holds: object, text: str) -> None:
    """Raise `Order` with the text unless it holds."""
    if not holds:
        raise Order(text)


def errors(bench: Bench, heard: Iterable[Heard]) -> list[float]:
    """Metres from the truth, of those that claim a place."""
    found = [bench.error_m(one) for one in heard]
    return [error for error in found if error is not None]


def map_id(bench: Bench) -> int:
    """Identity of the map frame."""
    return int(struct.unpack(">I", bench.registers(46, 2))[0])


def same_process(bench: Bench, pid: int) -> None:
    """Raise `Order` if it has been started anew."""
    need(bench.main_pid() == pid, f"process {pid} has become {bench.main_pid()}:\n{bench.log(20)}")


def back(bench: Bench, pid: int) -> str:
    """Usable again without a person, the same process, and right."""
    seconds = bench.placed(TRACKING_S)
    same_process(bench, pid)
    found = errors(bench, bench.collect(3.0))
    need(found and max(found) <= WORST_M, f"{max(found, default=9.0):.3f} m from the truth")
    return f"TRACKING after {seconds:.1f} s, {1e3 * max(found):.0f} mm from the truth"

"""What scenarios share: how they are told apart from other functions, and what several of them ask."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Final

from tools.bench.report import Seen
from tools.bench.vm.bench import Bench, Heard
from tools.bench.vm.machine import Order

Scenario = Callable[[Bench], str | Seen]
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


def right(bench: Bench, heard: Iterable[Heard], bound: float = WORST_M) -> list[float]:
    """As :func:`errors`; raises `Order` where one is beyond the bound and three of its own sigma, or there is none."""
    kept = [(error, one.sigma_m) for one in heard if (error := bench.error_m(one)) is not None]
    need(kept, "no pose has come")
    worst = max(kept, key=lambda pair: pair[0] - 3.0 * pair[1])
    need(worst[0] <= bound + 3.0 * worst[1], f"{worst[0]:.3f} m from the truth, sigma said {worst[1]:.3f} m")
    return [error for error, _ in kept]


def map_id(bench: Bench) -> int:
    """Identity of the map frame."""
    return int(struct.unpack(">I", bench.registers(46, 2))[0])


def same_process(bench: Bench, pid: int) -> None:
    """Raise `Order` if it has been started anew."""
    need(bench.main_pid() == pid, f"process {pid} has become {bench.main_pid()}:\n{bench.log(20)}")


def back(bench: Bench, pid: int, states: tuple[str, ...] = ("TRACKING",)) -> str:
    """Usable again without a person, the same process, and right."""
    seconds = bench.placed(TRACKING_S, states)
    same_process(bench, pid)
    found = right(bench, bench.collect(3.0))
    return f"{' or '.join(states)} after {seconds:.1f} s, {1e3 * max(found):.0f} mm from the truth"

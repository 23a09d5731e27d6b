"""Scenarios: the photodiode's converter is configured, comes, goes and errs, on a real bus.

The emulated bus gives its answers when its processor comes to it, so the daemon finds it paced wrongly for lamps, and
blocks late or lost, and says so (faults 156, 157, 163, 165, which come and go with what else the computer has to do):
what is tried is the way of the samples, and of the faults that only the bus can tell, not the light.
"""

import struct
import time
from typing import Final

from tools.bench.vm.bench import PLACED, Bench
from tools.bench.vm.common import TRACKING_S, begin, come_up, need, same_process, scenario, start
from tools.bench.vm.machine import OUTSIDE

PHOTODIODE: Final = '[photodiode]\nbus = "adapter:bench"\nconverter = "mcp3221@0x4d"\n'
NACK, STUCK = 153, 155
ENOUGH: Final = 20
"""Blocks, of 30 samples at the least."""
GONE: Final = (151, 152, NACK, STUCK)
"""Faults that say why there are no samples, whatever the computer has to do besides."""


@scenario("anew")
def comes_up_with_a_photodiode(bench: Bench) -> str:
    """A second computer, with a photodiode configured before the first start, whose converter gets its power later."""
    said = come_up(bench)
    seconds = start(bench, PHOTODIODE)
    worst = begin(bench)
    bench.machine.order(10.0, i2c=bench.there["bus"].replace("127.0.0.1", OUTSIDE))
    bench.drive()
    return f"{said}; READY after {seconds:.1f} s; {1e3 * worst:.0f} mm at most"


@scenario()
def reads_the_converter(bench: Bench) -> str:
    """A photodiode on a real /dev/i2c-N: found by its adapter's name, opened by its group, read in blocks."""
    nodes = bench.machine.run("sh", "-c", "stat -c '%n %G %a' /dev/i2c-*").strip()
    need("i2c 660" in nodes, nodes)
    _sound(bench)
    return f"{nodes}; {_blocks(bench)} blocks"


def _sound(bench: Bench) -> None:
    """Wait until samples come."""
    bench.until(f"none of {GONE}", 40.0, lambda: not bench.present(*GONE), every=1.0)
    before = _blocks(bench)
    bench.until("blocks of samples", 20.0, lambda: (_blocks(bench) - before) % 2**32 >= ENOUGH)
    bench.placed(TRACKING_S, PLACED)


def _blocks(bench: Bench) -> int:
    """Received since the start; it wraps."""
    return int(struct.unpack(">I", bench.registers(218, 2))[0])


def _ordered(bench: Bench, order: str, code: int) -> str:
    """A fault of the converter comes, is named rightly, and goes; the laser goes on."""
    _sound(bench)
    pid, begun = bench.main_pid(), time.monotonic()
    bench.orders(order)
    bench.until(f"fault {code}", 30.0, lambda: bench.present(code), every=0.5)
    seconds = time.monotonic() - begun
    _sound(bench)
    same_process(bench, pid)
    need(bench.journaled(code), f"the journal has no fault {code}")
    return f"fault {code} after {seconds:.1f} s, over after {time.monotonic() - begun:.1f} s; the laser went on"


@scenario()
def is_not_acknowledged(bench: Bench) -> str:
    """The converter acknowledges nothing for five seconds (ENXIO of the kernel's)."""
    return _ordered(bench, "order off where=adc for=5", NACK)


@scenario()
def hangs(bench: Bench) -> str:
    """SDA is held low for five seconds: every transfer times out in the kernel."""
    return _ordered(bench, "order hang where=adc for=5", STUCK)

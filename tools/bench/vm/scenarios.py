"""What is tried: a function that raises where something is not so.

Three emulated computers run side by side: what one waits for leaves a processor to another. A scenario builds on those
before it in the same computer; the first of each brings that computer up.

A scenario's first line is its title in the report; what it returns is what was seen. Times are the emulated computer's:
some twenty times slower than the machine around it, so they are reported and bounded only as far as they must be.
"""

from typing import Final

from tools.bench.vm import (
    trying_computer,
    trying_devices,
    trying_photodiode,
    trying_process,
    trying_surroundings,
    trying_system,
)
from tools.bench.vm.common import WRITTEN, Scenario

PARTS: Final = (
    (trying_system, trying_devices, trying_surroundings),
    (trying_photodiode, trying_process),
    (trying_computer,),
)
SHARES: Final[list[list[Scenario]]] = [
    [one for part in parts for one in WRITTEN if one.__module__ == part.__name__] for parts in PARTS
]
"""Of each computer, in order."""
SCENARIOS: Final[list[Scenario]] = [one for share in SHARES for one in share]
"""All of them."""

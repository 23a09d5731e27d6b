"""What is tried, in this order, each building on the ones before: a function that raises where something is not so.

A scenario's first line is its title in the report; what it returns is what was seen. Times are the emulated computer's:
some twenty times slower than the machine around it, so they are reported and bounded only as far as they must be.
"""

from __future__ import annotations

from tools.bench.vm import trying_devices, trying_photodiode, trying_process, trying_system
from tools.bench.vm.common import WRITTEN, Scenario

PARTS = (trying_system, trying_devices, trying_photodiode, trying_process)
SCENARIOS: list[Scenario] = [one for part in PARTS for one in WRITTEN if one.__module__ == part.__name__]
"""All of them, in order."""

"""The faults that are present: the heartbeat sets them, the cycle and the reports read them."""

from __future__ import annotations

from dataclasses import dataclass

from daemon.health.faults import Fault


@dataclass(slots=True)
class PresentFaults:
    """Faults that are present, gravest first."""

    faults: tuple[Fault, ...] = ()

    def gravest(self) -> int:
        """Number of the gravest one, 0 for none."""
        return int(self.faults[0]) if self.faults else 0

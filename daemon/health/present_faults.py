"""Shared list of present faults: the heartbeat writes it; the cycle and the reports read it."""

from __future__ import annotations

from dataclasses import dataclass

from daemon.health.faults import Fault


@dataclass(slots=True)
class PresentFaults:
    """Present faults, the gravest cause first, each followed by its consequences (`daemon.health.causes`)."""

    faults: tuple[Fault, ...] = ()

    def gravest(self) -> int:
        """Number of the gravest present cause, 0 for none."""
        return int(self.faults[0]) if self.faults else 0

"""Counters of the Modbus server, and the type of its allow-list."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from daemon.system.logging import Sparing
from hal.net.peers import most_of

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 32
STRANGE: Final = "sends what is no Modbus request; it is dropped, and a connection closed"
PER_HOST: Final = most_of(MAX_CONNECTIONS)
"""Connections that one host may have."""
GREEDY: Final = f"is not served: it has {PER_HOST} of the {MAX_CONNECTIONS} connections open and in use, close one"
CROWDED: Final = f"is not served: {MAX_CONNECTIONS} connections are open and in use, close one"
Allowed = Callable[[str], bool]


def everyone(_: str) -> bool:
    """Allow-list that accepts every host."""
    return True


@dataclass(slots=True)
class Counts:
    """Counters of the Modbus server; a client that is not served is logged once a minute."""

    requests: int = 0
    malformed: int = 0
    unsent: int = 0
    connections: int = 0
    refused: int = 0
    dropped: int = 0
    lines: dict[str, Sparing] = field(default_factory=dict)

    def tell(self, peer: str, what: str) -> None:
        """Log what happened to a client, at a limited rate."""
        self.lines.setdefault(what, Sparing(log, 1, 60.0)).say(time.monotonic(), logging.INFO, f"Modbus: {peer} {what}")

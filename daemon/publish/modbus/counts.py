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
STRANGE: Final = "sends data that is not a Modbus request; the daemon ignores it, and closes a TCP connection"
PER_HOST: Final = most_of(MAX_CONNECTIONS)
"""Connections that one host may have."""
GREEDY: Final = f"is rejected, because it uses {PER_HOST} of the {MAX_CONNECTIONS} connections; close one"
CROWDED: Final = f"is rejected, because all {MAX_CONNECTIONS} connections are in use; close one"
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

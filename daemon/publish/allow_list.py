"""Allow-list for remote clients; loopback is always allowed.

Datagrams from any other address are dropped, and connections are closed. The list excludes wrong machines. It does not
protect against an attacker who can forge addresses on the network.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

from daemon.config.endpoints import parse_network
from hal.net.peers import parse_peer

log = logging.getLogger(__name__)

TOLD: Final = 16
"""Largest number of refused hosts that the log names; more would fill it."""
REMEMBERED: Final = 1024


class Access:
    """Callable that decides whether a host is allowed.

    Args:
        networks: allowed ones; empty: everyone. bind: address on which the servers listen, from which this computer
            itself connects.

    Attributes:
        refused: datagrams and connections that were rejected.
    """

    def __init__(self, networks: Sequence[str] = (), bind: str = "") -> None:
        own = [bind] if networks and bind else []
        self._networks = [parse_network(text) for text in (*networks, *own)]
        self._told: set[str] = set()
        self._knows = lru_cache(REMEMBERED)(self._look)
        self.refused = 0

    def __call__(self, host: str) -> bool:
        """Whether this address is allowed."""
        if not self._networks or self._knows(host):
            return True
        self.refused += 1
        if host not in self._told and len(self._told) < TOLD:
            self._told.add(host)
            log.warning("%s gets no reply, because it is not in `allow`", host)
        return False

    def _look(self, host: str) -> bool:
        try:
            address = parse_peer(host)
        except ValueError:
            return False
        return address.is_loopback or any(address in network for network in self._networks)

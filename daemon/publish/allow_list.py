"""Allow-list for remote clients; loopback is always allowed.

What comes from anywhere else is as good as not sent: a datagram is dropped, a connection is closed. This is no
protection against one who can forge addresses on the network; it keeps the wrong machines out, not an attacker.
"""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

from daemon.config.endpoints import parse_network

log = logging.getLogger(__name__)

TOLD: Final = 16
"""Refused hosts that are named in the log; a crowd of them must not fill it."""
REMEMBERED: Final = 1024


class Access:
    """Says of a host whether it may be answered.

    Args:
        networks: allowed ones; empty: everyone. bind: where the servers listen: this computer reaches them from there.

    Attributes:
        refused: datagrams and connections that were turned away.
    """

    def __init__(self, networks: Sequence[str] = (), bind: str = "") -> None:
        own = [bind] if networks and bind else []
        self._networks = [parse_network(text) for text in (*networks, *own)]
        self._told: set[str] = set()
        self._knows = lru_cache(REMEMBERED)(self._look)
        self.refused = 0

    def __call__(self, host: str) -> bool:
        """Whether this address may be answered."""
        if not self._networks or self._knows(host):
            return True
        self.refused += 1
        if host not in self._told and len(self._told) < TOLD:
            self._told.add(host)
            log.warning("%s is not answered: it is not in `allow`", host)
        return False

    def _look(self, host: str) -> bool:
        try:
            address = ipaddress.ip_address(host.partition("%")[0])
        except ValueError:
            return False
        return address.is_loopback or any(address in network for network in self._networks)

"""Hosts behind peer addresses, and their share of the places of a server.

A server has few places, and one host could take them all with many connections. Each host therefore has a part of
them. An IPv6 host has a whole /64 network at its disposal, which counts as one host.
"""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Hashable, Iterable
from functools import lru_cache
from typing import Final

PART: Final = 0.75
"""Part of all places that one host may have."""
_REMEMBERED: Final = 1024
_SUBNET_BITS: Final = 64

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


def parse_peer(host: str) -> Address:
    """Address of a peer, without its interface; an IPv4-mapped one as IPv4.

    Raises:
        ValueError: not an address.
    """
    address = ipaddress.ip_address(host.partition("%")[0])
    mapped = address.ipv4_mapped if address.version == 6 else None
    return mapped or address


@lru_cache(_REMEMBERED)
def host_of(host: str) -> Hashable:
    """Key of the host that a peer address belongs to; any other text is a host of its own."""
    try:
        address = parse_peer(host)
    except ValueError:
        return host
    if address.version == 4 or address.is_link_local or address.is_loopback:
        return address
    return ipaddress.ip_network((address, _SUBNET_BITS), strict=False)


def most_of(places: int) -> int:
    """Largest number of ``places`` that one host may have: :data:`PART` of them, at least one."""
    return max(1, int(PART * places))


def full_for(host: str, present: Iterable[str], places: int) -> bool:
    """Whether a host has its share of the places; ``present``: peer address of each place that is taken."""
    key = host_of(host)
    return sum(host_of(one) == key for one in present) >= most_of(places)


def largest(present: Iterable[str]) -> Hashable:
    """Key of the host with the most places."""
    ((key, _),) = Counter(map(host_of, present)).most_common(1)
    return key

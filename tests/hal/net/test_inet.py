"""Names and addresses: whatever is wrong with one is said as a device that is missing."""

from __future__ import annotations

import asyncio
import socket

import pytest

from hal.errors import DeviceMissing
from hal.net import inet


@pytest.mark.parametrize("name", ["robot..local", ".local", f"{64 * 'a'}.local"])
def test_what_cannot_be_a_name_is_missing(name: str) -> None:
    assert inet.numeric(name, 5000) == []
    with pytest.raises(DeviceMissing, match=r"not a host name .*63 characters"):
        asyncio.run(inet.resolve(name, 5000))


def test_an_interface_that_is_not_there_is_told_where_they_cannot_be_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without netlink sockets, which the service manager may forbid."""

    def forbidden() -> None:
        raise OSError(97, "Address family not supported by protocol")

    monkeypatch.setattr(socket, "if_nameindex", forbidden)
    with pytest.raises(DeviceMissing, match=r"no network interface wlan77 .*ip link"):
        asyncio.run(inet.resolve("fe80::1%wlan77", 5000))

"""Addresses, and the share that each of them has."""

import asyncio
import socket

import pytest

from hal.errors import DeviceMissing
from hal.net import inet
from hal.net.fair_share import PART, SLICE_S, Reader, Share


class Watch:
    """A stopwatch that is told the time."""

    def __init__(self) -> None:
        self.t = 100.0

    def __call__(self) -> float:
        return self.t


def test_a_slice_is_used_up_and_comes_again() -> None:
    watch = Watch()
    share = Share(watch)
    used = 0
    while share.begin():
        watch.t += 0.001
        share.end()
        used += 1
    assert used == round(PART * SLICE_S / 0.001)
    assert abs(share.left_s() - (1.0 - PART) * SLICE_S) < 1e-9
    assert (share.begin(), share.held) == (False, 2)
    watch.t += share.left_s() + 1e-6
    assert share.begin()
    assert share.left_s() > 0.9 * SLICE_S


def test_one_long_call_does_not_borrow_from_the_slices_to_come() -> None:
    watch = Watch()
    share = Share(watch)
    assert share.begin()
    watch.t += 7.3 * SLICE_S
    share.end()
    assert share.left_s() == 0.0
    assert share.begin()


def test_a_clock_that_steps_back_holds_nobody_for_ever() -> None:
    watch = Watch()
    share = Share(watch)
    assert share.begin()
    watch.t += SLICE_S * PART
    share.end()
    watch.t -= 50.0
    assert share.begin()


async def test_a_flood_waits_for_the_next_slice_and_is_served_then() -> None:
    served = 0
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    watch = Watch()
    share = Share(watch)

    def serve() -> None:
        nonlocal served
        served += len(ours.recv(1))
        watch.t += 0.6 * PART * SLICE_S

    reader = Reader(ours.fileno(), serve, share)
    for _ in range(6):
        theirs.send(b"x")
    await asyncio.sleep(0.005)
    first = served
    for _ in range(200):
        watch.t += 0.1 * SLICE_S
        await asyncio.sleep(0.001)
    reader.close()
    reader.close()
    theirs.send(b"y")
    await asyncio.sleep(0.02)
    ours.close()
    theirs.close()
    assert (first, served) == (2, 6)


async def test_closing_while_waiting_ends_it() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    watch = Watch()
    share = Share(watch)

    def serve() -> None:
        watch.t += SLICE_S * PART
        ours.recv(1)

    reader = Reader(ours.fileno(), serve, share)
    for _ in range(3):
        theirs.send(b"x")
    await asyncio.sleep(0.002)
    assert share.held >= 1
    reader.close()
    await asyncio.sleep(2 * SLICE_S)
    ours.close()
    theirs.close()


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

"""Pose datagrams: to every receiver, never waiting, whatever the network says."""

import asyncio
import contextlib
import errno
import logging
import socket
import sys
from typing import Any

import pytest

from daemon.config import endpoints
from daemon.publish import udp_sender
from daemon.publish.modbus import registers
from daemon.publish.udp_sender import PoseSender
from hal.clock import run_virtual
from hal.errors import DeviceMissing
from hal.net import inet
from hal.net.interfaces import interface_of
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import until


def listener(family: socket.AddressFamily = socket.AF_INET, host: str = "127.0.0.1") -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.bind((host, 0))
    sock.settimeout(5.0)
    return sock


async def sent_to(receivers: list[str], times: int = 1) -> PoseSender:
    sender = PoseSender(receivers)
    await sender.start()
    for number in range(times):
        sender.publish(snapshot(seq=number))
    await sender.close()
    return sender


def test_every_receiver_gets_every_snapshot() -> None:
    with listener() as first, listener() as second:
        ports = [sock.getsockname()[1] for sock in (first, second)]
        sender = asyncio.run(sent_to([f"127.0.0.1:{port}" for port in ports], times=3))
        for sock in (first, second):
            assert [registers.decode_datagram(sock.recv(512))["seq"] for _ in range(3)] == [0, 1, 2]
        assert [(r.sent, r.dropped) for r in sender.receivers] == [(3, 0), (3, 0)]


def test_names_are_looked_up_beside_the_loop() -> None:
    async def run(port: int) -> PoseSender:
        sender = PoseSender([f"localhost:{port}"])
        await sender.start()
        sender.publish(snapshot())
        await until(lambda: sender.receivers[0].address is not None)
        sender.publish(snapshot())
        await sender.close()
        return sender

    with listener() as sock:
        (receiver,) = asyncio.run(run(sock.getsockname()[1])).receivers
        assert (receiver.sent, receiver.dropped) == (1, 1), "before the name is known, datagrams are dropped"
        if receiver.address is not None and receiver.address[0] == socket.AF_INET:
            assert registers.decode_datagram(sock.recv(512))["map_x"] == 1.2345


def test_an_unknown_name_is_tried_again_and_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The network comes up after the daemon, then the name moves to another address."""
    tries: list[float] = []

    async def resolve(host: str, port: int) -> list[inet.Address]:
        tries.append(asyncio.get_running_loop().time())
        if len(tries) < 4:
            raise DeviceMissing(f"{host}:{port}", "host name not known")
        return [(socket.AF_INET, (f"127.0.0.{len(tries)}", port))]

    monkeypatch.setattr(inet, "resolve", resolve)

    async def run() -> None:
        sender = PoseSender(["plc.local:9"])
        (receiver,) = sender.receivers
        await sender.start()
        await asyncio.sleep(2.5 * udp_sender.RETRY_S)
        sender.publish(snapshot())
        assert (receiver.sent, receiver.dropped, len(tries)) == (0, 1, 3)
        await asyncio.sleep(udp_sender.RETRY_S)
        sender.publish(snapshot())
        assert receiver.sent == 1
        await asyncio.sleep(udp_sender.REFRESH_S)
        assert receiver.address == (socket.AF_INET, ("127.0.0.5", 9))
        await sender.close()

    with caplog.at_level(logging.INFO, logger="daemon.publish.udp_sender"):
        run_virtual(run())
    assert [r.levelname for r in caplog.records] == ["INFO", "INFO"]
    assert "plc.local:9: host name not known" in caplog.text


@pytest.mark.virtual
async def test_a_look_up_that_fails_in_another_way_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tries: list[float] = []

    async def resolve(host: str, port: int) -> list[inet.Address]:
        tries.append(asyncio.get_running_loop().time())
        if len(tries) == 1:
            raise RuntimeError("can't start new thread")
        return [(socket.AF_INET, ("127.0.0.1", port))]

    monkeypatch.setattr(inet, "resolve", resolve)
    sender = PoseSender(["plc.local:9"])
    await sender.start()
    await asyncio.sleep(1.5 * udp_sender.RETRY_S)
    assert sender.receivers[0].address == (socket.AF_INET, ("127.0.0.1", 9))
    await sender.close()
    assert "can't start new thread" in caplog.text


class Failing:
    """A socket whose sends fail as ordered."""

    def __init__(self, errors: list[OSError | None]) -> None:
        self._errors = errors

    def sendto(self, data: bytes, address: Any) -> int:
        if error := self._errors.pop(0):
            raise error
        return len(data)

    def close(self) -> None:
        pass


def test_what_the_kernel_does_not_take_is_dropped_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    gone = OSError(errno.ENETUNREACH, "Network is unreachable")
    failing: list[bool] = []
    errors: list[OSError | None] = [None, BlockingIOError(errno.EAGAIN, "again"), gone, gone, None, gone]

    async def run() -> PoseSender:
        sender = PoseSender(["192.0.2.1:15020"])
        await sender.start()
        sender._sockets[socket.AF_INET, ""] = Failing(errors)  # type: ignore[assignment]  # all that is asked of a socket
        for _ in range(6):
            sender.publish(snapshot())
            failing.append(sender.failing)
        await sender.close()
        return sender

    with caplog.at_level(logging.INFO, logger="daemon.publish.udp_sender"):
        (receiver,) = asyncio.run(run()).receivers
    assert (receiver.sent, receiver.dropped) == (2, 4)
    assert failing == [False, False, True, True, False, True]
    assert [r.levelname for r in caplog.records] == ["INFO"] * 3, "the warning is the fault's"
    assert "192.0.2.1:15020: Network is unreachable" in caplog.text


def test_a_receiver_that_never_reads_does_not_block() -> None:
    """Its receive queue overflows in the kernel; sending goes on."""
    with listener() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        sender = asyncio.run(sent_to([f"127.0.0.1:{sock.getsockname()[1]}"], times=2000))
        assert sender.receivers[0].sent + sender.receivers[0].dropped == 2000


@pytest.mark.parametrize(
    "text",
    [
        *("", "plc", "plc:", ":15020", "plc:0", "plc:65536", "plc:x", "fe80::1:15020", "plc:¹"),
        *("robot..local:5000", ".local:5000", "..:5000", f"{64 * 'a'}.local:5000"),
    ],
)
def test_what_is_not_a_receiver_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="Expected"):
        PoseSender([text])


@pytest.mark.parametrize("text", [f"{63 * 'a'}.local.:5000", "plc:15020"])
def test_a_name_that_can_be_one_is_taken(text: str) -> None:
    assert PoseSender([text]).receivers[0].name == text


def test_nobody_to_send_to_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(_: object) -> bytes:
        raise AssertionError("a datagram was encoded for nobody")

    monkeypatch.setattr(registers, "encode_datagram", never)
    asyncio.run(sent_to([]))


@pytest.mark.skipif(not socket.has_ipv6, reason="this computer has no IPv6")
def test_ipv6() -> None:
    try:
        sock = listener(socket.AF_INET6, "::1")
    except OSError:
        pytest.skip("this computer has no IPv6 loopback address")
    with sock:
        asyncio.run(sent_to([f"[::1]:{sock.getsockname()[1]}", f"[::1%lo]:{sock.getsockname()[1]}"]))
        for _ in range(2):
            assert registers.decode_datagram(sock.recv(512))["seq"] == 0


LOOPBACK = socket.if_nametoindex("lo")


@pytest.mark.skipif(not socket.has_ipv6, reason="this computer has no IPv6")
async def test_a_group_of_a_named_network_interface_is_sent_to_by_that() -> None:
    """The loopback interface has no groups: it is asked for what the kernel would use."""
    sender = PoseSender(["[ff15::42%lo]:5000", f"[fe80::1%{LOOPBACK}]:5000", "[ff15::42]:5000"])
    await sender.start()
    addresses = [receiver.address for receiver in sender.receivers]
    assert addresses == [
        (socket.AF_INET6, ("ff15::42", 5000, 0, LOOPBACK)),
        (socket.AF_INET6, ("fe80::1", 5000, 0, LOOPBACK)),
        (socket.AF_INET6, ("ff15::42", 5000)),
    ]
    for interface in (LOOPBACK, ""):
        with sender._open(socket.AF_INET6, interface) as sock:
            assert sock.getsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF) == (interface or 0)
    await sender.close()


def own_addresses() -> list[str]:
    """Addresses of this computer's first interface but loopback that can have groups."""
    found = []
    for family, far in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        with socket.socket(family, socket.SOCK_DGRAM) as sock, contextlib.suppress(OSError):
            sock.connect((far, 9))
            found.append(str(sock.getsockname()[0]))
    return found


def heard(group: str, bind: str, interface: int) -> bytes:
    """What a member of the group on one interface receives of a snapshot that is sent with this `bind`."""
    v4 = ":" not in group
    with socket.socket(socket.AF_INET if v4 else socket.AF_INET6, socket.SOCK_DGRAM) as sock:
        sock.bind((group, 0))
        if v4:
            member = socket.inet_aton(group) + bytes(4) + interface.to_bytes(4, sys.byteorder)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        else:
            member = socket.inet_pton(socket.AF_INET6, group) + interface.to_bytes(4, sys.byteorder)
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, member)
        sock.settimeout(0.3)
        port = sock.getsockname()[1]

        async def send() -> None:
            sender = PoseSender([f"{group}:{port}" if v4 else f"[{group}]:{port}"], endpoints.interface_of(bind))
            await sender.start()
            sender.publish(snapshot(seq=7))
            await sender.close()

        asyncio.run(send())
        with contextlib.suppress(TimeoutError):
            return sock.recv(512)
        return b""


@pytest.mark.parametrize("group", ["239.255.0.7", "ff15::42"])
def test_a_group_is_sent_to_by_the_interface_whose_address_bind_is(group: str) -> None:
    addresses = own_addresses()
    if not addresses or (":" in group and not any(":" in one for one in addresses)):
        pytest.skip("this computer has no network beside loopback")
    for bind in addresses:
        index = interface_of(bind)
        assert index != LOOPBACK
        assert registers.decode_datagram(heard(group, bind, index))["seq"] == 7
        if ":" not in group:
            assert not heard(group, bind, LOOPBACK)


def test_a_group_stays_on_this_computer_with_the_loopback_address_as_bind() -> None:
    assert registers.decode_datagram(heard("239.255.0.7", "127.0.0.1", LOOPBACK))["seq"] == 7
    for bind in own_addresses():
        assert not heard("239.255.0.7", "127.0.0.1", interface_of(bind))


@pytest.mark.parametrize("bind", ["0.0.0.0", "::"])
def test_with_all_addresses_the_route_names_the_interface(bind: str) -> None:
    assert endpoints.interface_of(bind) == ""


def test_an_address_that_this_computer_does_not_have_is_an_error() -> None:
    for address in ("203.0.113.9", "2001:db8::9"):
        with pytest.raises(OSError, match="assign"):
            interface_of(address)
    assert interface_of("127.0.0.1") == interface_of("127.8.0.1") == interface_of("::1") == LOOPBACK


async def test_an_interface_that_comes_back_with_another_number_is_found_again() -> None:
    sender = PoseSender(["239.255.0.7:5600"], "127.0.0.1")
    await sender.start()
    sender.publish(snapshot(seq=7))
    (broken,) = sender._sockets.values()
    broken.close()
    sender.publish(snapshot(seq=8))
    sender.publish(snapshot(seq=8))
    assert (sender.receivers[0].sent, sender.receivers[0].dropped, sender.failing) == (2, 1, False)
    await sender.close()


async def test_an_interface_that_is_not_there_is_named_with_those_that_are(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with pytest.raises(DeviceMissing, match=r"no network interface eth77 on this computer \(name an existing one.*lo"):
        await inet.resolve("ff15::42%eth77", 5000)
    sender = PoseSender(["[ff15::42%eth77]:5000"])
    await sender.start()
    await asyncio.sleep(0.01)
    await sender.close()
    assert "pose receiver [ff15::42%eth77]:5000: no network interface eth77" in caplog.text

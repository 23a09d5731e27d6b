"""Pose datagrams by subscription: the bytes, the leases, the cookie, and real sockets."""

import asyncio
import logging
import socket
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import registers
from daemon.publish.udp_sender import PoseSender
from daemon.publish.udp_subscriptions import (
    COOKIE_S,
    LONGEST_LEASE_S,
    SIZE,
    SUBSCRIBERS,
    Leases,
    Message,
    Status,
    Subscriptions,
    decode,
    encode,
)
from hal.errors import DeviceMissing, DeviceRefused
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import until

PEER = ("192.0.2.7", 4000)


def ask(leases: Leases, now: float, lease: int = 10, peer: object = PEER, cookie: int = 0) -> Message:
    answer = leases.answer((peer, ()), Message(Status.ASK, lease, cookie), now)
    assert answer is not None
    return answer


def subscribe(leases: Leases, now: float, lease: int = 10, peer: object = PEER) -> Message:
    """As a client does it: ask, and ask again with the cookie."""
    cookie = ask(leases, now, lease, peer)
    assert (cookie.status, cookie.lease) == (Status.COOKIE, 0)
    return ask(leases, now, lease, peer, cookie.cookie)


def test_the_bytes_by_hand() -> None:
    data = encode(Message(Status.ASK, 30, 0x0102030405060708))
    assert data[:20] == b"LUSB\x01\x00\x18\x00\x00\x00\x1e\x00\x08\x07\x06\x05\x04\x03\x02\x01"
    assert data[20:] == struct.pack("<I", zlib.crc32(data[:20]))
    assert len(data) == SIZE == 24
    assert decode(data) == Message(Status.ASK, 30, 0x0102030405060708)


@given(st.binary(max_size=40), st.integers(0, 23), st.integers(1, 255))
def test_what_is_damaged_is_refused(data: bytes, at: int, flip: int) -> None:
    good = encode(Message(Status.ASK, 30, 7))
    for bad in (data, good[:at] + bytes([good[at] ^ flip]) + good[at + 1 :], good[:at], good + data[:1] + b"x"):
        with pytest.raises(ValueError, match="subscription"):
            decode(bad)


def test_other_versions_and_statuses_are_refused() -> None:
    for body in (b"LUSB\x02\x00\x18\x00" + bytes(12), b"LUSB\x01\x00\x19\x00" + bytes(12), b"LUOD" + bytes(16)):
        with pytest.raises(ValueError, match="of this version"):
            decode(body + struct.pack("<I", zlib.crc32(body)))
    body = struct.pack("<4sHHHHQ", b"LUSB", 1, 24, 99, 0, 0)
    with pytest.raises(ValueError, match="99"):
        decode(body + struct.pack("<I", zlib.crc32(body)))


def test_a_lease_is_granted_renewed_ended_and_runs_out() -> None:
    leases = Leases()
    granted = subscribe(leases, 0.0)
    assert (granted.status, granted.lease) == (Status.GRANTED, 10)
    assert leases.peers(9.9) == [(PEER, ())]
    assert ask(leases, 9.9, 10, PEER, granted.cookie).status is Status.GRANTED
    assert leases.peers(19.8) == [(PEER, ())]
    assert leases.peers(19.9) == []
    assert subscribe(leases, 30.0, lease=65_535).lease == LONGEST_LEASE_S
    assert ask(leases, 31.0, 0, PEER, granted.cookie).status is Status.ENDED
    assert leases.peers(31.0) == []


def test_nobody_subscribes_another() -> None:
    """A forged sender never sees the cookie, one of another address does not fit, an old one is not good for ever."""
    leases = Leases()
    for guess in range(100):
        assert ask(leases, 0.0, cookie=guess).status is Status.COOKIE
    other = ask(leases, 0.0, peer=("192.0.2.8", 4000)).cookie
    assert ask(leases, 0.0, cookie=other).status is Status.COOKIE
    mine = ask(leases, 0.0).cookie
    assert ask(leases, 1.9 * COOKIE_S, cookie=mine).status is Status.GRANTED
    assert ask(leases, 2.1 * COOKIE_S, cookie=mine).status is Status.COOKIE
    assert ask(Leases(), 0.0, cookie=mine).status is Status.COOKIE, "another daemon has another key"
    assert ask(leases, 2.1 * COOKIE_S, 0, cookie=mine).status is Status.COOKIE, "nor does anybody end another's"


def test_the_answer_to_a_stranger_is_no_larger_than_the_question() -> None:
    assert len(encode(ask(Leases(), 0.0))) <= len(encode(Message(Status.ASK, 60, 0)))


def test_answers_are_not_answered() -> None:
    for status in set(Status) - {Status.ASK}:
        assert Leases().answer((PEER, ()), Message(status, 10, 0), 0.0) is None


def test_a_full_house_refuses_until_a_lease_runs_out() -> None:
    leases = Leases()
    for number in range(SUBSCRIBERS):
        assert subscribe(leases, 0.0, peer=(f"192.0.2.{9 + number % 2}", number)).status is Status.GRANTED
    assert subscribe(leases, 1.0).status is Status.FULL
    assert subscribe(leases, 1.0, peer=("192.0.2.10", 3)).status is Status.GRANTED, "those inside may stay"
    assert (leases.refused, len(leases)) == (1, SUBSCRIBERS)
    assert subscribe(leases, 10.5).status is Status.GRANTED


@pytest.mark.parametrize("host", ["192.0.2.9", "2001:db8::%d"])
def test_one_host_never_has_all_places(host: str) -> None:
    """An IPv6 host has as many addresses as it likes in its network."""
    leases = Leases()
    asked = [subscribe(leases, 0.0, peer=(host.replace("%d", f"{n + 1:x}"), n)).status for n in range(SUBSCRIBERS)]
    assert asked == [Status.GRANTED] * 12 + [Status.FULL] * 4
    assert subscribe(leases, 0.0).status is Status.GRANTED
    assert subscribe(leases, 0.0, peer=("2001:db8:0:1::1", 7)).status is Status.GRANTED


class Client:
    """A subscriber made of a socket and `struct`."""

    def __init__(self, server: tuple[str, int] | None = None) -> None:
        """``server``: takes datagrams from nowhere else."""
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.bind(("127.0.0.1", 0))
        self.sock.setblocking(False)
        if server is not None:
            self.sock.connect(server)

    async def get(self) -> bytes:
        async with asyncio.timeout(5.0):
            return await asyncio.get_running_loop().sock_recv(self.sock, 512)

    async def subscribe(self, port: int, lease: int, host: str = "127.0.0.1") -> Message:
        cookie = 0
        for _ in range(2):
            self.sock.sendto(encode(Message(Status.ASK, lease, cookie)), (host, port))
            answer = decode(await self.get())
            cookie = answer.cookie
        return answer


async def test_a_subscriber_gets_what_receivers_get() -> None:
    server, client = Subscriptions("127.0.0.1", 0, lambda _: True), Client()
    await server.start()
    sender = PoseSender([], "", server)
    await sender.start()
    sender.publish(snapshot(seq=1))
    assert (await client.subscribe(server.port, 30)).status is Status.GRANTED
    for number in (2, 3):
        sender.publish(snapshot(seq=number))
        data = await client.get()
        assert registers.decode_datagram(data)["seq"] == number
    assert (await client.subscribe(server.port, 0)).status is Status.ENDED
    sender.publish(snapshot(seq=4))
    assert server.sent == 2 + 4
    client.sock.sendto(b"rubbish", ("127.0.0.1", server.port))
    await until(lambda: server.malformed == 1)
    await sender.close()
    await server.close()
    server.send(b"nobody")
    client.sock.close()


async def test_who_has_subscribed_at_one_of_many_addresses_gets_all_from_there() -> None:
    server = Subscriptions("0.0.0.0", 0, lambda _: True)
    await server.start()
    clients = [(Client((host, server.port)), host) for host in ("127.0.0.1", "127.0.0.2")]
    for client, host in clients:
        assert (await client.subscribe(server.port, 30, host)).status is Status.GRANTED
    server.send(b"pose")
    for client, _ in clients:
        assert await client.get() == b"pose"
        client.sock.close()
    await server.close()


async def test_a_stranger_gets_no_answer_and_a_gone_network_is_counted() -> None:
    class Gone:
        def sendto(self, data: bytes, peer: object) -> int:
            raise OSError(101, "Network is unreachable")

    asked: list[str] = []
    server, client = Subscriptions("127.0.0.1", 0, lambda host: bool(asked.append(host))), Client()
    await server.start()
    client.sock.sendto(encode(Message(Status.ASK, 10, 0)), ("127.0.0.1", server.port))
    await until(lambda: bool(asked))
    assert (server.sent, server.malformed, len(server.leases)) == (0, 0, 0)
    subscribe(server.leases, asyncio.get_running_loop().time(), peer=(PEER, ()))
    real, server._sock = server._sock, Gone()  # type: ignore[assignment]  # all that is asked of a socket
    server.send(b"data")
    assert server.dropped == 1
    server._sock = real
    await server.close()
    client.sock.close()


@pytest.mark.virtual
async def test_a_lease_runs_out_without_a_word() -> None:
    server = Subscriptions("127.0.0.1", 0, lambda _: True)
    await server.start()
    subscribe(server.leases, asyncio.get_running_loop().time(), lease=5, peer=("127.0.0.1", 9))
    for _ in range(60):
        server.send(b"data")
        await asyncio.sleep(0.1)
    assert server.sent + server.dropped in (50, 51)
    await server.close()


def test_a_port_that_cannot_be_had_names_the_key() -> None:
    async def run(bind: str, port: int) -> None:
        await Subscriptions(bind, port, lambda _: True).start()

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(DeviceRefused, match=r"in use.*pose\.receivers"):
            asyncio.run(run("127.0.0.1", taken.getsockname()[1]))
    with pytest.raises(DeviceMissing, match="does not have that address"):
        asyncio.run(run("192.0.2.1", 5000))


async def test_a_group_gets_datagrams_once_for_all() -> None:
    """Multicast over the loopback interface: two listeners, one datagram sent."""
    group = "239.255.76.77"
    listeners = []
    for _ in range(2):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((group, listeners[0].getsockname()[1] if listeners else 0))
        membership = socket.inet_aton(group) + socket.inet_aton("127.0.0.1")
        try:
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            sock.close()
            pytest.skip(f"this computer has no multicast on loopback: {error}")
        sock.settimeout(5.0)
        listeners.append(sock)
    sender = PoseSender([f"{group}:{listeners[0].getsockname()[1]}"], "127.0.0.1")
    await sender.start()
    sender.publish(snapshot(seq=5))
    await sender.close()
    (receiver,) = sender.receivers
    assert (receiver.sent, receiver.dropped) == (1, 0)
    for sock in listeners:
        assert registers.decode_datagram(sock.recv(512))["seq"] == 5
        sock.close()


async def test_an_interface_that_has_gone_is_said(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)  # the fault that follows from it is the warning
    sender = PoseSender(["239.255.76.77:5000"], "192.0.2.1")
    await sender.start()
    sender.publish(snapshot())
    await sender.close()
    (receiver,) = sender.receivers
    assert receiver.dropped == 1
    assert "239.255.76.77:5000: Cannot assign requested address" in caplog.text


class _Fickle:
    """A socket of one who subscribes and ends it, again and again."""

    def __init__(self, times: int) -> None:
        self._left = 2 * times
        self._cookie = 0

    def recvmsg(self, *_: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, tuple[str, int]]:
        if not self._left:
            raise BlockingIOError
        self._left -= 1
        return encode(Message(Status.ASK, 10 * (self._left % 2), self._cookie)), [], 0, PEER

    def sendto(self, data: bytes, _: object) -> None:
        self._cookie = decode(data).cookie


@pytest.mark.virtual
async def test_one_who_comes_and_goes_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    subscriptions, sock = Subscriptions("127.0.0.1", 0, lambda _: True), _Fickle(100)
    await asyncio.sleep(1.0)
    while sock._left:
        subscriptions._serve(sock)  # type: ignore[arg-type]  # all that is asked of a socket
    assert [record.message for record in caplog.records] == [
        "pose datagrams: 1 subscribers, latest request from 192.0.2.7:4000"
    ]

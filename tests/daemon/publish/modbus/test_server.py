"""The Modbus server: its start, its clients over UDP and TCP."""

import asyncio
import errno
import os
import socket
import struct
import time
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
from pymodbus.client import AsyncModbusTcpClient, AsyncModbusUdpClient

from daemon.publish.modbus import counts, registers, tcp_endpoint
from daemon.publish.modbus.holding import Outcome, Request
from daemon.publish.modbus.server import ModbusPublisher
from hal.clock import SystemClock
from hal.errors import DeviceMissing, DeviceRefused
from hal.net import inet
from hal.net.reply_address import reply_source
from hal.odometry import RawOdometry
from tests.daemon.publish.network import (
    BLOCK,
    closed,
    publishing,
    read_answer,
    request,
    taken_port,
    tcp_client,
    udp_client,
    until,
)

Client = AsyncModbusTcpClient | AsyncModbusUdpClient


CLIENTS = [AsyncModbusTcpClient, AsyncModbusUdpClient]


def with_client(
    kind: type[Client], body: Callable[[Client, ModbusPublisher], Coroutine[Any, Any, None]], **options: Any
) -> None:
    """Run a test body against a publisher with a pymodbus client."""

    async def run() -> None:
        async with publishing(**options) as publisher:
            client = kind("127.0.0.1", port=publisher.port)
            assert await client.connect()
            try:
                await body(client, publisher)
            finally:
                client.close()

    asyncio.run(run())


def as_bytes(words: list[int]) -> bytes:
    return b"".join(word.to_bytes(2, "big") for word in words)


@pytest.mark.parametrize("kind", CLIENTS)
def test_pymodbus_reads_block_and_mirror(kind: type[Client]) -> None:
    async def body(client: Client, publisher: ModbusPublisher) -> None:
        for read in (client.read_input_registers, client.read_holding_registers):
            block = await read(0, count=registers.BLOCK_WORDS, device_id=9)
            assert registers.decode_block(as_bytes(block.registers))["map_x"] == 1.2345
        mirror = await client.read_input_registers(registers.MIRROR_ADDRESS, count=registers.MIRROR_WORDS)
        assert registers.decode_mirror(as_bytes(mirror.registers))["map_x"] == pytest.approx(1.2345)
        assert client.convert_from_registers(mirror.registers[4:6], client.DATATYPE.FLOAT32) == pytest.approx(1.2345)
        part = await client.read_input_registers(18, count=2)
        assert client.convert_from_registers(part.registers, client.DATATYPE.INT32) == 12_345

    with_client(kind, body)


@pytest.mark.parametrize("kind", CLIENTS)
def test_pymodbus_sees_correct_exceptions(kind: type[Client]) -> None:
    async def body(client: Client, publisher: ModbusPublisher) -> None:
        for answer, function, code in (
            (await client.read_input_registers(60, count=5), 4, 2),
            (await client.read_coils(0, count=1), 1, 1),
            (await client.write_register(0, 1), 6, 1),
            (await client.write_registers(1000, [1, 1]), 16, 1),
        ):
            assert answer.isError()
            assert (answer.function_code, answer.exception_code) == (function | 0x80, code)

    with_client(kind, body)


@pytest.mark.parametrize("kind", CLIENTS)
def test_pymodbus_commands_and_writes_odometry(kind: type[Client]) -> None:
    commands: list[Request] = []
    readings: list[RawOdometry] = []

    async def body(client: Client, publisher: ModbusPublisher) -> None:
        await client.write_registers(1000, [1, 1, 0, 10_000, 0, 20_000, 0, 0])
        assert [(c.number, c.pose) for c in commands] == [(1, (1.0, 2.0, 0.0))]
        publisher.acknowledge(1, Outcome.DONE)
        assert (await client.read_holding_registers(1008, count=2)).registers == [1, Outcome.DONE]
        before = SystemClock().now()
        for number, x in ((1, 10_000), (2, 11_000), (0, 0), (1, 1_000)):
            await client.write_registers(1100, [number, 100, 0, x, 0, 0, 0, 0])
        assert [round(r.x, 6) for r in readings] == [1.0, 1.1, 1.1, 1.2], "a restarted odometry goes on without a jump"
        assert all(before <= r.t_rx <= SystemClock().now() for r in readings)
        assert all(r.t_rx - r.t_mono == pytest.approx(0.01) for r in readings)

    with_client(kind, body, write=True, on_command=commands.append, on_odometry=readings.append)


async def test_eight_udp_clients_back_to_back() -> None:
    async def client(port: int, number: int, rounds: int) -> None:
        async with udp_client(port) as (transport, datagrams):
            for index in range(rounds):
                transport.sendto(request(number << 12 | index, *BLOCK))
                await datagrams.wait_for(index + 1)
            await asyncio.sleep(0.02)  # a second answer to one request would come now
            assert [a[:2] for a in datagrams.answers] == [(number << 12 | i).to_bytes(2, "big") for i in range(rounds)]

    async with publishing() as publisher:
        await asyncio.gather(*(client(publisher.port, number, 200) for number in range(8)))
        assert publisher.counts.requests == 8 * 200


async def test_a_burst_of_datagrams_from_eight_clients() -> None:
    """Requests that lie in the socket's queue together: the case in which a shared peer address loses answers."""
    async with publishing() as publisher:
        socks = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(8)]
        for number, sock in enumerate(socks):
            sock.setblocking(False)
            sock.connect(("127.0.0.1", publisher.port))
            for index in range(20):
                sock.send(request(number * 20 + index, *BLOCK))
        await asyncio.sleep(0.3)
        for number, sock in enumerate(socks):
            answers = [sock.recv(512) for _ in range(20)]
            assert [int.from_bytes(a[:2], "big") for a in answers] == list(range(number * 20, number * 20 + 20))
            with pytest.raises(BlockingIOError):
                sock.recv(512)
            sock.close()


@pytest.mark.parametrize("size", [1, 2, 5, 13, 100_000])
async def test_pipelined_tcp_requests_however_they_are_cut(size: int) -> None:
    """500 requests in one go, in segments that end anywhere: all answered, in order."""
    async with publishing() as publisher, tcp_client(publisher.port) as (reader, writer):
        stream = b"".join(request(number, *BLOCK) for number in range(500 if size > 2 else 60))
        for start in range(0, len(stream), size):
            writer.write(stream[start : start + size])
            if size < 100:
                await asyncio.sleep(0)
        for number in range(len(stream) // 12):
            answer = await read_answer(reader)
            assert (int.from_bytes(answer[:2], "big"), len(answer)) == (number, 137)


async def test_small_answers_are_not_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without TCP_NODELAY the second small answer would wait for the client's delayed acknowledgement, 40 ms."""
    delays: list[int] = []
    made = tcp_endpoint.Connection.connection_made

    def connection_made(self: tcp_endpoint.Connection, transport: asyncio.BaseTransport) -> None:
        sock = transport.get_extra_info("socket")
        delays.append(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        made(self, transport)

    monkeypatch.setattr(tcp_endpoint.Connection, "connection_made", connection_made)
    async with publishing() as publisher, tcp_client(publisher.port) as (reader, writer):
        writer.write(request(1, *BLOCK))
        await read_answer(reader)
    assert delays == [1]


async def test_a_client_that_ends_still_gets_what_it_asked_for() -> None:
    async with publishing() as publisher, tcp_client(publisher.port) as (reader, writer):
        writer.write(b"".join(request(number, *BLOCK) for number in range(300)))
        writer.write_eof()
        assert len(await closed(reader)) == 300 * 137


async def test_one_client_with_thousands_of_requests_delays_nobody() -> None:
    """Another client's request is answered while the flood is still being served, and so is one over UDP."""
    async with publishing() as publisher, tcp_client(publisher.port) as (_, flood):
        flood.write(b"".join(request(number & 0xFFFF, *BLOCK) for number in range(1500)))
        async with tcp_client(publisher.port) as (reader, writer), udp_client(publisher.port) as (udp, datagrams):
            writer.write(request(7, *BLOCK))
            udp.sendto(request(8, *BLOCK))
            await read_answer(reader)
            await datagrams.wait_for(1)
            assert publisher.counts.requests < 1400


async def test_a_turn_serves_at_most_64_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every client that may be there sends as much as it can; requests served between two turns are counted."""
    per_turn: list[int] = []
    async with publishing() as publisher:
        loop = asyncio.get_running_loop()
        links = [
            await asyncio.open_connection("127.0.0.1", publisher.port, local_addr=(f"127.0.0.{1 + n % 2}", 0))
            for n in range(counts.MAX_CONNECTIONS)
        ]
        senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)]
        for _, writer in links:
            writer.write(b"".join(request(n, 4, 0, 1) for n in range(100)))
        for sock in senders:
            for n in range(50):
                sock.sendto(request(n, 4, 0, 1), ("127.0.0.1", publisher.port))
        before = publisher.counts.requests

        def turn() -> None:
            nonlocal before
            per_turn.append(publisher.counts.requests - before)
            before = publisher.counts.requests
            loop.call_soon(turn)

        turn()
        await until(lambda: publisher.counts.requests >= counts.MAX_CONNECTIONS * 100 + 4 * 50)
        for _, writer in links:
            writer.close()
        for sock in senders:
            sock.close()
    assert 0 < max(per_turn) <= 64


def test_odometry_over_udp_has_the_kernels_time_of_arrival() -> None:
    """The loop is held up for 0.2 s with the datagram in the socket; a write by TCP afterwards is of now."""
    readings: list[RawOdometry] = []

    def body(number: int) -> bytes:
        return struct.pack(">BHHBHHiii", 16, 1100, 8, 16, number, 0, 10_000, 0, 0)

    async def run() -> tuple[float, float]:
        async with publishing(write=True, on_odometry=readings.append) as publisher:
            await asyncio.sleep(0.3)  # the kernel begins to stamp in a work queue, some time after it was asked to
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.connect(("127.0.0.1", publisher.port))
                for number in (1, 2):
                    sock.send(struct.pack(">HHHB", number, 0, 1 + len(body(number)), 1) + body(number))
                sent = time.monotonic()
                time.sleep(0.2)  # noqa: ASYNC251  # the loop is to be late
                await until(lambda: len(readings) == 2)
            asked = time.monotonic()
            async with tcp_client(publisher.port) as (reader, writer):
                writer.write(struct.pack(">HHHB", 3, 0, 1 + len(body(3)), 1) + body(3))
                await read_answer(reader)
            return sent, asked

    sent, asked = asyncio.run(run())
    assert [reading.t_mono for reading in readings[:2]] == pytest.approx([sent, sent], abs=0.1)
    assert readings[2].t_rx >= asked


async def test_a_port_in_use_is_refused_with_a_remedy() -> None:
    with taken_port() as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DeviceRefused, match=rf"Modbus on 127.0.0.1:{port}: the port is in use .*modbus\.port"):
            await ModbusPublisher(SystemClock()).start("127.0.0.1", port)


async def test_a_udp_port_in_use_leaves_no_tcp_listener_behind() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(DeviceRefused, match="in use"):
            await ModbusPublisher(SystemClock()).start("127.0.0.1", port)
    publisher = ModbusPublisher(SystemClock())
    await publisher.start("127.0.0.1", port)
    await publisher.close()


async def test_an_address_of_another_computer_is_missing() -> None:
    with pytest.raises(DeviceMissing, match=r"does not have that address .*bind"):
        await ModbusPublisher(SystemClock()).start("203.0.113.7", 1502)


async def test_a_name_that_is_not_known_is_missing() -> None:
    with pytest.raises(DeviceMissing, match="host name not known"):
        await ModbusPublisher(SystemClock()).start("no-such-host.invalid", 1502)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM])
def test_a_privileged_port_names_the_capability(number: int) -> None:
    error = inet.refusal("Modbus on 0.0.0.0:502", "modbus.port", 502, OSError(number, os.strerror(number)))
    assert isinstance(error, DeviceRefused)
    assert "CAP_NET_BIND_SERVICE" in error.remedy
    assert "1502" in error.remedy


def test_another_error_keeps_the_systems_words() -> None:
    error = inet.refusal("Modbus on ::1:1502", "modbus.port", 1502, OSError(errno.ENOBUFS, "No buffer space"))
    assert "No buffer space" in str(error)


@pytest.mark.skipif(not socket.has_ipv6, reason="this computer has no IPv6")
async def test_ipv6_and_all_addresses() -> None:
    for bind in ("::1", ""):
        publisher = ModbusPublisher(SystemClock())
        try:
            await publisher.start(bind, 0)
        except DeviceMissing:
            pytest.skip("this computer has no IPv6 loopback address")
        client = AsyncModbusUdpClient("::1", port=publisher.port)
        assert await client.connect()
        assert (await client.read_input_registers(0, count=1)).registers == [0x4C4C]
        client.close()
        await publisher.close()


def test_every_address_of_a_computer_answers_for_itself() -> None:
    """As with Ethernet and WLAN: a connected client takes an answer from no other address than it has asked."""

    async def run(write: bool) -> None:
        publisher = ModbusPublisher(SystemClock(), write=write)
        await publisher.start("0.0.0.0", 0)
        for host in ("127.0.0.1", "127.0.0.2"):
            async with udp_client(publisher.port, host) as (transport, datagrams):
                transport.sendto(request(1, *BLOCK))
                await datagrams.wait_for(1)
        await publisher.close()

    for write in (False, True):
        asyncio.run(run(write))


@pytest.mark.parametrize(
    ("asked", "interface"), [("fe80::1", 3), ("fd00::1", 0), ("ff02::1", None)], ids=["link", "site", "group"]
)
def test_ipv6_is_answered_from_where_an_answer_can_come(asked: str, interface: int | None) -> None:
    told = socket.inet_pton(socket.AF_INET6, asked) + struct.pack("@I", 3)
    source = reply_source([(socket.IPPROTO_IPV6, socket.IPV6_PKTINFO, told)])
    if interface is None:
        assert source == ()
    else:
        assert source[0][2] == told[:16] + struct.pack("@I", interface)


async def test_before_the_first_snapshot_the_state_is_starting() -> None:
    publisher = ModbusPublisher(SystemClock())
    await publisher.start("127.0.0.1", 0)
    async with udp_client(publisher.port) as (transport, datagrams):
        transport.sendto(request(1, *BLOCK))
        await datagrams.wait_for(1)
    values = registers.decode_block(datagrams.answers[0][9:])
    assert (values["seq"], values["state"], values["map_x"]) == (0, 0, None)
    await publisher.close()

"""The server over real loopback sockets: nobody is lost, nobody is disturbed, nothing is torn."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
from pymodbus.client import AsyncModbusTcpClient, AsyncModbusUdpClient

from daemon.publish import modbus, registers
from daemon.publish.holding import Outcome, Request
from daemon.publish.modbus import ModbusPublisher
from hal import inet
from hal.clock import SystemClock, run_virtual
from hal.errors import DeviceMissing, DeviceRefused
from hal.odometry import RawOdometry
from tests.daemon.publish.network import (
    BLOCK,
    closed,
    plugged,
    publishing,
    read_answer,
    request,
    taken_port,
    tcp_client,
    udp_client,
    until,
)
from tests.daemon.publish.test_registers import snapshot

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


# --- with pymodbus's clients -----------------------------------------------------------------------------------------


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


# --- everybody is answered exactly once ------------------------------------------------------------------------------


def test_eight_udp_clients_back_to_back() -> None:
    async def client(port: int, number: int, rounds: int) -> None:
        async with udp_client(port) as (transport, datagrams):
            for index in range(rounds):
                transport.sendto(request(number << 12 | index, *BLOCK))
                await datagrams.wait_for(index + 1)
            await asyncio.sleep(0.02)  # a second answer to one request would come now
            assert [a[:2] for a in datagrams.answers] == [(number << 12 | i).to_bytes(2, "big") for i in range(rounds)]

    async def run() -> None:
        async with publishing() as publisher:
            await asyncio.gather(*(client(publisher.port, number, 200) for number in range(8)))
            assert publisher.counts.requests == 8 * 200

    asyncio.run(run())


def test_a_burst_of_datagrams_from_eight_clients() -> None:
    """Requests that lie in the socket's queue together: the case in which a shared peer address loses answers."""

    async def run() -> None:
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

    asyncio.run(run())


@pytest.mark.parametrize("size", [1, 2, 5, 13, 100_000])
def test_pipelined_tcp_requests_however_they_are_cut(size: int) -> None:
    """500 requests in one go, in segments that end anywhere: all answered, in order."""

    async def run() -> None:
        async with publishing() as publisher, tcp_client(publisher.port) as (reader, writer):
            stream = b"".join(request(number, *BLOCK) for number in range(500 if size > 2 else 60))
            for start in range(0, len(stream), size):
                writer.write(stream[start : start + size])
                if size < 100:
                    await asyncio.sleep(0)
            for number in range(len(stream) // 12):
                answer = await read_answer(reader)
                assert (int.from_bytes(answer[:2], "big"), len(answer)) == (number, 137)

    asyncio.run(run())


def test_small_answers_are_not_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without TCP_NODELAY the second small answer would wait for the client's delayed acknowledgement, 40 ms."""
    delays: list[int] = []
    made = modbus.Connection.connection_made

    def connection_made(self: modbus.Connection, transport: asyncio.BaseTransport) -> None:
        sock = transport.get_extra_info("socket")
        delays.append(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        made(self, transport)

    monkeypatch.setattr(modbus.Connection, "connection_made", connection_made)

    async def run() -> None:
        async with publishing() as publisher, tcp_client(publisher.port) as (reader, writer):
            writer.write(request(1, *BLOCK))
            await read_answer(reader)

    asyncio.run(run())
    assert delays == [1]


def test_a_client_that_ends_still_gets_what_it_asked_for() -> None:
    async def run() -> None:
        async with publishing() as publisher, tcp_client(publisher.port) as (reader, writer):
            writer.write(b"".join(request(number, *BLOCK) for number in range(300)))
            writer.write_eof()
            assert len(await closed(reader)) == 300 * 137

    asyncio.run(run())


def test_one_client_with_thousands_of_requests_delays_nobody() -> None:
    """Another client's request is answered while the flood is still being served, and so is one over UDP."""

    async def run() -> None:
        async with publishing() as publisher, tcp_client(publisher.port) as (_, flood):
            flood.write(b"".join(request(number & 0xFFFF, *BLOCK) for number in range(1500)))
            async with tcp_client(publisher.port) as (reader, writer), udp_client(publisher.port) as (udp, datagrams):
                writer.write(request(7, *BLOCK))
                udp.sendto(request(8, *BLOCK))
                await read_answer(reader)
                await datagrams.wait_for(1)
                assert publisher.counts.requests < 1400

    asyncio.run(run())


# --- no turn of the loop serves more than 64 -------------------------------------------------------------------------


def test_a_turn_serves_at_most_64_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every client that may be there sends as much as it can; requests served between two turns are counted."""
    per_turn: list[int] = []

    async def run() -> None:
        async with publishing() as publisher:
            loop = asyncio.get_running_loop()
            links = [await asyncio.open_connection("127.0.0.1", publisher.port) for _ in range(modbus.MAX_CONNECTIONS)]
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
            await until(lambda: publisher.counts.requests >= modbus.MAX_CONNECTIONS * 100 + 4 * 50)
            for _, writer in links:
                writer.close()
            for sock in senders:
                sock.close()

    asyncio.run(run())
    assert 0 < max(per_turn) <= 64


# --- nobody disturbs anybody -----------------------------------------------------------------------------------------

READ_ONE = bytes.fromhex("010400000001")
MALFORMED = [
    *(b"", b"\x00", b"\x00\x01\x00", bytes(7), bytes(2000), b"\xff" * 8, b"\xff" * 300),
    b"\x00\x01\x00\x07\x00\x06" + READ_ONE,  # another protocol
    *(b"\x00\x01\x00\x00" + length.to_bytes(2, "big") + READ_ONE for length in (0, 5, 7, 254, 0xFFFF)),
]


def test_a_malformed_datagram_disturbs_nobody() -> None:
    async def run() -> None:
        async with publishing() as publisher, udp_client(publisher.port) as (good, datagrams):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bad:
                for number, rubbish in enumerate(MALFORMED * 5):
                    bad.sendto(rubbish, ("127.0.0.1", publisher.port))
                    good.sendto(request(number, *BLOCK))
                    await datagrams.wait_for(number + 1)
                with pytest.raises(BlockingIOError):
                    bad.recv(512, socket.MSG_DONTWAIT)
            assert [a[:2] for a in datagrams.answers] == [n.to_bytes(2, "big") for n in range(len(MALFORMED) * 5)]
            assert publisher.counts.malformed == len(MALFORMED) * 5

    asyncio.run(run())


@pytest.mark.parametrize("rubbish", [b"\x00\x01\x00\x07\x00\x06\x01\x04", b"GET / HTTP/1.1\r\n\r\n", bytes(300)])
def test_a_tcp_client_that_does_not_speak_modbus_is_closed(rubbish: bytes) -> None:
    async def run() -> None:
        async with publishing() as publisher, tcp_client(publisher.port) as (other, writer):
            async with tcp_client(publisher.port) as (reader, bad):
                bad.write(request(1, *BLOCK) + rubbish + request(2, *BLOCK))
                assert len(await closed(reader)) == 137, "what came before the rubbish is answered"
            writer.write(request(3, *BLOCK))
            assert (await read_answer(other))[:2] == b"\x00\x03"
            assert publisher.counts.malformed == 1

    asyncio.run(run())


def test_clients_that_vanish_leave_nothing_behind() -> None:
    async def run() -> None:
        async with publishing() as publisher:
            for number in range(50):
                _, writer = await asyncio.open_connection("127.0.0.1", publisher.port)
                writer.write(request(1, *BLOCK) + request(2, *BLOCK)[: number % 12])
                await writer.drain()
                writer.transport.abort()
            await until(lambda: not publisher.counts.connections)
            async with tcp_client(publisher.port) as (reader, writer):
                writer.write(request(3, *BLOCK))
                await read_answer(reader)

    asyncio.run(run())


def test_an_answer_that_the_kernel_does_not_take_is_dropped() -> None:
    class Full(socket.socket):
        def sendto(self, *_: Any) -> int:
            raise BlockingIOError(errno.EAGAIN, "no buffer space")

    async def run() -> None:
        publisher = ModbusPublisher(SystemClock())
        sock = Full(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        sock.bind(("127.0.0.1", 0))
        endpoint = modbus.UdpEndpoint(sock, publisher._responder, publisher.counts)
        async with udp_client(sock.getsockname()[1]) as (transport, datagrams):
            transport.sendto(request(1, *BLOCK))
            transport.sendto(request(2, *BLOCK))
            await until(lambda: publisher.counts.unsent == 2)
            assert datagrams.answers == []
        endpoint.close()

    asyncio.run(run())


def test_closing_drops_clients_and_frees_the_port() -> None:
    async def run() -> None:
        async with publishing() as publisher:
            port = publisher.port
            async with tcp_client(port) as (reader, _):
                await asyncio.sleep(0.02)
                await publisher.close()
                await publisher.close()
                assert await closed(reader) == b""
            await publisher.start("127.0.0.1", 0)
            assert publisher.port != port, "a new start asks for what it is told, not for the old port"
            again = ModbusPublisher(SystemClock())
            await again.start("127.0.0.1", port)
            await again.close()

    asyncio.run(run())


# --- torn reads ------------------------------------------------------------------------------------------------------


def test_a_read_is_never_torn() -> None:
    """Every point is set from the snapshot's number; a block that mixes two snapshots could not be consistent."""

    async def run() -> None:
        async with publishing() as publisher:
            done = asyncio.Event()

            async def update() -> None:
                number = 0
                while not done.is_set():
                    number += 1
                    pose = (number / 1e4, -number / 1e4, 0.0)
                    publisher.publish(snapshot(seq=number, pose=pose, odom=pose, missed=number, loop_new=number))
                    await asyncio.sleep(0)

            async def check(port: int) -> set[int]:
                seen = set()
                async with udp_client(port) as (transport, datagrams):
                    for index in range(400):
                        transport.sendto(request(index, *BLOCK))
                        await datagrams.wait_for(index + 1)
                        values = registers.decode_block(datagrams.answers[index][9:])
                        seq = int(values["seq"] or 0)
                        assert values["map_x"] == seq / 1e4
                        assert values["odom_y"] == -seq / 1e4
                        assert values["missed"] == values["loop_new"] == seq
                        seen.add(seq)
                return seen

            publisher.publish(snapshot(seq=0, pose=(0.0, 0.0, 0.0), odom=(0.0, 0.0, 0.0), missed=0, loop_new=0))
            updating = asyncio.create_task(update())
            seen = await asyncio.gather(*(check(publisher.port) for _ in range(3)))
            done.set()
            await updating
            assert all(len(numbers) > 50 for numbers in seen), "the snapshot must have changed while it was read"

    asyncio.run(run())


# --- limits of a connection, in virtual time --------------------------------------------------------------------------


def in_virtual_time(body: Callable[[modbus.TcpEndpoint], Coroutine[Any, Any, None]]) -> None:
    async def run() -> None:
        publisher = ModbusPublisher(SystemClock())
        endpoint = modbus.TcpEndpoint(publisher._responder, publisher.counts)
        await body(endpoint)
        await endpoint.close()

    run_virtual(run())


def test_idle_and_half_open_connections_are_dropped() -> None:
    async def body(endpoint: modbus.TcpEndpoint) -> None:
        idle, busy, partial = plugged(endpoint), plugged(endpoint), plugged(endpoint)
        await asyncio.sleep(30.0)
        partial[0].data_received(request(1, *BLOCK)[:7])
        assert not partial[1].gone
        await asyncio.sleep(modbus.PARTIAL_S - 1.0)
        assert not partial[1].gone
        for _ in range(10):
            busy[0].data_received(request(1, *BLOCK))
            await asyncio.sleep(7.0)
        assert idle[1].gone
        assert partial[1].gone
        assert not busy[1].gone
        assert endpoint.counts.dropped == 2

    in_virtual_time(body)


def test_a_client_that_trickles_bytes_is_dropped_too() -> None:
    async def body(endpoint: modbus.TcpEndpoint) -> None:
        connection, wire = plugged(endpoint)
        for byte in request(1, *BLOCK)[:11] * 3:
            if wire.gone:
                break
            connection.data_received(bytes([byte]))
            await asyncio.sleep(modbus.PARTIAL_S - 1.0)
        assert wire.gone

    in_virtual_time(body)


def test_answers_that_are_not_read_stop_the_service_then_the_connection() -> None:
    async def body(endpoint: modbus.TcpEndpoint) -> None:
        connection, wire = plugged(endpoint)
        connection.data_received(request(1, *BLOCK))
        connection.pause_writing()
        for _ in range(200):
            if wire.reading:
                connection.data_received(request(2, *BLOCK) * 50)
        assert len(wire.sent) == 137, "nothing more is served"
        assert not wire.reading, "nothing more is taken in"
        await asyncio.sleep(modbus.STUCK_S - 2.0)
        connection.resume_writing()
        await asyncio.sleep(0.5)
        assert len(wire.sent) > 137 * 1000
        assert wire.reading
        connection.pause_writing()
        await asyncio.sleep(modbus.STUCK_S + 2.0)
        assert wire.gone

    in_virtual_time(body)


def test_a_full_house_drops_the_longest_idle_or_refuses() -> None:
    async def body(endpoint: modbus.TcpEndpoint) -> None:
        house = [plugged(endpoint) for _ in range(modbus.MAX_CONNECTIONS)]
        _, refused = plugged(endpoint)
        assert refused.gone
        assert endpoint.counts.refused == 1
        await asyncio.sleep(modbus.EVICT_S + 1.0)
        for connection, _ in house[:5] + house[6:]:
            connection.data_received(request(1, *BLOCK))
        _, admitted = plugged(endpoint)
        assert not admitted.gone
        assert [number for number, (_, wire) in enumerate(house) if wire.gone] == [5]
        assert endpoint.counts.connections == modbus.MAX_CONNECTIONS

    in_virtual_time(body)


# --- what can go wrong at the start ----------------------------------------------------------------------------------


def test_a_port_in_use_is_refused_with_a_remedy() -> None:
    async def run() -> None:
        with taken_port() as taken:
            port = taken.getsockname()[1]
            with pytest.raises(DeviceRefused, match=rf"Modbus on 127.0.0.1:{port}: the port is in use .*modbus\.port"):
                await ModbusPublisher(SystemClock()).start("127.0.0.1", port)

    asyncio.run(run())


def test_a_udp_port_in_use_leaves_no_tcp_listener_behind() -> None:
    async def run() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            port = taken.getsockname()[1]
            with pytest.raises(DeviceRefused, match="in use"):
                await ModbusPublisher(SystemClock()).start("127.0.0.1", port)
        publisher = ModbusPublisher(SystemClock())
        await publisher.start("127.0.0.1", port)
        await publisher.close()

    asyncio.run(run())


def test_an_address_of_another_computer_is_missing() -> None:
    async def run() -> None:
        with pytest.raises(DeviceMissing, match=r"does not have that address .*bind"):
            await ModbusPublisher(SystemClock()).start("203.0.113.7", 1502)

    asyncio.run(run())


def test_a_name_that_is_not_known_is_missing() -> None:
    async def run() -> None:
        with pytest.raises(DeviceMissing, match="host name not known"):
            await ModbusPublisher(SystemClock()).start("no-such-host.invalid", 1502)

    asyncio.run(run())


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
def test_ipv6_and_all_addresses() -> None:
    async def run() -> None:
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

    asyncio.run(run())


def test_before_the_first_snapshot_the_state_is_starting() -> None:
    async def run() -> None:
        publisher = ModbusPublisher(SystemClock())
        await publisher.start("127.0.0.1", 0)
        async with udp_client(publisher.port) as (transport, datagrams):
            transport.sendto(request(1, *BLOCK))
            await datagrams.wait_for(1)
        values = registers.decode_block(datagrams.answers[0][9:])
        assert (values["seq"], values["state"], values["map_x"]) == (0, 0, None)
        await publisher.close()

    asyncio.run(run())

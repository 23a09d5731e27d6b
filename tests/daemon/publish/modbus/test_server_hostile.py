"""The server among clients that misbehave: nobody is disturbed, nothing is torn, connections have limits."""

import asyncio
import errno
import logging
import socket
import struct
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from daemon.publish.modbus import counts, registers, tcp_endpoint, udp_endpoint
from daemon.publish.modbus.server import ModbusPublisher
from hal.clock import SystemClock
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import (
    BLOCK,
    Wire,
    closed,
    plugged,
    publishing,
    read_answer,
    request,
    tcp_client,
    udp_client,
    until,
)

READ_ONE = bytes.fromhex("010400000001")


MALFORMED = [
    *(b"", b"\x00", b"\x00\x01\x00", bytes(7), bytes(2000), b"\xff" * 8, b"\xff" * 300),
    b"\x00\x01\x00\x07\x00\x06" + READ_ONE,  # another protocol
    *(b"\x00\x01\x00\x00" + length.to_bytes(2, "big") + READ_ONE for length in (0, 5, 7, 254, 0xFFFF)),
]


async def test_a_malformed_datagram_disturbs_nobody(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
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
    assert [record.message for record in caplog.records] == [f"Modbus: 127.0.0.1 {counts.STRANGE}"], "a line a minute"


@pytest.mark.parametrize("rubbish", [b"\x00\x01\x00\x07\x00\x06\x01\x04", b"GET / HTTP/1.1\r\n\r\n", bytes(300)])
async def test_a_tcp_client_that_does_not_speak_modbus_is_closed(
    rubbish: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with publishing() as publisher, tcp_client(publisher.port) as (other, writer):
        async with tcp_client(publisher.port) as (reader, bad):
            bad.write(request(1, *BLOCK) + rubbish + request(2, *BLOCK))
            assert len(await closed(reader)) == 137, "what came before the rubbish is answered"
        writer.write(request(3, *BLOCK))
        assert (await read_answer(other))[:2] == b"\x00\x03"
        assert publisher.counts.malformed == 1
    assert f"Modbus: 127.0.0.1 {counts.STRANGE}" in caplog.text


async def test_clients_that_vanish_leave_nothing_behind() -> None:
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


async def test_an_answer_that_the_kernel_does_not_take_is_dropped() -> None:
    class Full(socket.socket):
        def sendto(self, *_: Any) -> int:
            raise BlockingIOError(errno.EAGAIN, "no buffer space")

    publisher = ModbusPublisher(SystemClock())
    sock = Full(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.bind(("127.0.0.1", 0))
    endpoint = udp_endpoint.UdpEndpoint(sock, publisher._responder, publisher.counts)
    async with udp_client(sock.getsockname()[1]) as (transport, datagrams):
        transport.sendto(request(1, *BLOCK))
        transport.sendto(request(2, *BLOCK))
        await until(lambda: publisher.counts.unsent == 2)
        assert datagrams.answers == []
    endpoint.close()


async def test_a_defect_is_told_to_the_client_and_wedges_nobody(caplog: pytest.LogCaptureFixture) -> None:
    """Here: whatever takes commands raises. Clients with many requests in a row are served afterwards, too."""

    def broken(_: object) -> None:
        raise RuntimeError("a defect")

    def command(number: int) -> bytes:
        return struct.pack(">HHHBBHHBHHiii", 9, 0, 23, 1, 16, 1000, 8, 16, number, 1, 0, 0, 0)

    async with (
        publishing(write=True, on_command=broken) as publisher,
        tcp_client(publisher.port) as (reader, writer),
        udp_client(publisher.port) as (udp, datagrams),
    ):
        writer.write(request(1, *BLOCK) * 3 + command(1) + request(2, *BLOCK) * 3)
        answers = [await read_answer(reader) for _ in range(7)]
        assert [answer[7:9] for answer in answers] == [b"\x04\x80"] * 3 + [b"\x90\x04"] + [b"\x04\x80"] * 3
        udp.sendto(command(2))
        await datagrams.wait_for(1)
        assert datagrams.answers[0][7:] == b"\x90\x04"
        assert publisher._age_s == 0.0
    assert caplog.text.count("RuntimeError: a defect") == 1


@pytest.mark.virtual
async def test_a_connection_that_cannot_be_served_is_closed_and_the_others_are_served(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with an_endpoint() as endpoint:
        (bad, bad_wire), (good, good_wire) = plugged(endpoint), plugged(endpoint)

        def broken(_: int) -> bool:
            raise RuntimeError("a defect")

        monkeypatch.setattr(bad, "serve", broken)
        endpoint.wait(bad)
        good.data_received(request(1, *BLOCK) * 20)
        await asyncio.sleep(0.1)
        assert bad_wire.gone
        assert len(good_wire.sent) == 20 * 137


async def test_a_defect_leaves_no_age_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes over TCP afterwards is of now."""
    async with publishing(write=True) as publisher:
        (endpoint,) = publisher._udp
        monkeypatch.setattr(publisher._responder, "answer", None)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(request(1, *BLOCK), ("127.0.0.1", publisher.port))
            with pytest.raises(TypeError):
                endpoint._serve()
        assert publisher._age_s == 0.0


async def test_closing_drops_clients_and_frees_the_port() -> None:
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


async def test_a_read_is_never_torn() -> None:
    """Every point is set from the snapshot's number; a block that mixes two snapshots could not be consistent."""
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


@asynccontextmanager
async def an_endpoint() -> AsyncGenerator[tcp_endpoint.TcpEndpoint]:
    publisher = ModbusPublisher(SystemClock())
    endpoint = tcp_endpoint.TcpEndpoint(publisher._responder, publisher.counts)
    yield endpoint
    await endpoint.close()


@pytest.mark.virtual
async def test_idle_and_half_open_connections_are_dropped() -> None:
    async with an_endpoint() as endpoint:
        idle, busy, partial = plugged(endpoint), plugged(endpoint), plugged(endpoint)
        await asyncio.sleep(30.0)
        partial[0].data_received(request(1, *BLOCK)[:7])
        assert not partial[1].gone
        await asyncio.sleep(tcp_endpoint.PARTIAL_S - 1.0)
        assert not partial[1].gone
        for _ in range(10):
            busy[0].data_received(request(1, *BLOCK))
            await asyncio.sleep(7.0)
        assert idle[1].gone
        assert partial[1].gone
        assert not busy[1].gone
        assert endpoint.counts.dropped == 2


@pytest.mark.virtual
async def test_a_client_that_trickles_bytes_is_dropped_too() -> None:
    async with an_endpoint() as endpoint:
        connection, wire = plugged(endpoint)
        for byte in request(1, *BLOCK)[:11] * 3:
            if wire.gone:
                break
            connection.data_received(bytes([byte]))
            await asyncio.sleep(tcp_endpoint.PARTIAL_S - 1.0)
        assert wire.gone


@pytest.mark.virtual
async def test_answers_that_are_not_read_stop_the_service_then_the_connection() -> None:
    async with an_endpoint() as endpoint:
        connection, wire = plugged(endpoint)
        connection.data_received(request(1, *BLOCK))
        connection.pause_writing()
        for _ in range(200):
            if wire.reading:
                connection.data_received(request(2, *BLOCK) * 50)
        assert len(wire.sent) == 137, "nothing more is served"
        assert not wire.reading, "nothing more is taken in"
        await asyncio.sleep(tcp_endpoint.STUCK_S - 2.0)
        connection.resume_writing()
        await asyncio.sleep(4.0)  # each slice of the loop's time holds as many answers as the processor is quick
        assert len(wire.sent) > 137 * 1000
        assert wire.reading
        connection.pause_writing()
        await asyncio.sleep(tcp_endpoint.STUCK_S + 2.0)
        assert wire.gone


@pytest.mark.virtual
async def test_a_full_house_drops_the_longest_idle_or_refuses(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with an_endpoint() as endpoint:
        house = [plugged(endpoint, f"192.0.2.{n % 2}") for n in range(counts.MAX_CONNECTIONS)]
        _, refused = plugged(endpoint, "192.0.2.1")
        assert refused.gone
        assert endpoint.counts.refused == 1
        await asyncio.sleep(tcp_endpoint.EVICT_S + 1.0)
        for connection, _ in house[:5] + house[6:]:
            connection.data_received(request(1, *BLOCK))
        _, admitted = plugged(endpoint, "192.0.2.1")
        assert not admitted.gone
        assert [number for number, (_, wire) in enumerate(house) if wire.gone] == [5]
        assert endpoint.counts.connections == counts.MAX_CONNECTIONS
    assert [record.message.partition(" is ")[2] for record in caplog.records] == [counts.CROWDED.removeprefix("is ")]


def served(connection: tcp_endpoint.Connection, wire: Wire) -> bool:
    """Whether a request is answered now."""
    before = len(wire.sent)
    if not wire.gone:
        connection.data_received(request(1, *BLOCK))
    return len(wire.sent) > before


@pytest.mark.virtual
async def test_one_host_never_takes_all_connections(caplog: pytest.LogCaptureFixture) -> None:
    """However often it connects and asks, another one is served; its own idle connections make place for it."""
    caplog.set_level(logging.INFO)
    async with an_endpoint() as endpoint:
        flood = [plugged(endpoint, "192.0.2.9") for _ in range(2 * counts.MAX_CONNECTIONS)]
        assert sum(served(*one) for one in flood) == endpoint.counts.connections == counts.PER_HOST == 24
        honest = [plugged(endpoint, f"192.0.2.{n}") for n in range(8)]
        assert all(served(*one) for one in honest)
        assert endpoint.counts.connections == counts.MAX_CONNECTIONS
        await asyncio.sleep(tcp_endpoint.EVICT_S + 1.0)
        for one in (*flood[1:], *honest):
            served(*one)
        late = plugged(endpoint, "::ffff:192.0.2.9")
        assert served(*late)
        assert flood[0][1].gone
        assert all(served(*one) for one in honest)
    assert any("it uses 24 of the 32 connections" in record.message for record in caplog.records)


@pytest.mark.virtual
async def test_in_a_full_house_the_host_with_most_makes_place_for_another_one() -> None:
    async with an_endpoint() as endpoint:
        house = [plugged(endpoint, f"2001:db8:0:{n % 2}::{n + 1:x}") for n in range(counts.MAX_CONNECTIONS)]
        assert all(served(*one) for one in house)
        others = [plugged(endpoint, f"192.0.2.{n}") for n in range(40)]
        assert all(served(*one) for one in others[:30])
        assert not any(served(*one) for one in others[30:])
        for subnet in (0, 1):
            assert sum(not wire.gone for _, wire in house[subnet::2]) == 1

"""What can go wrong when the server starts."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import struct

import pytest
from pymodbus.client import AsyncModbusUdpClient

from daemon.publish.modbus import registers
from daemon.publish.modbus.server import ModbusPublisher
from hal.clock import SystemClock
from hal.errors import DeviceMissing, DeviceRefused
from hal.net import inet
from hal.net.reply_address import reply_source
from tests.daemon.publish.network import BLOCK, request, taken_port, udp_client


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

"""The TCP port on loopback: delivery, loss, connect errors with their remedies."""

import asyncio
import errno
import socket

import pytest

from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.net import inet
from hal.port.opening import open_port
from hal.port.tcp_port import TcpPort, parse_tcp_name


async def test_bytes_both_ways_early_bytes_and_loss() -> None:
    accepted: asyncio.Future[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = (
        asyncio.get_running_loop().create_future()
    )
    server = await asyncio.start_server(lambda r, w: accepted.set_result((r, w)), "127.0.0.1", 0)
    number = server.sockets[0].getsockname()[1]
    port = await open_port(f"tcp://127.0.0.1:{number}", 0)
    reader, writer = await accepted
    writer.write(b"early")
    await writer.drain()
    await asyncio.sleep(0.05)
    got: list[bytes] = []
    lost: list[HalError] = []
    ended = asyncio.Event()
    port.start(lambda data, t_rx: got.append(data), lambda error: (lost.append(error), ended.set())[0])
    port.write(b"VV\n")
    assert await reader.readexactly(3) == b"VV\n"
    writer.write(b" late")
    writer.close()
    await writer.wait_closed()
    async with asyncio.timeout(4):
        await ended.wait()
    assert b"".join(got) == b"early late"
    assert [type(error) for error in lost] == [DeviceMissing]
    assert "closed by the sensor" in str(lost[0])
    with pytest.raises(DeviceMissing):
        port.write(b"QT\n")
    port.close()
    server.close()
    await server.wait_closed()


async def test_socket_options() -> None:
    server = await asyncio.start_server(lambda r, w: w.close(), "127.0.0.1", 0)
    port = await open_port(f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}", 0)
    assert isinstance(port, TcpPort)
    assert port._transport is not None
    link = port._transport.get_extra_info("socket")
    assert link.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    assert link.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    port.close()
    server.close()
    await server.wait_closed()


async def test_refused_and_unknown() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening: connections are refused
        with pytest.raises(DeviceRefused, match=r"connection refused .*one client"):
            await open_port(f"tcp://127.0.0.1:{taken.getsockname()[1]}", 0)


async def test_no_answer_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    async def never(*args: object, **kwargs: object) -> None:
        await asyncio.sleep(60)

    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", never)
    monkeypatch.setattr("hal.port.tcp_port.CONNECT_TIMEOUT_S", 0.02)
    with pytest.raises(DeviceMissing, match=r"no answer .* at port 10940, the default port .*cable"):
        await open_port("tcp://127.0.0.1", 0)


@pytest.mark.parametrize(
    ("name", "parsed"),
    [
        ("tcp://192.168.0.10", ("192.168.0.10", 10940)),
        ("tcp://192.168.0.10:10941", ("192.168.0.10", 10941)),
        ("tcp://[::1]:1", ("::1", 1)),
        ("tcp://lidar.local/", ("lidar.local", 10940)),
    ],
)
def test_names(name: str, parsed: tuple[str, int]) -> None:
    assert parse_tcp_name(name) == parsed


@pytest.mark.parametrize(
    "name", ["tcp://", "tcp://host:port", "tcp://host:99999", "tcp://h/path", "tcp://:10940", "tcp://host:0"]
)
def test_bad_names(name: str) -> None:
    with pytest.raises(DeviceRefused, match=r"expected tcp://host"):
        parse_tcp_name(name)


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (OSError(errno.EHOSTUNREACH, "Connect call failed"), DeviceMissing, "No route to host (check power"),
        (OSError("Multiple exceptions: a, b"), DeviceMissing, "Multiple exceptions: a, b"),
        (OSError(errno.ECONNREFUSED, "Connect call failed"), DeviceRefused, "a sensor serves one client"),
        (
            OSError(errno.ECONNREFUSED, "Connect call failed"),
            DeviceRefused,
            "refused at port 10940, the default port",
        ),
    ],
)
async def test_connect_errors(
    error: OSError, kind: type[HalError], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fails(*args: object, **kwargs: object) -> None:
        raise error

    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", fails)
    with pytest.raises(kind) as caught:
        await open_port("tcp://192.0.2.7", 0)
    assert words in str(caught.value)
    assert caught.value.device == "tcp://192.0.2.7"


@pytest.mark.parametrize("name", ["robot..local", "no-such-host.invalid", f"{64 * 'a'}.local"])
def test_a_name_that_is_not_known_or_cannot_be_one_is_missing(name: str) -> None:
    with pytest.raises(DeviceMissing, match=rf"tcp://{name}: {name}: (not a host name|host name not known)"):
        asyncio.run(open_port(f"tcp://{name}", 0))


async def test_the_next_address_of_a_name_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    server = await asyncio.start_server(lambda r, w: w.close(), "127.0.0.1", 0)
    number = server.sockets[0].getsockname()[1]

    async def resolve(host: str, port: int) -> list[inet.Address]:
        return [(socket.AF_INET, (address, port)) for address in ("127.0.0.77", "127.0.0.1")]

    monkeypatch.setattr(inet, "resolve", resolve)
    (await open_port(f"tcp://lidar:{number}", 0)).close()
    server.close()
    await server.wait_closed()

"""Who reaches the Foxglove server: programs, its apps and pages that are named, under this computer's names only."""

import asyncio
import contextlib
import ipaddress
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

pytest.importorskip("aiohttp", reason="pip install 'lumiloop[view]'")
import aiohttp

from taps.access_guard import Guard
from taps.foxglove import gate
from taps.foxglove.gate import Gate, Refused, check, random_loopback

LOCAL = Guard(bind="127.0.0.1")


def head(host: str = "localhost:8765", **others: str) -> bytes:
    lines = [f"Host: {host}", *(f"{name}: {value}" for name, value in others.items())]
    return ("GET / HTTP/1.1\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode()


@pytest.mark.parametrize(
    "origin", ["", "https://app.foxglove.dev", "file://", "http://localhost:8765", "https://a.example"]
)
@pytest.mark.parametrize("host", ["localhost:8765", "127.0.0.1:8765", "[::1]:8765"])
def test_programs_and_apps_pass(origin: str, host: str) -> None:
    origin = origin.replace("localhost:8765", host)
    check(head(host, **({"Origin": origin} if origin else {})), LOCAL, [*gate.APPS, "https://a.example"])


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "http://localhost", "https://app.foxglove.dev.evil.example", "http://127.0.0.1:1"],
)
def test_pages_of_other_sites_do_not(origin: str) -> None:
    with pytest.raises(Refused, match="have no access"):
        check(head(oRiGiN=origin), LOCAL, gate.APPS)


def test_other_names_of_this_computer_do_not() -> None:
    for host in ("evil.example", "evil.example:8765", "127.0.0.1.evil.example", "", "localhost.", "192.0.2.7"):
        with pytest.raises(Refused):
            check(head(host), LOCAL, gate.APPS)
    check(head("192.0.2.7:8765"), Guard(bind="0.0.0.0"), gate.APPS)
    with pytest.raises(Refused, match="names another host"):
        check(head("evil.example"), Guard(bind="0.0.0.0"), gate.APPS)


@pytest.mark.parametrize(
    "damaged",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost : evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n Origin: x\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: file://\r\nOrigin: https://evil.example\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"\x16\x03\x01\r\n\r\n",
        b"\r\n\r\n",
    ],
)
def test_damaged_requests_do_not(damaged: bytes) -> None:
    with pytest.raises(Refused, match=r"not an HTTP/1 request|one Host"):
        check(damaged, LOCAL, gate.APPS)


def test_the_server_s_own_address_cannot_be_guessed() -> None:
    found = {random_loopback() for _ in range(100)}
    assert len(found) > 95
    assert all(ipaddress.ip_address(one).is_loopback and one != "127.0.0.1" for one in found)


@contextlib.asynccontextmanager
async def passing() -> AsyncIterator[int]:
    """A gate before a server that repeats what it receives, in capitals."""

    async def repeat(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1 << 16):
            writer.write(data.upper())
            await writer.drain()
        writer.close()

    behind = await asyncio.start_server(repeat, "127.0.0.1", 0)
    to = behind.sockets[0].getsockname()[:2]
    made = Gate(LOCAL, (), to)
    before = await asyncio.start_server(made, "127.0.0.1", 0, limit=gate.LONGEST_HEAD)
    try:
        yield before.sockets[0].getsockname()[1]
    finally:
        before.close()
        behind.close()
        await made.close()


async def asked(port: int, request: bytes, end: bytes = b"", host: str = "127.0.0.1") -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(host, 0), limit=4 << 20)
    try:
        writer.write(request)
        async with asyncio.timeout(10.0):
            return await (reader.readuntil(end) if end else reader.read())
    except (ConnectionError, asyncio.IncompleteReadError):
        return b""
    finally:
        writer.close()


async def test_what_passes_passes_in_both_directions() -> None:
    async with passing() as port:
        body = b"x" * 1_000_000
        said = await asked(port, head() + body + b"end", b"END")
        assert said == (head() + body + b"end").upper()


async def test_what_does_not_is_told_why(caplog: pytest.LogCaptureFixture) -> None:
    async with passing() as port:
        for request, status in (
            (head(Origin="https://evil.example"), b"HTTP/1.1 403 "),
            (head("evil.example"), b"HTTP/1.1 421 "),
            (b"\xff\r\n\r\n", b"HTTP/1.1 400 "),
            (b"GET /" + b"a" * 20_000, b""),
        ):
            assert (await asked(port, request)).startswith(status)
    assert not caplog.records


async def test_one_computer_never_has_all_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "CLIENTS", 4)
    async with passing() as port:
        crowd = [await asyncio.open_connection("127.0.0.1", port) for _ in range(8)]
        for _, writer in crowd:
            writer.write(head())
        await asyncio.sleep(0.1)
        assert (await asked(port, head(), b"\r\n\r\n", "127.0.0.2")).startswith(b"GET")
        assert await asked(port, head(), b"\r\n\r\n") == b""
        for _, writer in crowd:
            writer.close()
        await asyncio.sleep(0.1)
        assert (await asked(port, head(), b"\r\n\r\n")).startswith(b"GET")


@pytest.mark.parametrize("headers", [{"Origin": "https://evil.example"}, {"Host": "evil.example"}])
async def test_a_page_reads_nothing_of_the_live_server(tmp_path: Path, headers: dict[str, str]) -> None:
    pytest.importorskip("foxglove", reason="pip install 'lumiloop[foxglove]'")
    from daemon.config.schema import Config
    from daemon.publish.stream.client import Stream
    from taps.foxglove import live
    from taps.ros.stream_follower import forward

    bridge = live.Bridge(random_loopback(), 0, "agv")
    port = free_port()
    stream = Stream(tmp_path / "s", live.WANTED)
    serving = asyncio.ensure_future(live.serve(bridge, ("127.0.0.1", port), (), forward(stream, Config(), bridge)))
    try:
        async with aiohttp.ClientSession() as session:
            url, protocols = f"ws://127.0.0.1:{port}", ["foxglove.sdk.v1"]
            for _ in range(100):
                with contextlib.suppress(aiohttp.ClientConnectorError):
                    async with session.ws_connect(url, protocols=protocols) as socket:
                        assert (await socket.receive_json(timeout=5.0))["op"] == "serverInfo"
                    break
                await asyncio.sleep(0.05)
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect(url, protocols=protocols, headers=headers)
            with pytest.raises(aiohttp.ClientConnectorError):
                await session.ws_connect(f"ws://127.0.0.1:{bridge.port}", protocols=protocols)
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        bridge.close()
        await asyncio.sleep(0.01)


def free_port() -> int:
    import socket

    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])

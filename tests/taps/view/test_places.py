"""Who gets a place at the page, and what becomes of one that cannot be told anything."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from pathlib import Path

import aiohttp
import pytest

from taps.access_guard import Guard
from taps.view import server
from tests.taps.view.house import TOKEN, serving, snapshot


async def test_who_says_nothing_takes_no_viewer_s_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as there are places, and more, open a socket and say nothing; one with the token comes all the same."""
    monkeypatch.setattr(server, "UNAUTHENTICATED", 3)
    monkeypatch.setattr(server, "VIEWERS", 4)

    async with serving(tmp_path, guard=Guard("0.0.0.0", TOKEN)) as house:
        silent = [await house.session.ws_connect(f"{house.address}/ws") for _ in range(8)]
        async with house.page(TOKEN) as page:
            assert (await page.welcome())["kind"] == "welcome"
        assert (await silent[0].receive_json(timeout=5.0))[
            "text"
        ] == "Too many pages connected before this one sent its token."
        assert not silent[-1].closed
        for one in silent:
            await one.close()


async def test_places_are_counted_when_they_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "VIEWERS", 1)

    async with serving(tmp_path) as house:
        late = await house.session.ws_connect(f"{house.address}/ws")
        async with house.page() as page:
            await page.welcome()
            await late.send_json({"page": house.view.page, "token": None})
            assert (await late.receive_json(timeout=5.0))["what"] == "full"


async def test_what_cannot_be_sent_ends_that_connection_aloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It went on and told the page nothing more."""

    async with serving(tmp_path) as house, house.page() as page, house.page() as other:
        await page.welcome()
        await other.welcome()
        (first, _) = sorted(house.view.hub.viewers, key=lambda viewer: viewer.number)
        await page.until("daemon")
        monkeypatch.setattr(first, "next_message", lambda: 1 / 0)
        house.stream.publish(snapshot(1))
        while await page.read():
            pass
        assert page.socket.close_code == 1011
        await other.until("pose")
    assert any(record.exc_info and "sending to a browser has failed" in record.message for record in caplog.records)


async def test_damaged_requests_leave_one_line_and_no_traceback(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """From anybody, without a token: two Hosts, a broken head, a request of no kind, a body of another size."""
    damaged = (
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nno colon\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
        b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: x\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"GET /ws HTTP/1.1\r\nHost: ::1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: x\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost",
    )
    async with serving(tmp_path) as house:
        port = int(house.address.rpartition(":")[2])
        for request in damaged * 5:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(request)
            writer.write_eof()
            with contextlib.suppress(ConnectionError, TimeoutError):
                async with asyncio.timeout(5.0):
                    await reader.read()
            writer.close()
        async with house.session.get(house.address) as answer:
            assert answer.status == 200
    assert not [record for record in caplog.records if record.exc_info]
    assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) <= 1


async def test_one_computer_never_has_all_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "VIEWERS", 4)
    monkeypatch.setattr(server, "UNAUTHENTICATED", 4)
    async with serving(tmp_path, guard=Guard("0.0.0.0", TOKEN)) as house, contextlib.AsyncExitStack() as stack:
        crowd = [await stack.enter_async_context(house.page(TOKEN)) for _ in range(4)]
        assert [(await page.welcome())["kind"] for page in crowd] == ["welcome"] * 3 + ["refused"]
        connector = aiohttp.TCPConnector(local_addr=("127.0.0.2", 0))
        async with aiohttp.ClientSession(connector=connector) as other:
            silent = await other.ws_connect(f"{house.address}/ws")
            flood = [await stack.enter_async_context(house.session.ws_connect(f"{house.address}/ws")) for _ in range(9)]
            assert (await flood[0].receive_json(timeout=5.0))["what"] == "words"
            await silent.send_json({"page": house.view.page, "token": TOKEN})
            assert (await silent.receive_json(timeout=5.0))["kind"] == "welcome"
            await silent.close()

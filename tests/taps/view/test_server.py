"""The web page's server: what it serves, to whom, and for how many."""

import asyncio
import contextlib
import logging
import re
import socket
from importlib import resources
from pathlib import Path
from typing import Any

import aiohttp
import msgspec
import numpy as np
import pytest
from aiohttp import WSServerHandshakeError

from daemon.publish.stream import server as daemon_stream
from daemon.publish.stream.messages import Loop, MapTiles, Scan
from daemon.snapshot import State
from taps.access_guard import Guard
from taps.view import server, viewers
from tests.daemon.publish.stream.test_server import raw_scan, until
from tests.taps.view.house import TOKEN, serving, snapshot


async def test_the_page_is_whole_and_fetches_nothing_from_elsewhere(tmp_path: Path) -> None:
    async with serving(tmp_path) as house:
        async with house.session.get(house.address) as answer:
            page = await answer.text()
            policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert f'content="{house.view.page}"' in page
        named = re.findall(r'(?:src|href)="/([^"]+)"', page)
        assert {"main.js", "style.css", "icon.svg"} <= set(named)
        for name in named:
            async with house.session.get(f"{house.address}/{name}") as answer:
                assert answer.status == 200, name
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                text = await answer.text()
            for module in re.findall(r'from "\./([^"]+)"', text):
                assert module in named, f"{name} takes {module}, which the page does not load beforehand"
        async with house.session.get(house.address, headers={"If-None-Match": f'"{house.view.page}"'}) as answer:
            assert answer.status == 304
        for missing in ("nothing.js", "../server.py", "%2e%2e/guard.py", "index.HTML"):
            async with house.session.get(f"{house.address}/{missing}") as answer:
                assert answer.status == 404
                assert "Content-Security-Policy" in answer.headers
    folder = resources.files("taps.view").joinpath("page")
    for entry in folder.iterdir():
        text = entry.read_text().replace("http://www.w3.org/2000/svg", "").replace("https://msgpack.org", "")
        assert not re.search(r"https?://|//cdn|@import|\son[a-z]+=|<style|style=\"|innerHTML|eval\(", text), entry.name


async def test_a_name_that_is_not_ours_is_not_answered(tmp_path: Path) -> None:
    async with serving(tmp_path) as house:
        for host, status in (("evil.example", 421), ("evil.example:8090", 421), ("localhost:1", 200), ("[::1]", 200)):
            async with house.session.get(house.address, headers={"Host": host}) as answer:
                assert answer.status == status, host
        for origin in ("http://evil.example", "null", "http://localhost:1", "http://127.0.0.1"):
            with pytest.raises(WSServerHandshakeError) as refused:
                await house.session.ws_connect(f"{house.address}/ws", headers={"Origin": origin})
            assert refused.value.status == 403, origin
        async with house.page(Origin=house.address) as page:
            assert (await page.welcome())["kind"] == "welcome"


async def test_without_the_token_one_may_not_look_from_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "WRONG_TOKEN_S", 0.01)

    async with serving(tmp_path, guard=Guard("0.0.0.0", TOKEN)) as house:
        for token in (None, TOKEN[:-1], "", 7, TOKEN * 9):
            async with house.page(token) as page:  # type: ignore[arg-type]  # as a stranger may send it
                assert (await page.welcome())["what"] == "token"
                assert not await page.read()
        async with house.page(TOKEN) as page:
            told = await page.welcome()
            assert (told["kind"], told["orders"]) == ("welcome", {})


async def test_what_the_stream_tells_is_handed_on(tmp_path: Path) -> None:
    async with serving(tmp_path) as house:
        async with house.page() as page:
            told = await page.welcome()
            assert (told["name"], told["states"]["3"][0]) == ("agv", "TRACKING")
            assert (await page.until("daemon"))["up"]
            house.stream.publish(snapshot(1))
            house.stream.on_scan(raw_scan())
            pose = await page.until("pose")
            assert (pose["pose"], pose["state_name"]) == ([0.01, 0.0, 0.1], "TRACKING")
            scan = await page.until("scan")
            assert np.frombuffer(scan["ranges"], "<f4")[0] == pytest.approx(1.0)
            house.stream.place = lambda keyframe: (float(keyframe), 2.0, 3.0)
            house.stream.publish(snapshot(2, loop_counter=1, loop_new=9, loop_old=4, loop_residual=0.02))
            loop = await page.until("loop")
            assert (loop["at_new"], loop["at_old"]) == ([9.0, 2.0, 3.0], [4.0, 2.0, 3.0])
        async with house.page() as late:
            await late.welcome()
            rows = await late.until("history")
            assert rows[0][:4] == [pytest.approx(100.025), 0.01, 0.0, 0.1]
            assert rows[0][viewers.History.COLUMNS.index("used")] in (None, 2)
            assert [one["counter"] for one in await late.until("loops")] == [1]
            assert (await late.until("pose"))["seq"] == 2


async def test_a_daemon_that_goes_and_comes_again(tmp_path: Path) -> None:
    async with serving(tmp_path) as house, house.page() as page:
        await page.welcome()
        first = await page.until("daemon", lambda told: told["up"])
        for client in list(house.stream.clients):
            client.drop()
        assert "closed the stream" in (await page.until("daemon", lambda told: not told["up"]))["why"]
        again = await page.until("daemon", lambda told: told["up"])
        assert again["session"] == first["session"] + 1


async def test_a_daemon_of_another_version_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(tmp_path) as house:
        monkeypatch.setattr(daemon_stream, "SCHEMA", 2)
        async with house.page() as page:
            await page.welcome()
            await page.until("daemon", lambda told: told["up"])
            for client in list(house.stream.clients):
                client.drop()
            await page.until("daemon", lambda told: "version 2 of the stream" in told["why"])


async def test_too_many_browsers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "VIEWERS", 1)

    async with serving(tmp_path) as house:
        async with house.page() as page:
            await page.welcome()
            async with house.page() as other:  # in words: a page cannot read why a handshake failed
                refused = await other.welcome()
                assert (refused["kind"], refused["what"]) == ("refused", "full")
                assert not await other.read()
        async with house.page() as other:
            assert (await other.welcome())["kind"] == "welcome", "one has gone"


@pytest.mark.parametrize("words", ["no JSON", "[1]", '{"order": "save_map"', "[" * 3000, r'{"order": "\ud800"}'])
async def test_nonsense_ends_a_connection_and_nothing_else(
    tmp_path: Path, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(tmp_path) as house, house.page() as page, house.page() as other:
        await page.welcome()
        await other.welcome()
        await page.socket.send_str(words)
        while await page.read():
            pass
        house.stream.publish(snapshot(1))
        await other.until("pose")
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR], "it is no defect of ours"


async def test_a_page_that_is_closed_while_it_is_greeted_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    greet, requests = server.welcome, list[Any]()

    def closed(*told: Any) -> dict[str, Any]:
        requests[0].transport.abort()
        return greet(*told)

    async with serving(tmp_path) as house:
        monkeypatch.setattr(server, "_limit_buffers", requests.append)
        monkeypatch.setattr(server, "welcome", closed)
        async with house.page() as page:
            while await page.read():
                pass
        monkeypatch.setattr(server, "welcome", greet)
        async with house.page() as other:
            await other.welcome()
    assert len(requests) == 2
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


async def test_a_browser_that_takes_nothing_gets_the_latest() -> None:
    viewer = viewers.Viewer(1)
    for number in range(100):
        viewer.put("pose", viewers.frame("pose", number))
        viewer.put("loop", viewers.frame("loop", number), once=True)
        viewer.put_tiles({"side": 2}, [((0, 0), bytes([number])), ((number % 3, 1), bytes(40_000))])
    message = viewer.next_message()
    assert message is not None
    told = msgspec.msgpack.decode(message)
    loops = [one["data"] for one in told if one["topic"] == "loop"]
    assert loops == list(range(100 - viewers.KEPT, 100))
    assert [one["data"] for one in told if one["topic"] == "pose"] == [99]
    tiles = [one for one in told if one["topic"] == "map"]
    assert tiles[0]["data"]["tiles"][0] == [0, 0, bytes([99])]
    assert viewer.pending.is_set()  # there are more tiles than fit into one message
    rest = viewer.next_message()
    assert rest is not None
    assert len(msgspec.msgpack.decode(rest)[0]["data"]["tiles"]) == 1
    assert viewer.next_message() is None
    assert viewer.replaced == 99 + 100 - viewers.KEPT


async def test_little_that_is_old_is_on_its_way_to_a_slow_browser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "PACE_S", 0.001)
    scan = {"seq": 1, "t_mono": 1.0, "bearing_first": 0.0, "bearing_step": 0.01, "ranges": bytes(40_000)}
    told = msgspec.convert(scan, Scan)

    async with serving(tmp_path) as house:
        host, port = house.address.removeprefix("http://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port), limit=1 << 14)
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        head = f"GET /ws HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        writer.write(f"{head}Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n\r\n".encode())
        writer.write(b"\x81\x82\0\0\0\0{}")  # its first words, masked with nothing
        await reader.readuntil(b"welcome")
        for _ in range(300):  # 12 MB
            house.view.hub.distribute(told)
            await asyncio.sleep(0.002)
        house.view.hub.broadcast("row", "the end")
        came = 0
        while b"the end" not in (data := await asyncio.wait_for(reader.read(1 << 16), 5.0)):
            came += len(data)
        assert 80_000 < came < 1_500_000
        writer.close()


async def test_what_cannot_be_shown_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "TRY_AGAIN_S", 0.01)

    async with serving(tmp_path) as house, house.page() as page:
        await page.welcome()
        monkeypatch.setattr(house.view.hub, "distribute", lambda data: 1 / 0)
        house.stream.publish(snapshot(1))
        await page.until("daemon", lambda told: "internal error" in told["why"])
        monkeypatch.undo()
        await page.until("daemon", lambda told: told["up"])
        await until(lambda: house.stream.wanted("pose"))
        house.stream.publish(snapshot(2))
        await page.until("pose")


async def test_a_newcomer_gets_every_tile(tmp_path: Path) -> None:
    async with serving(tmp_path) as house:
        hub = house.view.hub
        about = {"map_id": 1, "resolution": 0.05, "side": 128, "unit": 0.1}
        tiles = [(column, 0, bytes(50_000)) for column in range(5)]
        hub.distribute(msgspec.convert({**about, "version": 1, "more": False, "tiles": tiles}, MapTiles))
        async with house.page() as page:
            await page.welcome()
            seen: set[int] = set()
            while len(seen) < 5:
                told = await page.until("map")
                assert told["resolution"] == 0.05
                seen |= {tile[0] for tile in told["tiles"]}


async def test_a_newcomer_after_many_loops_is_told_how_things_stand(tmp_path: Path) -> None:
    hub, viewer = viewers.Hub(), viewers.Viewer(1)
    for number in range(2 * viewers.KEPT):
        hub.distribute(Loop(t_mono=float(number), counter=number))
    hub.disconnected("no daemon listens there")
    hub.welcome(viewer)
    message = viewer.next_message()
    assert message is not None
    told = msgspec.msgpack.decode(message)
    assert [one["topic"] for one in told] == ["daemon", "history", "loops"]  # no loop that happens now
    assert not told[0]["data"]["up"]
    assert [one["counter"] for one in told[2]["data"]][-1] == 2 * viewers.KEPT - 1
    hub.distribute(Loop(t_mono=1e3, counter=1000))
    message = viewer.next_message()
    assert message is not None
    assert [one["topic"] for one in msgspec.msgpack.decode(message)] == ["loop"]


async def test_the_state_is_told_once_each(tmp_path: Path) -> None:
    async with serving(tmp_path) as house, house.page() as page:
        await page.welcome()
        for number, state in enumerate((State.MAPPING, State.MAPPING, State.TRACKING)):
            house.stream.publish(snapshot(number, state=state))
        assert (await page.until("state"))["state_name"] == "MAPPING"
        assert (await page.until("state"))["state_name"] == "TRACKING"


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

"""The local stream: what is said, to whom, and what a slow, rude or dead client costs (nothing)."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import re
import socket
import sys
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, cast

import msgspec
import numpy as np
import pytest

from daemon.publish.stream import server as stream_server
from daemon.publish.stream import session as stream_session
from daemon.publish.stream.server import Client, StreamServer, scan_message
from daemon.snapshot import Snapshot, State
from hal.errors import DeviceRefused
from hal.lidar import VALID, LidarGeometry, RawScan
from tests.daemon.publish.network import Wire

ROOT = Path(__file__).parents[4]
GEOMETRY = LidarGeometry("m", "s", "f", 1440.0, 540.0, 0, 1080, 23, 60000, 0.001, 0.025, 0.0)
SNAPSHOT = Snapshot(7, 1.0, 1.1, 2.0, State.TRACKING, 3, pose=(1.0, 2.0, 3.0))


def raw_scan(seq: int = 5) -> RawScan:
    code = np.array([VALID, 8, VALID], np.int32)
    return RawScan(GEOMETRY, seq, 0.0, 4.0, 1e-3, 0, 540, 4, np.array([1000, 0, 2500], np.int32), code)


def serve(path: Path) -> StreamServer:
    return StreamServer(path, "agv", lambda reason: (f"meaning {reason}", "remedy"))


class Tap:
    """A client of the tests; closed when the test ends."""

    OPEN: ClassVar[list[Tap]] = []

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.OPEN.append(self)

    async def frame(self) -> dict[str, Any]:
        length = int.from_bytes(await asyncio.wait_for(self.reader.readexactly(4), 5.0), "little")
        decoded: dict[str, Any] = msgspec.msgpack.decode(await self.reader.readexactly(length))
        return decoded

    def ask(self, message: object) -> None:
        body = msgspec.msgpack.encode(message)
        self.writer.write(len(body).to_bytes(4, "little") + body)


async def until(happened: Callable[[], bool]) -> None:
    for _ in range(5000):
        if happened():
            return
        await asyncio.sleep(0.001)
    raise AssertionError("it does not happen")


async def connected(server: StreamServer) -> Tap:
    tap = Tap(*await asyncio.open_unix_connection(str(server.path)))
    assert (await tap.frame())["topic"] == "hello"
    return tap


async def wanting(server: StreamServer, *topics: str) -> Tap:
    tap = await connected(server)
    tap.ask({"want": list(topics)})
    await until(lambda: any(client.wants == frozenset(topics) for client in server.clients))
    return tap


@contextlib.asynccontextmanager
async def running(path: Path) -> AsyncIterator[StreamServer]:
    """A server, and taps that are closed before it ends."""
    server = serve(path)
    serving = asyncio.create_task(server.run())
    await until(lambda: serving.done() or path.is_socket())
    try:
        yield server
    finally:
        for tap in Tap.OPEN:
            tap.writer.close()
        await asyncio.gather(*(tap.writer.wait_closed() for tap in Tap.OPEN), return_exceptions=True)
        Tap.OPEN.clear()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def test_a_client_gets_what_it_asked_for(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        tap = await wanting(server, "pose", "scan", "state")
        server.publish(SNAPSHOT)
        server.on_scan(raw_scan())
        pose, state, scan = [await tap.frame() for _ in range(3)]
        assert pose["topic"] == "pose"
        assert (pose["data"]["pose"], pose["data"]["state_name"]) == ([1.0, 2.0, 3.0], "TRACKING")
        assert (state["data"]["meaning"], state["data"]["remedy"]) == ("meaning 3", "remedy")
        ranges = np.frombuffer(scan["data"]["ranges"], "<f4")
        assert np.array_equal(ranges, np.array([1.0, np.nan, 2.5], np.float32), equal_nan=True)
        beyond = replace(raw_scan(), code=np.array([VALID, GEOMETRY.dmax + 1, 0], np.int32))
        (near, *rest) = np.frombuffer(cast("bytes", scan_message(beyond)["ranges"]), "<f4")
        assert np.array_equal((near, *rest), (1.0, np.inf, np.nan), equal_nan=True)
        assert scan["data"]["bearing_step"] == pytest.approx(np.pi / 180.0)


async def test_states_and_loops_are_said_when_they_change(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        tap = await wanting(server, "state", "loop")
        for seq, loops in enumerate((0, 0, 1, 1, 2)):
            server.publish(replace(SNAPSHOT, seq=seq, loop_counter=loops, loop_new=10 + loops, loop_old=1))
        frames = [await tap.frame() for _ in range(3)]
        assert [frame["topic"] for frame in frames] == ["state", "loop", "loop"]
        assert [frame["data"]["keyframe_new"] for frame in frames[1:]] == [11, 12]


async def test_who_asks_for_the_state_is_told_it_at_once(tmp_path: Path) -> None:
    """It may not change for hours."""

    async with running(tmp_path / "stream") as server:
        early = await wanting(server, "state")
        server.publish(SNAPSHOT)
        late = await connected(server)
        late.ask({"want": ["state"]})
        assert (await early.frame())["data"] == (await late.frame())["data"]
        late.ask({"want": ["state", "loop"]})
        server.publish(replace(SNAPSHOT, seq=8, state=State.LOST))
        assert (await late.frame())["data"]["state_name"] == "LOST", "and not again with the next request"


def test_without_clients_nothing_is_encoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = serve(tmp_path / "stream")
    monkeypatch.setattr(stream_server, "encode", lambda message: pytest.fail("encoded"))
    server.publish(SNAPSHOT)
    server.on_scan(raw_scan())


async def test_a_slow_client_gets_the_latest_and_every_event_and_others_all(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        slow, quick = await wanting(server, "pose", "loop"), await wanting(server, "pose")
        seen: list[int] = []

        async def listen() -> None:
            while True:
                seen.append((await quick.frame())["data"]["seq"])

        listening = asyncio.create_task(listen())
        for seq in range(3000):
            server.publish(replace(SNAPSHOT, seq=seq, loop_counter=seq // 1000))
            if seq % 100 == 99:
                await until(lambda upto=seq: len(seen) == upto + 1)  # type: ignore[misc]  # bound per turn
        await until(lambda: len(seen) == 3000)
        stuck = next(client for client in server.clients if "loop" in client.wants)
        assert len(stuck._latest) == 1
        assert stuck.replaced > 1000
        listening.cancel()
        assert seen == list(range(3000))
        frames: list[dict[str, Any]] = []
        while not frames or frames[-1]["data"].get("seq") != 2999:
            frames.append(await slow.frame())
        assert [frame["data"]["counter"] for frame in frames if frame["topic"] == "loop"] == [1, 2]
        assert len(frames) < 2000


async def test_a_client_that_never_reads_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_session, "STUCK_S", 0.05)

    async with running(tmp_path / "stream") as server:
        tap = await wanting(server, "pose")
        tap.writer.transport.pause_reading()
        for seq in range(3000):
            server.publish(replace(SNAPSHOT, seq=seq))
        await until(lambda: not server.clients)


@pytest.mark.parametrize(
    ("request_", "part"),
    [
        (b"\xff\xff\xff\xff", "the limit is"),
        (b"\x01\x00\x00\x00\xc1", "the request is not a msgpack map"),
        (b"\x04\x00\x00\x00\x81\xa1\xff\xc0", "the request is not a msgpack map"),
        (b"\x01\x00\x00\x00\x80", "has no `want`"),
        ((4007).to_bytes(4, "little") + b"\x81\xa4want" + b"\x91" * 4000 + b"\xc0", "the request"),
        (b"\x08\x00\x00\x00\x81\xa4want\x91\xa0"[:12], None),
    ],
)
async def test_a_bad_request_is_told_and_ends_the_client_only(
    tmp_path: Path, request_: bytes, part: str | None
) -> None:
    async with running(tmp_path / "stream") as server:
        good = await wanting(server, "pose")
        tap = await connected(server)
        tap.writer.write(request_)
        if part is not None:
            answer = await tap.frame()
            assert answer["topic"] == "error"
            assert part in answer["text"]
            assert await tap.reader.read() == b""
        server.publish(SNAPSHOT)
        assert (await good.frame())["topic"] == "pose"


async def test_who_has_gone_is_sent_nothing_more(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It has hung up, which the event loop is going to tell; asyncio would warn of each further message."""
    async with running(tmp_path / "stream") as server:
        tap = await wanting(server, "scan")
        tap.writer.transport.abort()
        await asyncio.sleep(0)
        for number in range(20):
            server.on_scan(raw_scan(number))
        await until(lambda: not server.clients)
    assert caplog.text == ""


async def test_an_unknown_topic_is_named(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        tap = await connected(server)
        tap.ask({"want": ["pose", "weather"]})
        assert "weather; available: pose" in (await tap.frame())["text"]


@pytest.mark.virtual
async def test_many_requests_at_once_are_taken_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each may have the whole map sent anew: the loop goes on in between, and no more of them are read meanwhile."""
    asked: list[frozenset[str]] = []
    server = serve(Path("unused"))
    monkeypatch.setattr(server, "welcome", lambda client, fresh: asked.append(fresh))
    client = Client(server)
    wire = Wire(client)
    client.connection_made(wire)
    for turn in (1, 2):
        client.data_received((stream_server.framed({"want": []}) + stream_server.framed({"want": ["map"]})) * 50)
        assert (len(asked), wire.reading) == (100 * (turn - 1) + stream_session.REQUESTS_PER_TURN, False)
        await asyncio.sleep(2.0)
        assert (len(asked), wire.reading) == (100 * turn, True)
    assert asked == [frozenset(), frozenset({"map"})] * 100
    client.data_received(stream_server.framed({"want": []}) * 50)
    wire.close()
    await asyncio.sleep(2.0)
    assert len(asked) == 200 + stream_session.REQUESTS_PER_TURN, "who has gone asks no more"


async def test_too_many_clients_are_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_session, "CLIENTS", 2)
    processes = itertools.count(1)
    monkeypatch.setattr(stream_session, "credentials", lambda _: (next(processes),) * 2)

    async with running(tmp_path / "stream") as server:
        taps = [await connected(server) for _ in range(2)]
        late = Tap(*await asyncio.open_unix_connection(str(server.path)))
        assert "all 2 connections" in (await late.frame())["text"]
        taps[0].writer.close()
        await until(lambda: len(server.clients) < 2)
        await connected(server)


async def test_one_program_and_one_user_never_have_all_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def refused(server: StreamServer) -> str:
        tap = Tap(*await asyncio.open_unix_connection(str(server.path)))
        return str((await tap.frame())["text"])

    async with running(tmp_path / "stream") as server:
        for _ in range(16):
            await connected(server)
        assert {(client.process, client.user) for client in server.clients} == {(os.getpid(), os.geteuid())}
        assert await refused(server) == "this program uses 16 of 32 connections; close one"
        monkeypatch.setattr(stream_session, "credentials", lambda _: (1, os.geteuid()))
        for _ in range(8):
            await connected(server)
        assert await refused(server) == "this user's programs use 24 of 32 connections; close one"
        monkeypatch.setattr(stream_session, "credentials", lambda _: (2, 1 + os.geteuid()))
        for _ in range(8):
            await connected(server)
        assert await refused(server) == "all 32 connections are in use; close one"


async def test_a_path_left_by_a_dead_program_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "stream"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    async with running(path) as server:
        while not Tap.OPEN:
            with contextlib.suppress(ConnectionRefusedError):
                await connected(server)
            await asyncio.sleep(0.001)
    assert not path.exists()


async def test_a_path_in_use_is_refused(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        with pytest.raises(DeviceRefused, match="another program serves it"):
            await serve(server.path).run()
        await connected(server)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(DeviceRefused, match="give write access"):
        asyncio.run(serve(tmp_path / "stream").run())


def test_a_scan_message_names_everything_a_reader_needs() -> None:
    told = scan_message(raw_scan())
    assert set(told) == {
        *("seq", "t_mono", "bearing_first", "bearing_step", "ranges"),
        *("range_min", "range_max", "beam_dt", "period"),
    }
    assert (told["range_min"], told["range_max"], told["beam_dt"], told["period"]) == (0.023, 60.0, 0.0, 0.025)


async def test_the_reference_client_reads_it(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        command = [str(ROOT / "tools/clients/watch_stream.py"), str(server.path), "pose", "scan", "state", "faults"]
        server.publish(SNAPSHOT)
        server.on_faults(1.0, [(104, "no valid scan", "check the cable", 0)])
        process = await asyncio.create_subprocess_exec(sys.executable, *command, stdout=asyncio.subprocess.PIPE)
        assert process.stdout is not None
        hello = await asyncio.wait_for(process.stdout.readline(), 10.0)
        assert hello.startswith(b"this is lumiloop 'agv', process ")
        await until(lambda: any(client.wants for client in server.clients))
        assert await asyncio.wait_for(process.stdout.readline(), 10.0) == b"1.000 TRACKING: meaning 3 (remedy)\n"
        faults = await asyncio.wait_for(process.stdout.readline(), 10.0)
        assert faults == b"faults: 104 no valid scan (check the cable)\n"
        server.publish(SNAPSHOT)
        server.on_scan(raw_scan())
        pose = await asyncio.wait_for(process.stdout.readline(), 10.0)
        assert re.fullmatch(r"1\.000 TRACKING +x 1\.000 m, y 2\.000 m, yaw 3\.0000 rad\n", pose.decode())
        assert b"2 of 3 beams, nearest 1.00 m" in await asyncio.wait_for(process.stdout.readline(), 10.0)
        process.terminate()
        await process.wait()

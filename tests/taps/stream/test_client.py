"""The taps' client of the local stream: against the daemon's own server, and against whoever else may answer."""

import asyncio
import contextlib
import zlib
from contextlib import aclosing
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.config.paths import stream_path
from daemon.publish.stream import client, messages
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import TYPES, Frame, Hello, NotTheStream
from daemon.publish.stream.server import SCHEMA, TOPICS, StreamServer, framed
from daemon.snapshot import (
    Condition,
    CycleTiming,
    LightFix,
    LightLink,
    LightPicture,
    LinkUse,
    Part,
    Snapshot,
    State,
    Thread,
    Trust,
)
from hal.adc import Blemish, RawSamples
from tests.daemon.publish.stream.test_server import raw_scan, running
from tests.taps.serving import served

LINK = LightLink(5, 12, LinkUse.ACCEPTED, 1e-6, 0.01)
FULL = Snapshot(
    7,
    1.0,
    1.25,
    1000.0,
    State.TRACKING,
    3,
    pose=(1.0, 2.0, 3.0),
    covariance=(1.0, 0.0, 1.0, 0.0, 0.0, 1.0),
    light=LightPicture(LightFix.GOOD, 1, 0.9, links=(LINK,)),
    loop_counter=1,
    trust=Trust(horizontal_m=0.1, laser=True),
    pulse=CycleTiming(cycle=(1, 2, 3), stages=((1, 2, 3), None)),
    condition=Condition(5, (104,), down=frozenset({Part.LIDAR}), hanging=frozenset({Thread.MAP})),
)


async def first(told: Stream, kind: type[Frame | Lost]) -> Frame | Lost:
    async with asyncio.timeout(5.0):
        async with aclosing(told.frames()) as heard:
            async for frame in heard:
                if isinstance(frame, kind):
                    return frame
    raise AssertionError("it ended")


async def test_every_topic_arrives_with_its_type(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        seen: dict[type, Frame] = {}
        async with aclosing(Stream(server.path, tuple(set(TOPICS) - {"map"})).frames()) as heard:
            async for frame in heard:
                assert not isinstance(frame, Lost)
                seen[type(frame)] = frame
                if isinstance(frame, messages.Faults) and frame.t_mono is None:
                    tell_all(server)
                if isinstance(frame, messages.Raw):
                    break
        assert set(seen) == {Hello, *TYPES.values()} - {messages.MapTiles}
        pose, lights, scan = seen[messages.Pose], seen[messages.Lights], seen[messages.Scan]
        assert isinstance(pose, messages.Pose)
        assert (pose.state, pose.state_name, pose.meaning, pose.pose) == (3, "TRACKING", "meaning 3", (1.0, 2.0, 3.0))
        assert pose.utc(pose.t_mono) == 999.75
        assert pose.trust.horizontal_m == 0.1
        assert pose.pulse is not None
        assert pose.pulse.stages == ((1, 2, 3), None)
        assert pose.condition is not None
        assert (pose.condition.down, pose.condition.hanging) == ((Part.LIDAR,), (Thread.MAP,))
        assert isinstance(lights, messages.Lights)
        assert lights.links == (messages.Link(code=5, lamp_id=12, use=1, strength=1e-6, residual=0.01),)
        assert isinstance(scan, messages.Scan)
        np.testing.assert_array_equal(scan.ranges_m(), np.array([1.0, np.nan, 2.5], np.float32))


def tell_all(server: StreamServer) -> None:
    server.publish(FULL)
    server.on_scan(raw_scan())
    server.on_faults(2.0, [(104, "no valid scan", "check the cable", 0)])
    server.on_statistics(lambda: {"t_mono": 1.0, "cycles": 5, "of_tomorrow": [1]})
    server.on_raw("lidar", "rx", 1.5, b"\x00\xff")
    server.on_samples(RawSamples(1, 0.0, 0.1, 2.0, 22222.2, np.array([1, 513], np.uint16), 12, Blemish(0), 0.0))


async def test_a_daemon_that_goes_is_told_once_and_one_that_comes_is_greeted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "FIRST_RETRY_S", 0.01)
    path = tmp_path / "stream"
    seen: list[str] = []
    serving: asyncio.Task[None] | None = None
    async with asyncio.timeout(10.0), aclosing(Stream(path, ("pose",)).frames()) as heard:
        async for frame in heard:
            seen.append(type(frame).__name__)
            if isinstance(frame, Lost) and len(seen) == 1:
                assert "start `lumiloop run`" in frame.text
                serving = serve(path)
            elif isinstance(frame, Hello) and len(seen) == 2:
                assert serving is not None
                serving.cancel()
            elif len(seen) == 3:
                serving = serve(path)
            elif len(seen) == 4:
                break
    assert serving is not None
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    assert seen == ["Lost", "Hello", "Lost", "Hello"]


async def test_one_that_is_not_patient_ends(tmp_path: Path) -> None:
    (lost,) = [frame async for frame in Stream(tmp_path / "none", ("pose",), patient=False).frames()]
    assert isinstance(lost, Lost)


def test_a_daemon_of_another_name_is_named(tmp_path: Path) -> None:
    (tmp_path / "old.stream").touch()  # nobody listens there either

    async def body() -> str:
        async with await asyncio.start_unix_server(lambda *_: None, str(tmp_path / "agv.stream")):
            lost = await first(Stream(tmp_path / "lumiloop.stream", ("pose",)), Lost)
            assert isinstance(lost, Lost)
            return lost.text

    said = asyncio.run(body())
    assert "agv runs here: `--set name=agv`, or `--config`" in said
    assert "old" not in said.partition("no daemon listens there")[2]


def serve(path: Path) -> asyncio.Task[None]:
    return asyncio.ensure_future(StreamServer(path, "agv", lambda _: ("", "")).run())


def answering(path: Path, said: bytes, patience_s: float = 5.0) -> str:
    """What the client says of a server that says this and stays silent."""

    writers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        writer.write(said)
        await reader.read()

    async def body() -> str:
        server = await asyncio.start_unix_server(serve, str(path))
        try:
            async with asyncio.timeout(patience_s):
                frame = await first(Stream(path, ("pose",)), Lost)
                assert isinstance(frame, Lost)
                return frame.text
        except NotTheStream as error:
            return str(error)
        finally:
            server.close()
            for writer in writers:
                writer.transport.abort()
            await asyncio.sleep(0.01)

    return asyncio.run(body())


HELLO = {"topic": "hello", "schema": SCHEMA, "name": "agv", "pid": 1, "topics": {}}


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (framed({**HELLO, "schema": SCHEMA + 1}), "install both from the same release"),
        (
            framed({"topic": "error", "text": "all 32 connections are in use; close one"}),
            "all 32 connections are in use",
        ),
        (b"HTTP/1.0 400 Bad Request\r\n", "this is not a lumiloop stream"),
        (framed({"topic": "pose", "data": {}}), "cannot be decoded"),
        (framed({"topic": "of tomorrow", "data": {}}), "sends no hello message"),
        (framed(HELLO) + b"\x03\x00\x00\x00abc", "cannot be decoded"),
    ],
)
def test_who_is_no_daemon_of_this_version_is_told(tmp_path: Path, said: bytes, text: str) -> None:
    assert text in answering(tmp_path / "s", said)


def test_one_that_never_greets_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "SILENT_S", 0.05)
    assert "the daemon does not respond" in answering(tmp_path / "s", b"")


def test_a_topic_of_tomorrow_is_skipped() -> None:
    assert messages.decode(msgspec.msgpack.encode({"topic": "of tomorrow", "data": 5})) is None


def test_a_wrong_topic_is_no_request() -> None:
    with pytest.raises(ValueError, match="no such topic: poses; available: pose"):
        Stream(Path("x"), ("poses",))


def test_tiles_unfold_and_what_is_none_is_refused() -> None:
    tiles = messages.MapTiles(map_id=1, resolution=0.05, side=2, unit=0.1, version=1, more=False, tiles=())
    np.testing.assert_array_equal(tiles.cells(zlib.compress(b"\x01\x02\x03\xff")), [[1, 2], [3, -1]])
    for packed, text in ((b"abc", "inflated"), (zlib.compress(bytes(5)), "cells"), (zlib.compress(b""), "cells")):
        with pytest.raises(NotTheStream, match=text):
            tiles.cells(packed)


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_frame_or_refused(body: bytes) -> None:
    with contextlib.suppress(NotTheStream):
        messages.decode(body)


def test_the_path_is_the_daemons(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    monkeypatch.setattr("daemon.config.paths.SERVICE", tmp_path / "run")
    assert stream_path("agv") == tmp_path / "agv.stream"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "agv.stream").touch()
    assert stream_path("agv") == tmp_path / "run" / "agv.stream", "a person looks at the service"
    (tmp_path / "agv.stream").touch()
    assert stream_path("agv") == tmp_path / "agv.stream"


async def test_a_folder_that_is_not_open_to_us_yet_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service's folder belongs to the group of its listeners a moment after it was made."""

    def shut(path: Path) -> bool:
        if path.parent == tmp_path / "run":
            raise PermissionError(13, "Permission denied", str(path))
        return False

    monkeypatch.setattr("daemon.config.paths.SERVICE", tmp_path / "run")
    monkeypatch.setattr(Path, "exists", shut)
    assert stream_path("agv") == tmp_path / "run" / "agv.stream"
    assert [type(frame) for frame in [frame async for frame in Stream("agv", ("pose",), patient=False).frames()]] == [
        Lost
    ]


def test_types_stand_for_every_topic() -> None:
    assert set(TYPES) == set(TOPICS)


async def test_a_daemon_of_a_name_is_found_wherever_it_comes_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A person starts to listen, and the system's service is started later."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "own"))
    monkeypatch.setattr("daemon.config.paths.SERVICE", tmp_path)
    async with asyncio.timeout(10.0), contextlib.aclosing(Stream("agv", ("pose",)).frames()) as frames:
        first = await anext(frames)
        assert isinstance(first, Lost)
        assert str(tmp_path / "own" / "agv.stream") in first.text
        with served(tmp_path / "agv.stream"):
            assert isinstance(await anext(frames), Hello)

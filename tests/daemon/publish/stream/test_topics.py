"""Topics of the local stream: rates, contents and fields."""

import asyncio
import zlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.maps import tiles as maps_tiles
from daemon.maps.tiles import MapTiles
from daemon.publish.stream import server as stream_server
from daemon.publish.stream import session as stream_session
from daemon.publish.stream import ticker as stream_ticker
from daemon.publish.stream.fields import FIELDS, RECORDS
from daemon.publish.stream.server import SIDE, TOPICS, StreamServer
from daemon.snapshot import LightPicture
from estimator import pipeline
from estimator.mapping import grid_patches, live_grid
from estimator.measurements import UNLIMITED, Scan
from estimator.state import State
from hal.adc import Blemish, RawSamples
from tests.daemon.publish.stream.test_server import SNAPSHOT, Tap, connected, raw_scan, running, until, wanting
from tests.daemon.runtime.test_cycle import Bench, on_bench
from tests.daemon.support.room import HALF_X, HALF_Y, ranges_m

SILENT = (104, "no valid scan", "check the cable", 0)
STALLED = (301, "stalled", "", 306)


async def test_faults_are_told_at_first_and_when_they_change(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        server.on_faults(1.0, [SILENT])
        tap = await wanting(server, "faults")
        first = await tap.frame()
        assert [one["fault"] for one in first["data"]["present"]] == [104]
        server.on_faults(1.5, [SILENT, STALLED])
        second = await tap.frame()
        assert [(one["fault"], one["cause"]) for one in second["data"]["present"]] == [(104, 0), (301, 306)]
        server.on_faults(2.0, [SILENT, STALLED])
        server.on_faults(3.0, [])
        over = await tap.frame()
        assert over["data"] == {"t_mono": 3.0, "present": []}


async def test_raw_bytes_are_told_as_they_pass_and_a_stuck_client_gets_the_latest_and_a_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_session, "BUFFER_BYTES", 4096)

    async with running(tmp_path / "stream") as server:
        tap = await wanting(server, "raw", "state")
        server.on_raw("lidar", "rx", 1.5, b"\x00\xff")
        server.on_samples(RawSamples(1, 0.0, 0.1, 2.0, 22222.2, np.array([1, 513], np.uint16), 12, Blemish(0), 0.0))
        lidar, photodiode = (await tap.frame())["data"], (await tap.frame())["data"]
        assert lidar == {"device": "lidar", "kind": "rx", "t_mono": 1.5, "bytes": b"\x00\xff"}
        assert (photodiode["bytes"], photodiode["t_mono"]) == (b"\x01\x00\x01\x02", 2.0)
        for number in range(2000):
            server.on_raw("lidar", "rx", float(number), bytes(1000))
        (client,) = server.clients
        assert client.stuck
        times = []
        while not times or times[-1] < 1999.0:
            frame = await tap.frame()
            times.append(frame["data"]["t_mono"])
        assert times == sorted(times)
        assert len(times) + frame["replaced"] == 2000


class Robot:
    """An estimator that drives through the room of the tests."""

    def __init__(self) -> None:
        self.state: State = pipeline.new_state(pipeline.Settings())
        self.scans = 0

    def drive(self, scans: int) -> None:
        bearing = np.linspace(-3.1, 3.1, 373)
        for _ in range(scans):
            t = 0.1 * self.scans
            x, y = 0.9 * np.sin(0.2 * t), 0.5 * (1.0 - np.cos(0.2 * t))
            seen = ranges_m(bearing, np.full(373, x), np.full(373, y))
            hit = np.ones(373, np.uint8)
            scan = Scan(t, t, self.scans, np.zeros(3), bearing, seen, hit, 0.01)
            pipeline.step(self.state, (scan,), UNLIMITED)
            self.scans += 1


async def drawn(server: StreamServer, tiles: MapTiles) -> None:
    """Until there is nothing left to be drawn."""
    loop = asyncio.get_running_loop()
    for _ in range(20):
        tiles.follow(loop)
        await until(lambda: not tiles._busy)


async def received(tap: Tap) -> dict[tuple[int, int], np.ndarray]:
    """The tiles of all frames that are there."""
    found = {}
    while True:
        data = (await tap.frame())["data"]
        for column, row, cells in data["tiles"]:
            found[column, row] = np.frombuffer(zlib.decompress(cells), np.int8).reshape(data["side"], data["side"])
        if not data["more"]:
            return found


def known(tiles: dict[tuple[int, int], np.ndarray]) -> tuple[float, float]:
    """Width and height, m, of what is occupied."""
    at = [
        (column * stream_server.SIDE + i, row * stream_server.SIDE + j)
        for (column, row), cells in tiles.items()
        for j, i in np.argwhere(cells > 0).tolist()
    ]
    wide, tall = (0.05 * np.ptp(np.array(at), axis=0)).tolist()
    return wide, tall


async def test_the_map_comes_whole_at_first_and_then_what_has_changed(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        robot = Robot()
        tiles = server.tiles = MapTiles(lambda: robot.state, server.on_tiles)
        robot.drive(40)
        await drawn(server, tiles)
        tap = await wanting(server, "map")
        whole = await received(tap)
        wide, tall = known(whole)
        assert wide == pytest.approx(2 * HALF_X, abs=0.2)
        assert tall == pytest.approx(2 * HALF_Y, abs=0.2)
        robot.drive(60)
        late = await connected(server)
        await drawn(server, tiles)
        changed = await received(tap)
        assert changed
        late.ask({"want": ["map"]})
        anew = await received(late)
        assert {**whole, **changed}.keys() == anew.keys()
        tiles.close()


async def test_another_map_empties_the_tiles_of_the_one_before(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        robot = Robot()
        tiles = server.tiles = MapTiles(lambda: robot.state, server.on_tiles)
        robot.drive(30)
        await drawn(server, tiles)
        assert any(zlib.decompress(cells).strip(b"\0") for _, cells in tiles.tiles.values())
        robot.state = pipeline.new_state(pipeline.Settings())
        await drawn(server, tiles)
        assert not any(zlib.decompress(cells).strip(b"\0") for _, cells in tiles.tiles.values())
        tiles.close()


async def test_a_map_that_was_closed_is_drawn_anew_when_it_is_followed_again(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        robot = Robot()
        tiles = server.tiles = MapTiles(lambda: robot.state, server.on_tiles)
        robot.drive(30)
        tiles.follow(asyncio.get_running_loop())
        tiles.close()  # in the middle of it
        await drawn(server, tiles)
        assert tiles.tiles
        assert not tiles.error
        tiles.close()


async def test_drawing_that_has_failed_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fails = [True, True]

    def advance(task: live_grid.Task) -> live_grid.Progress:
        if fails and fails.pop():
            raise MemoryError
        return draw(task)

    draw = live_grid.advance
    monkeypatch.setattr("estimator.advance", advance)
    monkeypatch.setattr(maps_tiles, "AGAIN_S", 0.05)

    async with running(tmp_path / "stream") as server:
        robot = Robot()
        tiles = server.tiles = MapTiles(lambda: robot.state, server.on_tiles)
        robot.drive(30)
        loop = asyncio.get_running_loop()
        tiles.follow(loop)
        await until(lambda: bool(tiles.error))
        tiles.follow(loop)
        assert not tiles.busy, "not at once"
        tiles.forget()
        assert not tiles.error
        tiles.follow(loop)
        await until(lambda: bool(tiles.error))
        await asyncio.sleep(0.06)
        await drawn(server, tiles)
        assert tiles.tiles
        assert not tiles.error
        tiles.close()
    assert caplog.text.count("the daemon tries again") == 2


async def test_a_stuck_client_gets_the_tiles_when_it_has_caught_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_session, "BUFFER_BYTES", 1024)
    monkeypatch.setattr(stream_server, "TILE_BYTES", 1)

    async with running(tmp_path / "stream") as server:
        tiles = server.tiles = MapTiles(lambda: None, server.on_tiles)
        noise = np.random.default_rng(1)
        for column in range(200):
            cells = noise.integers(-50, 50, (stream_server.SIDE, stream_server.SIDE)).astype(np.int8)
            tiles.tiles[column, 0] = 1, zlib.compress(cells.tobytes(), 1)
        tap = await wanting(server, "map")
        (client,) = server.clients
        assert client.stuck
        first = await tap.frame()
        assert first["data"]["more"]
        tiles.tiles[199, 0] = 2, zlib.compress(bytes(stream_server.SIDE**2))
        assert len(await received(tap)) == 199
        assert client.shown == (2, (199, 0))


def test_side_and_unit_are_those_of_the_estimator() -> None:
    assert (stream_server.SIDE, stream_server.UNIT) == (grid_patches.SIDE, grid_patches.UNIT)


def test_statistics_are_numbers() -> None:
    bench = on_bench(lambda bench: bench.drive(0, 5))
    figures = stream_ticker.figures(bench.cycle.facts())
    assert figures["t_mono"] == bench.cycle.parts.clock.now()
    assert figures["cycles"] == bench.cycle.cycles > 0
    assert all(value is None or isinstance(value, int | float) for value in figures.values())


def expected(topic: str) -> set[str]:
    record = RECORDS.get(topic)
    return set(FIELDS[topic]) | (set() if record is None else {field.name for field in fields(record)})


@pytest.fixture
def bench() -> Bench:
    """A cycle that has driven; it needs an event loop of its own."""
    return on_bench(lambda bench: bench.drive(0, 3))


async def test_every_topic_tells_what_is_written_down(bench: Bench, tmp_path: Path) -> None:
    told: dict[str, Any] = {}
    async with running(tmp_path / "stream") as server:
        server.tiles = MapTiles(lambda: None, server.on_tiles)
        server.tiles.tiles[0, 0] = 1, zlib.compress(bytes(SIDE**2))
        tap = await connected(server)
        tap.ask({"want": list(TOPICS)})
        for _ in range(3):  # faults, the map, and how things stand
            frame = await tap.frame()
            told[frame["topic"]] = frame["data"]
            if {"faults", "map"} <= told.keys():
                break
        server.publish(replace(SNAPSHOT, light=LightPicture(), loop_counter=1))
        server.on_scan(raw_scan())
        server.on_statistics(lambda: stream_ticker.figures(bench.cycle.facts()))
        server.on_raw("lidar", "rx", 1.5, b"x")
        while told.keys() != set(TOPICS):
            frame = await tap.frame()
            told[frame["topic"]] = frame["data"]
        server.on_samples(RawSamples(1, 0.0, 0.1, 2.0, 22222.2, np.array([1], np.uint16), 12, Blemish(0), 0.0))
        told["raw of samples"] = (await tap.frame())["data"]
        server.tiles.close()
    assert {topic: set(data) for topic, data in told.items()} == {
        **{topic: expected(topic) for topic in TOPICS},
        "raw of samples": expected("raw") | expected("raw of samples"),
    }


async def test_the_first_frame_and_the_last(tmp_path: Path) -> None:
    async with running(tmp_path / "stream") as server:
        assert set(server.hello()) == expected("hello") | {"topic"}
        tap = await connected(server)
        tap.ask({"want": ["weather"]})
        assert set(await tap.frame()) == expected("error") | {"topic"}

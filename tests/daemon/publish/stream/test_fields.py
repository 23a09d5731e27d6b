"""What each topic of the stream tells has the fields that are written down of it, and no others."""

from __future__ import annotations

import zlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.maps.tiles import MapTiles
from daemon.publish.stream import ticker as stream_ticker
from daemon.publish.stream.fields import FIELDS, RECORDS
from daemon.publish.stream.server import SIDE, TOPICS
from daemon.snapshot import LightPicture
from hal.adc import Blemish, RawSamples
from tests.daemon.publish.stream.test_server import SNAPSHOT, connected, raw_scan, running
from tests.daemon.runtime.test_cycle import Bench, on_bench


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

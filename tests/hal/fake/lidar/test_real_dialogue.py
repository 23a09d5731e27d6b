"""The fake says what a recorded real URG-04LX said, to the byte."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from hal.fake.lidar.models import URG_04LX, Unit
from hal.fake.lidar.scan import FakeScan
from hal.fake.lidar.scip_encoder import distances as encoded
from hal.fake.lidar.scip_encoder import measurement, reply
from tests.hal.fake.bench import Reply, Talk, read, virtual


@pytest.fixture
def said(log_root: Path) -> list[bytes]:
    """Every reply of the sensor. Records: 8 bytes of time, 4 of length (big-endian), the bytes."""
    raw = (log_root / "scip" / "example_urg_04lx.logr").read_bytes()
    text, at = b"", 0
    while at < len(raw):
        _, length = struct.unpack_from(">QI", raw, at)
        text += raw[at + 12 : at + 12 + length]
        at += 12 + length
    assert text.endswith(b"\n\n")
    return [part + b"\n\n" for part in text[:-2].split(b"\n\n")]


def scans(said: list[bytes]) -> list[tuple[bytes, Reply]]:
    return [(data, read(data)) for data in said if data[:2] in (b"GD", b"MD")]


def test_scan_to_the_byte(said: list[bytes]) -> None:
    found = [(data, scan) for data, scan in scans(said) if scan.lines]
    assert found
    for data, scan in found:
        ranges = np.array(scan.values(), dtype=np.int32)
        assert ranges.size == 682
        assert reply(scan.echo.encode(), scan.status, measurement(scan.tick, encoded(ranges))) == data


def test_the_same_words_get_the_same_replies(said: list[bytes]) -> None:
    (data, scan), *_ = scans(said)
    ranges = np.zeros(URG_04LX.steps, dtype=np.int32)
    ranges[44:] = scan.values()

    async def scene(talk: Talk) -> dict[str, bytes]:
        out = {}
        for line in ("VV", "PP", "BM", "BM", "CR00", scan.echo):
            await talk.ask(line, 2.0)
            out[line] = talk.raw
        return out

    got = virtual(scene, URG_04LX, unit=Unit(serial="H0706400"), source=lambda _t: FakeScan(ranges))
    for line in ("VV", "PP", "BM", "CR00"):
        assert got[line] in said
    ours, theirs = got[scan.echo].split(b"\n"), data.split(b"\n")
    assert ours[:2] + ours[3:] == theirs[:2] + theirs[3:]  # all but the stamp

"""The encoder of the fake: against examples worked out by hand and against a real sensor's dialogue."""

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from hal.fake.lidar import scip_encoder as scip
from hal.fake.lidar.models import URG_04LX, Unit
from hal.fake.lidar.scan import FakeScan
from hal.fake.lidar.scip_encoder import distances as encoded
from hal.fake.lidar.scip_encoder import measurement, reply
from tests.hal.fake.bench import Reply, Talk, read, virtual

TIME = 0x123456


def ints(*values: int) -> npt.NDArray[np.int32]:
    return np.array(values, dtype=np.int32)


@pytest.mark.parametrize("value", [-1, 4096])
def test_number_that_does_not_fit_is_refused(value: int) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        scip.number(value, 2)


NONE = np.zeros((3, 0), dtype=np.int32)
D = ints(1234, 5432, 30000)
E = ints(1234, 30000, 2000)


@pytest.mark.parametrize(
    ("echo", "payload", "wire"),
    [
        (b"MD0540054201000", scip.distances(D), b"0CB1Dh7D`]"),
        (b"MS0540054201000", scip.short_distances(D), b"CBoooo1"),
        (b"ME0540054201000", scip.distances_intensities(D, ints(1780, 16219, 0)), b"0CB0Kd1Dh3mK7D`0007"),
        (
            b"ND0540054201000",
            scip.multi_echo(E, np.array([[5432, 0], [0, 0], [2500, 2600]], dtype=np.int32)),
            b"0CB&1Dh7D`0O@&0W4&0XXi",
        ),
        (
            b"NE0540054201000",
            scip.multi_echo(
                E,
                np.array([[5432], [0], [0]], dtype=np.int32),
                ints(1780, 50, 700),
                np.array([[900], [0], [0]], dtype=np.int32),
            ),
            b"0CB0Kd&1Dh0>47D`00b0O@0:l[",
        ),
        (b"ND0540054201000", scip.multi_echo(D, NONE), b"0CB1Dh7D`]"),
    ],
)
def test_data_replies(echo: bytes, payload: bytes, wire: bytes) -> None:
    frame = scip.reply(echo, "99", scip.measurement(TIME, payload))
    assert frame == echo + b"\n99b\n4SAF>\n" + wire + b"\n\n"


def test_values_beyond_the_characters_are_clipped() -> None:
    assert scip.distances(ints(300_000, -5)) == b"ooo000"


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

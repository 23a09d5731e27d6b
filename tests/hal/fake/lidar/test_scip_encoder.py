"""The encoder of the fake: against examples worked out by hand and against a real sensor's dialogue."""

from __future__ import annotations

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


@pytest.mark.parametrize(
    ("value", "chars", "text"),
    [
        (1234, 2, b"CB"),
        (5432, 3, b"1Dh"),
        (16_000_000, 4, b"m2@0"),
        (TIME, 4, b"4SAF"),
        (4095, 2, b"oo"),
        (262143, 3, b"ooo"),
        (65533, 3, b"?om"),
        (65535, 3, b"?oo"),
    ],
)
def test_numbers(value: int, chars: int, text: bytes) -> None:
    assert scip.number(value, chars) == text
    if chars < 4:
        assert scip.numbers(ints(value), chars).tobytes() == text


@pytest.mark.parametrize("value", [-1, 4096])
def test_number_that_does_not_fit_is_refused(value: int) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        scip.number(value, 2)


SUMS = "00P 01Q 02R 03S 04T 05U 06V 07W 10Q 21S 50U 98a 99b 0Aa 0Bb 0Cc 0Dd 0Ee 0Ff 0Gg 0Hh 0Ii 0Ll 0Mm"


def test_status_sums() -> None:
    for line in SUMS.split():
        assert scip.summed_line(line[:2].encode()) == line.encode() + b"\n"


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("VEND", "Hokuyo Automatic Co.,Ltd.", b"VEND:Hokuyo Automatic Co.,Ltd.;[\n"),
        ("PROT", "SCIP 2.0", b"PROT:SCIP 2.0;N\n"),
        ("MODL", "URG-04LX(Hokuyo Automatic Co.,Ltd.)", b"MODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\n"),
        ("SCSP", "Initial(600[rpm])<-Default setting by user", b"SCSP:Initial(600[rpm])<-Default setting by user;A\n"),
        ("TIME", "6A5404", b"TIME:6A5404;]\n"),
        ("ARES", "1024", b"ARES:1024;\\\n"),
        ("DMAX", "30000", b"DMAX:30000;G\n"),
    ],
)
def test_text_lines_of_real_sensors(key: str, value: str, line: bytes) -> None:
    assert scip.text_line(key, value) == line


def test_variants_of_text_sums_differ_only_in_the_sum() -> None:
    value = "Initial(600[rpm])<-Default setting by user"
    plain, whole, mark = (
        make("SCSP", value) for make in (scip.text_line, scip.text_line_summed_whole, scip.text_line_summed_to_mark)
    )
    assert plain[:-2] == whole[:-2] == mark[:-2]
    assert whole[-2:-1] == scip.checksum(plain[:-2])
    assert mark[-2:-1] == scip.checksum(b"SCSP:Initial(600[rpm])<-")
    assert len({plain, whole, mark}) == 3
    assert scip.text_line_summed_to_mark("LASR", "ON") == scip.text_line("LASR", "ON")


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


def test_single_reply_and_errors() -> None:
    body = scip.measurement(TIME, scip.distances(D))
    assert scip.reply(b"GD0540054201", "00", body) == b"GD0540054201\n00P\n4SAF>\n0CB1Dh7D`]\n\n"
    assert scip.reply(b"GD0540200001", "04") == b"GD0540200001\n04T\n\n"
    assert scip.reply(b"XX", "0E") == b"XX\n0Ee\n\n"


def test_values_straddle_the_end_of_a_line() -> None:
    lines = scip.data_lines(scip.distances(np.arange(1000, 1022, dtype=np.int32)))
    assert lines == b"0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0E\n?m\\\n"


@pytest.mark.parametrize(("steps", "size"), [(1081, 3372), (682, 2137)])
def test_frame_sizes(steps: int, size: int) -> None:
    payload = scip.distances(np.zeros(steps, dtype=np.int32))
    assert len(scip.reply(b"MD0000108001000", "99", scip.measurement(0, payload))) == size


def test_full_lines_need_no_rest() -> None:
    assert scip.data_lines(b"0" * 128).count(b"\n") == 2
    assert scip.data_lines(b"") == b""


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

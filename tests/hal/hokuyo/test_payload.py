"""Scan payloads: published examples byte for byte, every form by property, every rule of damage."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.hokuyo.payload import ScanReply, ScanRequest, parse_scan
from hal.hokuyo.scip import BadFrame, Flaw, FrameSplitter, parse_reply
from tests.hal.hokuyo import encoder


def decode(request: ScanRequest, wire: bytes) -> ScanReply:
    (frame,) = FrameSplitter().feed(wire)
    return parse_scan(request, parse_reply(frame))


def flaw_of(request: ScanRequest, wire: bytes) -> Flaw:
    with pytest.raises(BadFrame) as caught:
        decode(request, wire)
    return caught.value.flaw


class TestPublishedExamples:
    """Three steps 540..542 with distances 1234, 5432, 30000 at time 0x123456."""

    def test_acknowledgement(self) -> None:
        request = ScanRequest("MD", 540, 542)
        assert request.command() == b"MD0540054201000\n"
        reply = parse_reply(b"MD0540054201000\n00P")
        assert (reply.echo, reply.status) == (request.echo, "00")
        with pytest.raises(BadFrame):
            parse_scan(request, reply)

    def test_md(self) -> None:
        data = decode(ScanRequest("MD", 540, 542), b"MD0540054201000\n99b\n4SAF>\n0CB1Dh7D`]\n\n")
        assert data.stamp == 0x123456
        assert data.distance.tolist() == [1234, 5432, 30000]
        assert data.intensity is None
        assert data.echoes is None

    def test_gd(self) -> None:
        request = ScanRequest("GD", 540, 542)
        assert request.command() == b"GD0540054201\n"
        data = decode(request, b"GD0540054201\n00P\n4SAF>\n0CB1Dh7D`]\n\n")
        assert data.distance.tolist() == [1234, 5432, 30000]

    def test_ms_saturates(self) -> None:
        data = decode(ScanRequest("MS", 540, 542), b"MS0540054201000\n99b\n4SAF>\nCBoooo1\n\n")
        assert data.distance.tolist() == [1234, 4095, 4095]

    def test_me(self) -> None:
        data = decode(ScanRequest("ME", 540, 542), b"ME0540054201000\n99b\n4SAF>\n0CB0Kd1Dh3mK7D`0007\n\n")
        assert data.distance.tolist() == [1234, 5432, 30000]
        assert data.intensity is not None
        assert data.intensity.tolist() == [1780, 16219, 0]

    def test_nd(self) -> None:
        wire = b"ND0540054201000\n99b\n4SAF>\n0CB&1Dh7D`0O@&0W4&0XXi\n\n"
        data = decode(ScanRequest("ND", 540, 542), wire)
        assert data.distance.tolist() == [1234, 30000, 2000]
        assert data.echoes is not None
        assert data.echoes.tolist() == [[5432, 0, 0], [0, 0, 0], [2500, 2600, 0]]

    def test_ne(self) -> None:
        wire = b"NE0540054201000\n99b\n4SAF>\n0CB0Kd&1Dh0>47D`00b0O@0:l[\n\n"
        data = decode(ScanRequest("NE", 540, 542), wire)
        assert data.distance.tolist() == [1234, 30000, 2000]
        assert data.intensity is not None
        assert data.intensity.tolist() == [1780, 50, 700]
        assert data.echoes is not None
        assert data.echo_intensity is not None
        assert data.echoes[:, 0].tolist() == [5432, 0, 0]
        assert data.echo_intensity[:, 0].tolist() == [900, 0, 0]

    def test_values_straddle_lines(self) -> None:
        first = b"0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0E\n"
        wire = b"MD0000002101000\n99b\n4SAF>\n" + first + b"?m\\\n\n"
        assert decode(ScanRequest("MD", 0, 21), wire).distance.tolist() == list(range(1000, 1022))

    def test_errors_are_no_data(self) -> None:
        assert flaw_of(ScanRequest("GD", 540, 542), b"GD0540054201\n10Q\n\n") is Flaw.STATUS


def test_frame_lengths_on_the_wire() -> None:
    """Lengths of frames of real sensors, and of the data sheets' rates."""
    assert ScanRequest("GD", 44, 725).frame_bytes == 2134
    assert ScanRequest("MD", 0, 1080).frame_bytes == 3372
    assert ScanRequest("ME", 0, 1080).frame_bytes == 6717
    assert ScanRequest("MS", 0, 1080).frame_bytes == 2257
    assert ScanRequest("GD", 0, 760).frame_bytes == 2379
    assert ScanRequest("MD", 44, 725, 3).frame_bytes == 733


@given(st.sampled_from(["MD", "MS", "ME", "ND", "NE", "GD", "GS", "GE", "HD", "HE"]), st.data())
def test_round_trip(name: str, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 150), "beams")
    cluster = data.draw(st.integers(0, 5), "cluster")
    start = data.draw(st.integers(0, 100), "start")
    stamp = data.draw(st.integers(0, 2**24 - 1), "stamp")
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32), "seed"))
    chars = 2 if name[1] == "S" else 3
    multi = name[0] in "NH"
    steps = [
        [
            tuple(int(v) for v in rng.integers(0, 64**chars, 2 if name[1] == "E" else 1))
            for _ in range(int(rng.integers(1, 4)) if multi else 1)
        ]
        for _ in range(count)
    ]
    stride = max(1, cluster)
    request = ScanRequest(name, start, start + stride * count - 1, cluster)
    status = "99" if request.streaming else "00"
    reply = decode(request, encoder.scan(request.echo.decode(), stamp, encoder.payload(steps, chars), status))
    assert reply.stamp == stamp
    assert reply.distance.tolist() == [step[0][0] for step in steps]
    assert reply.distance.dtype == np.int32
    if name[1] == "E":
        assert reply.intensity is not None
        assert reply.intensity.tolist() == [step[0][1] for step in steps]
    if multi:
        assert reply.echoes is not None
        padded = [[echo[0] for echo in step[1:]] + [0] * (4 - len(step)) for step in steps]
        assert reply.echoes.tolist() == padded
    else:
        assert reply.echoes is None


@pytest.mark.parametrize(("beams", "fine"), [(226, False), (227, True), (228, True), (229, False)])
def test_incomplete_last_cluster_may_be_dropped_or_kept(beams: int, fine: bool) -> None:
    request = ScanRequest("MD", 44, 725, 3)  # 682 steps: 227 whole clusters and one step
    wire = encoder.scan(request.echo.decode(), 0, encoder.payload([[(100,)]] * beams))
    if fine:
        assert len(decode(request, wire).distance) == beams
    else:
        assert flaw_of(request, wire) is Flaw.LENGTH


def test_countdown() -> None:
    request = ScanRequest("MD", 0, 1, count=3)
    ours = "MD00000001010"
    body = encoder.payload([[(100,)], [(200,)]])
    for digits, left in (("02", 2), ("01", 1), ("00", 0)):
        assert decode(request, encoder.scan(ours + digits, 5, body)).remaining == left
    for digits in ("03", "99", "0x", "  "):
        assert flaw_of(request, encoder.scan(ours + digits, 5, body)) is Flaw.ECHO
    endless = ScanRequest("MD", 0, 1)
    assert flaw_of(endless, encoder.scan(ours + "01", 5, body)) is Flaw.ECHO


def test_countdown_before_a_tag() -> None:
    request = ScanRequest("MD", 0, 0, count=2, tag="a7")
    assert request.command() == b"MD0000000001002;a7\n"
    assert decode(request, encoder.scan("MD0000000001001;a7", 5, "0CB")).remaining == 1
    assert flaw_of(request, encoder.scan("MD0000000001001;a8", 5, "0CB")) is Flaw.ECHO
    assert ScanRequest.of_echo(b"MD0000000001001;a7") == request


@pytest.mark.parametrize(
    ("echo", "left"),
    [
        (b"MD0000108001000", 0),
        (b"ME0044072503298", 98),
        (b"GD0044072501", 0),
        (b"HE0000000000", 0),
        (b"NE0000108001000;tag", 0),
    ],
)
def test_request_of_an_echo(echo: bytes, left: int) -> None:
    request = ScanRequest.of_echo(echo)
    assert request.remaining(echo) == left
    assert (request.name, request.start, request.end) == (echo[:2].decode(), int(echo[2:6]), int(echo[6:10]))


@pytest.mark.parametrize(
    "echo", [b"", b"MD", b"VV", b"MD00001080010", b"XX0000108001000", b"MD1080000001000", b"MD0000108001099"]
)
def test_echoes_of_no_scan(echo: bytes) -> None:
    with pytest.raises(BadFrame):
        ScanRequest.of_echo(echo)


@pytest.mark.parametrize(
    "fields",
    [
        {"name": "XX"},
        {"start": -1},
        {"end": 10000},
        {"start": 5, "end": 4},
        {"cluster": 100},
        {"skip": 10},
        {"count": 100},
    ],
)
def test_requests_that_cannot_be_said(fields: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"expected|scan command|after end"):
        ScanRequest(**({"name": "MD", "start": 0, "end": 1080} | fields))  # type: ignore[arg-type]  # wrong on purpose


class TestDamage:
    request = ScanRequest("MD", 0, 63)  # 192 characters: three full lines
    good = encoder.scan("MD0000006301000", 0x123456, encoder.payload([[(1000 + i,)] for i in range(64)]))
    data_at = len(b"MD0000006301000\n99b\n4SAF>\n")

    def test_the_good_frame(self) -> None:
        assert decode(self.request, self.good).distance.tolist() == list(range(1000, 1064))

    def test_dropped_and_doubled_line(self) -> None:
        line = self.good[self.data_at : self.data_at + 66]
        rest = self.good[self.data_at + 66 :]
        head = self.good[: self.data_at]
        assert flaw_of(self.request, head + rest) is Flaw.LENGTH
        assert flaw_of(self.request, head + line + line + rest) is Flaw.LENGTH

    def test_dropped_byte_anywhere(self) -> None:
        for at in range(len(self.good) - 2):
            damaged = self.good[:at] + self.good[at + 1 :]
            frames = FrameSplitter().feed(damaged)
            for frame in frames:
                with pytest.raises(BadFrame):
                    parse_scan(self.request, parse_reply(frame))

    def test_every_single_bit_flip_is_caught(self) -> None:
        for at in range(len(self.good) - 2):
            for bit in range(8):
                damaged = bytearray(self.good)
                damaged[at] ^= 1 << bit
                for frame in FrameSplitter().feed(bytes(damaged)):
                    with pytest.raises(BadFrame):
                        parse_scan(self.request, parse_reply(frame))

    def test_alien_reply_spliced_in(self) -> None:
        for at in range(1, len(self.good) - 2):
            damaged = self.good[:at] + b"AT\n0Ee\n\n" + self.good[at:]
            for frame in FrameSplitter().feed(damaged):
                with pytest.raises(BadFrame):
                    parse_scan(self.request, parse_reply(frame))

    def test_missing_time_line(self) -> None:
        assert flaw_of(self.request, b"MD0000006301000\n99b\n\n") is Flaw.LAYOUT
        assert flaw_of(self.request, b"MD0000006301000\n99b\n4SAF?\n\n") is Flaw.SUM
        assert flaw_of(self.request, b"MD0000006301000\n99b\n4SAF>\n\n") is Flaw.LENGTH

    @pytest.mark.parametrize("payload", ["&0CB0CB", "0CB0CB&", "0CB&&0CB", "0C&B0CB", "0CB&0CB&0CB&0CB", "0CB0C"])
    def test_misplaced_ampersands(self, payload: str) -> None:
        request = ScanRequest("ND", 0, 0)
        assert flaw_of(request, encoder.scan(request.echo.decode(), 0, payload)) is Flaw.LENGTH

    def test_ampersand_where_none_belongs(self) -> None:
        assert flaw_of(ScanRequest("MD", 0, 1), encoder.scan("MD0000000101000", 0, "0C&0CB")) is Flaw.CHARACTER
        assert flaw_of(ScanRequest("ND", 0, 1), encoder.scan("ND0000000101000", 0, "0C%0CB")) is Flaw.CHARACTER

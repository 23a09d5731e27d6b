"""SCIP: lines, checksums and replies."""

import asyncio
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.clock import LoopClock
from hal.errors import DeviceMissing
from hal.hokuyo import scip
from hal.hokuyo.scip import BadFrame, Flaw, FrameSplitter, parse_reply, parse_stamp, parse_text
from hal.hokuyo.scip_line import Line
from hal.port.port import MemoryPort, memory_pair
from tests.hal.hokuyo import encoder

URG_VV = (
    b"VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX;[\nFIRM:3.1.04(02/Aug./2007);a\n"
    b"PROT:SCIP 2.0;N\nSERI:H0706400;F"
)
URG_PP = (
    b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
    b"AMAX:725;o\nAFRT:384;6\nSCAN:600;e"
)
URG_II = (
    b"II\n00P\nLASR:ON;9\nSCSP:Initial(600[rpm])<-Default setting by user;A\nMESM:CLASSIC;^\n"
    b"SBPS:19200[bps]<-Default setting by user;A\nTIME:6A5404;]\nSTAT:Sensor works well.;8"
)


@pytest.mark.parametrize(
    ("chars", "value"),
    [
        (b"CB", 1234),
        (b"1Dh", 5432),
        (b"m2@0", 16_000_000),
        (b"4SAF", 0x123456),
        (b"oo", 4095),
        (b"ooo", 262143),
        (b"?om", 65533),
        (b"?oo", 65535),
    ],
)
def test_published_numbers(chars: bytes, value: int) -> None:
    assert scip.decode_number(chars) == value
    assert encoder.number(value, len(chars)).encode() == chars


@given(st.integers(0, 2**24 - 1))
def test_number_round_trip(value: int) -> None:
    assert scip.decode_number(encoder.number(value, 4).encode()) == value


@pytest.mark.parametrize("char", [0x2F, 0x70, 0x26, 0x0A, 0xC3])
def test_number_of_foreign_characters(char: int) -> None:
    with pytest.raises(BadFrame) as caught:
        scip.decode_number(bytes([0x30, char]))
    assert caught.value.flaw is Flaw.CHARACTER


STATUS_SUMS = "00P 01Q 02R 03S 04T 05U 06V 07W 10Q 21S 50U 98a 99b 0Aa 0Bb 0Cc 0Dd 0Ee 0Ff 0Gg 0Hh 0Ii 0Ll 0Mm"


@pytest.mark.parametrize("line", STATUS_SUMS.split())
def test_status_lines(line: str) -> None:
    reply = parse_reply(b"QT\n" + line.encode())
    assert (reply.echo, reply.status, reply.body, reply.legacy) == (b"QT", line[:2], b"", False)
    for at in range(3):
        for bit in range(8):
            damaged = bytearray(line.encode())
            damaged[at] ^= 1 << bit
            with pytest.raises(BadFrame):
                parse_reply(b"QT\n" + bytes(damaged))


def test_real_text_replies() -> None:
    vv = parse_text(parse_reply(URG_VV))
    assert vv == {
        "VEND": "Hokuyo Automatic Co.,Ltd.",
        "PROD": "SOKUIKI Sensor URG-04LX",
        "FIRM": "3.1.04(02/Aug./2007)",
        "PROT": "SCIP 2.0",
        "SERI": "H0706400",
    }
    assert parse_text(parse_reply(URG_PP))["AMAX"] == "725"
    state = parse_text(parse_reply(URG_II))
    assert state["STAT"] == "Sensor works well."
    assert state["SBPS"] == "19200[bps]<-Default setting by user"


@pytest.mark.parametrize("sensor", [b"MODL:UST-10LX;D", b"DMIN:20;4", b"DMAX:30000;G", b"ARES:1440;^", b"AMAX:1080;Z"])
def test_parameter_lines_of_a_ust(sensor: bytes) -> None:
    assert len(parse_text(parse_reply(b"PP\n00P\n" + sensor))) == 1


def test_three_ways_of_summing_text() -> None:
    line = "SBPS:USB;x <-Default setting by user"
    for summed in (line, line + ";", "SBPS:USB;x <-"):
        frame = f"II\n00P\n{line};{encoder.sum_char(summed)}".encode()
        assert parse_text(parse_reply(frame)) == {"SBPS": "USB;x <-Default setting by user"}
    wrong = f"II\n00P\n{line};{chr(ord(encoder.sum_char(line)) ^ 2)}".encode()
    with pytest.raises(BadFrame) as caught:
        parse_text(parse_reply(wrong))
    assert caught.value.flaw is Flaw.SUM
    assert parse_text(parse_reply(wrong), strict=False) == {"SBPS": "USB;x <-Default setting by user"}


def test_lines_without_a_colon_are_passed_over_and_lines_without_an_end_are_not() -> None:
    assert parse_text(parse_reply(f"VV\n00P\nhello;{encoder.sum_char('hello')}".encode())) == {}
    for body in (b"SERI:H07", b"SERI:H07;", b"x", b"SERI:H\xff;a"):
        with pytest.raises(BadFrame):
            parse_text(parse_reply(b"VV\n00P\n" + body))


def test_stamp_replies() -> None:
    assert parse_stamp(parse_reply(b"TM1\n00P\n<SfkP")) == 3_292_603  # UXM-30LX-E, real
    assert parse_stamp(parse_reply(b"TM1;a7\n00P\n4SAF>")) == 0x123456
    for body, flaw in ((b"4SAF?", Flaw.SUM), (b"4SA>", Flaw.LAYOUT), (b"", Flaw.LAYOUT), (b"4SAF>\nx", Flaw.LAYOUT)):
        with pytest.raises(BadFrame) as caught:
            parse_stamp(parse_reply(b"TM1\n00P\n" + body))
        assert caught.value.flaw is flaw


@pytest.mark.parametrize(("frame", "status"), [(b"QT\n0", "0"), (b"QT\nE", "E"), (b"SCIP2.0\n0", "0")])
def test_scip_1_replies_are_recognised(frame: bytes, status: str) -> None:
    reply = parse_reply(frame)
    assert reply.legacy
    assert reply.status == status


@pytest.mark.parametrize("frame", [b"QT", b"QT\n", b"QT\n\xc3\x28P", b"QT\n  P", b"QT\n00PP", b"QT\n?"])
def test_frames_that_are_no_reply(frame: bytes) -> None:
    with pytest.raises(BadFrame):
        parse_reply(frame)


def test_tags_and_rates() -> None:
    assert scip.tagged(scip.TM_READ, "a7") == b"TM1;a7\n"
    for tag in ("x" * 17, "a;b", "ä", "a\n"):
        with pytest.raises(ValueError, match="at most 16"):
            scip.tagged(scip.TM_READ, tag)
    assert scip.baud_command(115200) == b"SS115200\n"
    assert scip.baud_command(19200) == b"SS019200\n"
    with pytest.raises(ValueError, match="19200, 38400"):
        scip.baud_command(9600)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


@given(
    st.lists(st.sampled_from([URG_VV, URG_PP, b"QT\n00P", b"MD0000\n99b\nabc"]), max_size=6), st.lists(st.integers(0))
)
def test_splitter_does_not_care_how_bytes_are_cut(frames: list[bytes], cuts: list[int]) -> None:
    splitter = FrameSplitter()
    wire = b"".join(frame + b"\n\n" for frame in frames)
    found = [frame for piece in pieces(wire, cuts) for frame in splitter.feed(piece)]
    assert found == frames
    assert splitter.dropped_bytes == 0


@given(st.binary(max_size=600), st.integers(1, 70))
def test_splitter_finds_its_way_back_after_anything(noise: bytes, size: int) -> None:
    splitter = FrameSplitter()
    good = b"QT\n00P"
    wire = noise + b"\n\n" + good + b"\n\n" + good + b"\n\n"
    found: list[bytes] = []
    for start in range(0, len(wire), size):
        found += splitter.feed(wire[start : start + size])
    assert found[-1] == good
    assert found[-2:] == [good, good]


def test_splitter_memory_is_bounded() -> None:
    splitter = FrameSplitter()
    for _ in range(300):
        assert splitter.feed(b"\x55" * 1000) == []
        assert len(splitter._buffer) <= scip.MAX_LINE
    assert splitter.dropped_bytes >= 299_000
    for _ in range(2000):  # lines, but never an end of frame
        assert splitter.feed(b"0123456789\n" * 10) == []
        assert len(splitter._buffer) <= scip.MAX_FRAME + 110
    assert splitter.feed(b"\n\nQT\n00P\n\n")[-1] == b"QT\n00P"


def test_splitter_end_of_skip_cut_between_the_two_line_feeds() -> None:
    splitter = FrameSplitter()
    splitter.feed(b"x" * 300)
    assert splitter.feed(b"yyy\n") == []
    assert splitter.feed(b"\n") == []
    assert splitter.feed(b"QT\n00P\n\n") == [b"QT\n00P"]


def test_splitter_stray_empty_lines_and_reset() -> None:
    splitter = FrameSplitter()
    assert splitter.feed(b"\n\n\nQT\n00P\n\n\n\n\nVV\n0") == [b"QT\n00P"]
    splitter.reset()
    assert splitter.feed(b"QT\n00P\n\n") == [b"QT\n00P"]


def test_reset_half_way_through_does_not_join_old_and_new() -> None:
    splitter = FrameSplitter()
    splitter.feed(b"MD0044072501000\n99b\n0123")
    splitter.reset()
    assert splitter.feed(b"VV\n00P\n\n") == [b"VV\n00P"]


def a_line() -> tuple[Line, MemoryPort, list[bytes]]:
    """The line, the sensor's end of it, and what the sensor receives."""
    ours, theirs = memory_pair(LoopClock(asyncio.get_running_loop()), "/dev/x")
    heard: list[bytes] = []
    theirs.start(lambda data, t: heard.append(data), lambda error: None)
    return Line(ours), theirs, heard


@pytest.mark.virtual
async def test_a_question_is_flushed_before_and_answered_by_its_echo_alone() -> None:
    line, sensor, heard = a_line()
    others: list[bytes] = []
    line.on_frame = lambda frame, t: others.append(frame)
    loop = asyncio.get_running_loop()
    loop.call_later(0.1, sensor.write, b"VV\n00P\n\nQT\n99b\n\nQT\n0")
    loop.call_later(0.2, sensor.write, b"0P\n\nQT\n00P\n\n")
    assert await line.exchange(scip.QT, 1.0) == b"QT\n00P"
    assert heard == [b"\nQT\n"]
    assert others == [b"VV\n00P", b"QT\n99b", b"QT\n00P"]  # a second answer to it is nobody's


@pytest.mark.virtual
async def test_no_answer_in_time() -> None:
    line, sensor, _ = a_line()
    with pytest.raises(TimeoutError):
        await line.exchange(scip.VV, 0.5)
    sensor.write(b"VV\n00P\n\n")  # too late: must not answer the next question
    asyncio.get_running_loop().call_later(0.1, sensor.write, b"PP\n00P\n\n")
    assert await line.exchange(scip.PP, 0.5) == b"PP\n00P"


@pytest.mark.virtual
async def test_what_is_readable_is_told_from_noise() -> None:
    line, sensor, _ = a_line()
    sensor.write(b"\xf0\x0f\n\n\x80\x81\n\x82\n\n" + b"MD\n99b\n\n")
    await asyncio.sleep(0.1)
    assert line.recognised == 1
    assert line.dropped_bytes == 0
    sensor.write(b"\xaa" * 1000)
    await asyncio.sleep(0.1)
    assert line.dropped_bytes == 1000


@pytest.mark.virtual
async def test_loss_reaches_a_question_under_way_and_every_later_one() -> None:
    line, sensor, _ = a_line()
    told: list[str] = []
    line.set_on_lost(lambda: told.append("first"))
    asyncio.get_running_loop().call_later(0.1, sensor.close)
    with pytest.raises(DeviceMissing):
        await line.exchange(scip.VV, 1.0)
    with pytest.raises(DeviceMissing):
        await line.exchange(scip.VV, 1.0)
    line.set_on_lost(lambda: told.append("late"))
    line.set_on_lost(None)
    assert told == ["first", "late"]
    assert isinstance(line.lost, DeviceMissing)
    line.close()

"""Frames of the remote bus, byte for byte as documented."""

from __future__ import annotations

import pytest

from hal.bus import i2c_frames as frames
from hal.bus.i2c import read, write
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError

HELLO = bytes.fromhex("00000019 01 4c493243 01 3ff8000000000000 0004") + b"boot" + bytes.fromhex("0003") + b"bcm"
TRANSFER = bytes.fromhex("0000000f 03 00000007 02 48 00 0001 01 48 01 0002")
DONE = bytes.fromhex(
    "00000031 04 00000007 0000 3ff0000000000000 4000000000000000 4008000000000000 4010000000000000 02"
    "0002 0fff 0003 010203"
)


def test_hello() -> None:
    assert frames.hello(1.5, "boot", "bcm") == HELLO
    assert frames.parse_hello(HELLO[5:]) == frames.Hello(1.5, "boot", "bcm")


def test_transfer() -> None:
    messages = (write(0x48, b"\x01"), read(0x48, 2))
    assert frames.transfer(7, messages) == TRANSFER
    assert frames.parse_transfer(TRANSFER[5:]) == (7, messages)


def test_done() -> None:
    done = frames.Done(7, 0, 1.0, 2.0, 3.0, 4.0, (b"\x0f\xff", b"\x01\x02\x03"))
    assert frames.done(done) == DONE
    assert frames.parse_done(DONE[5:]) == done


@pytest.mark.parametrize(
    ("error", "noun"),
    [(DeviceMissing("a", "gone", "connect it"), 1), (DeviceRefused("a", "busy"), 2), (DeviceFault("a", "stuck"), 3)],
)
def test_refused(error: HalError, noun: int) -> None:
    raw = frames.refused(error)
    assert raw[4] == frames.REFUSED
    assert raw[5] == noun
    parsed = frames.parse_refused(raw[5:], "tcp://x")
    assert type(parsed) is type(error)
    assert (parsed.device, parsed.problem, parsed.remedy) == ("tcp://x", error.problem, error.remedy)


@pytest.mark.parametrize("piece", [1, 2, 3, 7, 1000])
def test_frames_are_cut_out_of_any_pieces(piece: int) -> None:
    splitter, found = frames.Splitter(), []
    stream = HELLO + TRANSFER + DONE + TRANSFER
    for start in range(0, len(stream), piece):
        found += splitter.feed(stream[start : start + piece])
    assert [kind for kind, _ in found] == [1, 3, 4, 3]
    assert found[2][1] == DONE[5:]


@pytest.mark.parametrize("length", [0, frames.MAX_FRAME + 1, 0xFFFFFFFF])
def test_a_length_that_cannot_be(length: int) -> None:
    with pytest.raises(frames.BadFrame, match="a message of"):
        frames.Splitter().feed(length.to_bytes(4, "big") + b"\x03")


def test_the_longest_transaction_fits() -> None:
    answer = frames.Done(1, 0, 0.0, 0.0, 0.0, 0.0, (bytes(8192),) * 42)
    (found,) = frames.Splitter().feed(frames.done(answer))
    assert frames.parse_done(found[1]) == answer
    (found,) = frames.Splitter().feed(frames.transfer(1, (write(1, bytes(8192)),) * 42))
    assert len(frames.parse_transfer(found[1])[1]) == 42


@pytest.mark.parametrize("cut", range(len(TRANSFER) - 5))
def test_a_transfer_that_is_cut(cut: int) -> None:
    with pytest.raises(frames.BadFrame):
        frames.parse_transfer(TRANSFER[5 : 5 + cut])


@pytest.mark.parametrize("cut", range(len(DONE) - 5))
def test_an_answer_that_is_cut(cut: int) -> None:
    with pytest.raises(frames.BadFrame):
        frames.parse_done(DONE[5 : 5 + cut])


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (HELLO[5:] + b"x", "too long"),
        (b"\x00" + HELLO[6:], "this is not an I2C bus server"),
        (HELLO[5:9] + b"\x02" + HELLO[10:], "version 2"),
        (HELLO[5:10] + bytes.fromhex("7ff8000000000000") + HELLO[18:], "impossible times"),
        (HELLO[5:-3] + b"\xff\xfe\xfd", "UTF-8"),
    ],
)
def test_greetings_that_are_none(body: bytes, says: str) -> None:
    with pytest.raises(frames.BadFrame, match=says):
        frames.parse_hello(body)


def test_times_must_follow_each_other() -> None:
    with pytest.raises(frames.BadFrame, match="times"):
        frames.parse_done(frames.done(frames.Done(1, 0, 1.0, 3.0, 2.0, 4.0, ()))[5:])


def test_flags_and_nouns_that_do_not_exist() -> None:
    with pytest.raises(frames.BadFrame, match="flags"):
        frames.parse_transfer(bytes.fromhex("00000007 01 48 02 0001"))
    with pytest.raises(frames.BadFrame, match="kind of error"):
        frames.parse_refused(b"\x09\x00\x00\x00\x00", "x")


def test_long_texts_are_cut_without_breaking_a_character() -> None:
    parsed = frames.parse_refused(frames.refused(DeviceFault("x", "ä" * 2000, "b"))[5:], "x")
    assert parsed.problem == "ä" * 500

"""Modbus RTU: frames among noise and other devices' traffic."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import registers, rtu_frames
from daemon.publish.modbus.rtu_frames import MAX_FRAME, RtuFrames, framed
from tests.daemon.publish.modbus.test_registers import snapshot

READ = struct.pack(">BHH", 4, 0, 64)
UNIT = 17


def crc(data: bytes) -> bytes:
    """CRC-16 of the standard's appendix, bit by bit: polynomial 0xA001, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


def asked(body: bytes = READ, unit: int = UNIT) -> bytes:
    frame = bytes([unit]) + body
    return frame + crc(frame)


def test_a_frame_of_the_standards_own_guide() -> None:
    assert framed(17, bytes.fromhex("03006B0003")) == bytes.fromhex("1103006B00037687")
    assert framed(UNIT, READ) == asked()


@pytest.mark.parametrize("size", [1, 2, 3, 7, 100])
def test_requests_in_pieces(size: int) -> None:
    write = struct.pack(">BHHB6H", 16, 1000, 6, 12, *range(6))
    stream = asked() + asked(write) + asked(b"\x06\x03\xe8\x00\x01") + asked(b"\x07")
    frames = RtuFrames(UNIT)
    found = [body for at in range(0, len(stream), size) for _, body in frames.feed(stream[at : at + size])]
    assert found == [READ, write, b"\x06\x03\xe8\x00\x01", b"\x07"]
    assert frames.skipped == 0


def test_what_is_for_others_is_passed_over() -> None:
    frames = RtuFrames(UNIT)
    answer = asked(b"\x04\x80" + registers.encode_block(snapshot()), unit=18)
    assert frames.feed(asked(unit=18) + answer + asked()) == [(UNIT, READ)]
    assert frames.feed(asked(unit=0)) == [(0, READ)], "0 is for all"
    assert frames.feed(asked()[:-1] + b"\x00") == []


def test_a_good_request_is_found_at_once_after_any_garbage() -> None:
    @given(st.binary(max_size=600) | st.lists(st.sampled_from([0, UNIT, 4, 16, 255]), max_size=600).map(bytes))
    def run(garbage: bytes) -> None:
        frames = RtuFrames(UNIT)
        frames.feed(garbage)
        assert (UNIT, READ) in frames.feed(asked())
        assert len(frames._data) <= MAX_FRAME

    run()


def old_take(frames: list[bytes], unit: int) -> list[tuple[int, bytes]]:
    """What the stream holds, looked at from the beginning with every piece: slow, and plain."""
    data, found = b"", []
    for piece in frames:
        data += piece
        at, keep = 0, -1
        while at < len(data):
            size = rtu_frames._size(bytearray(data), at) if data[at] in (unit, 0) else -1
            if size == 0 or at + size > len(data):
                keep = at if keep < 0 else keep
            elif size >= 4 and crc(data[at : at + size - 2]) == data[at + size - 2 : at + size]:
                found.append((data[at], data[at + 1 : at + size - 2]))
                data = data[at + size :]
                at, keep = 0, -1
                continue
            at += 1
        data = data[max(len(data) if keep < 0 else keep, len(data) - MAX_FRAME) :]
    return found


pieces = st.lists(
    st.sampled_from(
        [asked(), asked(unit=18), asked(unit=0), asked(b"\x07"), bytes([UNIT]), bytes([0, 16, 0, 0, 0, 0, 9])]
    )
    | st.binary(max_size=9),
    max_size=40,
)


@given(pieces, st.integers(1, 40))
def test_the_same_is_found_as_by_looking_at_everything_again(parts: list[bytes], size: int) -> None:
    stream = b"".join(parts)
    cut = [stream[at : at + size] for at in range(0, len(stream), size)]
    frames = RtuFrames(UNIT)
    found = [one for piece in cut for one in frames.feed(piece)]
    assert found == old_take(cut, UNIT)
    assert frames.skipped + len(frames._data) + sum(3 + len(body) for _, body in found) == len(stream)


def test_no_place_is_summed_twice_whatever_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes that look like the beginnings of long writes, one by one, for ever."""
    summed = 0

    def compute(data: bytes) -> int:
        nonlocal summed
        summed += 1
        return int.from_bytes(crc(data), "big")

    monkeypatch.setattr(rtu_frames.FramerRTU, "compute_CRC", compute)
    stream = bytes([0, 16, 0, 0, 0, 0, 240]) * 300
    frames = RtuFrames(UNIT)
    for byte in stream:
        frames.feed(bytes([byte]))
    assert summed <= len(stream) / 7
    assert frames.skipped + len(frames._data) == len(stream)

"""Bytes that nobody should send: never an exception, always a well-formed answer or none."""

import asyncio
import struct

from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import counts, registers, tcp_endpoint
from daemon.publish.modbus.holding import Holding
from daemon.publish.modbus.requests import MAX_FRAME, Responder, frame_size
from hal.clock import run_virtual
from hal.net.fair_share import Share
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import plugged

words = st.integers(0, 0xFFFF)
near = st.sampled_from([0, 1, 2, 63, 64, 65, 99, 100, 125, 126, 157, 158, 999, 1000, 1007, 1008, 1100, 1107, 65535])
functions = st.sampled_from([3, 4, 6, 16]) | st.integers(0, 255)
reads = st.builds(lambda f, a, n: struct.pack(">BHH", f, a, n), functions, near | words, near | words)
writes = st.builds(
    lambda a, n, size, data: struct.pack(">BHHB", 16, a, n, size) + data,
    near | words,
    st.integers(0, 130),
    st.integers(0, 255),
    st.binary(max_size=246),
)
bodies = reads | writes | st.binary(min_size=1, max_size=253)


def framed(transaction: int, unit: int, body: bytes) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(body) + 1, unit) + body


frames = st.builds(framed, words, st.integers(0, 255), bodies)


def responder(write: bool = True) -> Responder:
    made = Responder(Holding(lambda _: None, lambda _: None) if write else None)
    made.show(registers.encode_block(snapshot()), lambda: registers.encode_mirror(snapshot()))
    return made


def check_answer(frame: bytes, answer: bytes) -> None:
    """Same transaction and unit, right length, the function or its exception with a code of the standard."""
    assert answer[:4] == frame[:2] + b"\0\0"
    assert answer[6] == frame[6]
    assert frame_size(answer) == len(answer) <= MAX_FRAME
    function = frame[7]
    if answer[7] == function and function < 0x80:
        if function in (3, 4):
            assert answer[8] == 2 * int.from_bytes(frame[10:12], "big") == len(answer) - 9
        else:
            assert (function, answer[8:]) in ((6, frame[8:12]), (16, frame[8:12]))
    else:
        assert answer[7] == function | 0x80
        assert answer[8] in (1, 2, 3)
        assert len(answer) == 9


@given(frames, st.booleans())
def test_every_frame_gets_a_well_formed_answer(frame: bytes, write: bool) -> None:
    made = responder(write)
    answer = made.answer(frame)
    check_answer(frame, answer)
    assert made.answer(framed(1, 1, b"\x04\0\0\0\x40"))[9:] == registers.encode_block(snapshot()), "nothing was written"


def whole_frames(stream: bytes) -> tuple[int, bool]:
    """How many frames a stream holds before it ends or stops being Modbus, and whether it stops: told here anew."""
    count = 0
    while len(stream) >= 8:
        _, protocol, length = struct.unpack_from(">HHH", stream)
        if protocol or not 2 <= length <= 254:
            return count, True
        if len(stream) < 6 + length:
            break
        stream = stream[6 + length :]
        count += 1
    return count, False


@given(st.lists(frames | st.binary(max_size=40), max_size=12), st.lists(st.integers(1, 400), min_size=1, max_size=20))
def test_a_tcp_stream_cut_anywhere(parts: list[bytes], cuts: list[int]) -> None:
    """Every whole frame before the first fault is answered once, in order; a fault closes the connection."""
    stream = b"".join(parts)
    expected, faulty = whole_frames(stream)

    async def run() -> None:
        share = Share(asyncio.get_running_loop().time)
        endpoint = tcp_endpoint.TcpEndpoint(responder(), counts.Counts(), share=share)
        connection, wire = plugged(endpoint)
        start, turn = 0, 0
        while start < len(stream) and not wire.gone:
            size = cuts[turn % len(cuts)]
            connection.data_received(stream[start : start + size])
            start, turn = start + size, turn + 1
            await asyncio.sleep(0)
        await asyncio.sleep(0.1)
        answers, closed = whole_frames(bytes(wire.sent))
        assert answers == expected
        assert not closed
        assert wire.gone == faulty
        await endpoint.close()

    run_virtual(run())

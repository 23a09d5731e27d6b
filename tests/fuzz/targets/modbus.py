"""What Modbus clients send: datagrams, streams cut anywhere, and the bytes of a serial line."""

import asyncio
import struct
import weakref
from collections.abc import Callable

from daemon.publish.modbus import counts, registers, rtu_frames, tcp_endpoint
from daemon.publish.modbus.requests import MAX_FRAME, frame_size
from hal.clock import VirtualLoop
from hal.net.fair_share import Share
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import plugged
from tests.fuzz.test_modbus import check_answer, framed, responder, whole_frames

MEGABYTES = 10

READ = framed(1, 1, b"\x04\0\0\0\x40")


def seeds() -> list[bytes]:
    reads = [framed(k, 1, struct.pack(">BHH", f, a, n)) for k, (f, a, n) in enumerate(
        ((4, 0, 64), (3, 0, 125), (4, 100, 60), (3, 1000, 8), (3, 1100, 8), (4, 200, 100), (3, 350, 50), (4, 9000, 1))
    )]  # fmt: skip
    writes = [framed(9, 1, struct.pack(">BHHB", 16, a, n, 2 * n) + bytes(range(2 * n))) for a, n in
              ((1000, 8), (1100, 8), (1000, 1), (1102, 12), (999, 3))]  # fmt: skip
    singles = [framed(7, 1, struct.pack(">BHH", 6, a, v)) for a, v in ((1000, 1), (1001, 4), (1100, 2), (5, 5))]
    others = [framed(8, 0, bytes([f, 0, 1, 0, 2])) for f in (1, 2, 5, 7, 8, 17, 22, 23, 43, 0x84)]
    line = [rtu_frames.framed(unit, frame[7:]) for unit in (1, 0, 2) for frame in (*reads, *writes, *singles)]
    return [
        b"".join(line),
        *line[::5],
        b"".join(reads),
        b"".join(writes),
        b"".join(singles),
        b"".join(others),
        *reads,
        *writes,
        *singles,
    ]


def mend(data: bytes) -> bytes:
    """Protocol 0, and the length that there is."""
    body = data[6:][: MAX_FRAME - 6]
    return data if len(body) < 2 else data[:2] + struct.pack(">HH", 0, len(body)) + body


def feeder() -> Callable[[bytes], None]:
    loop, answering = VirtualLoop(), responder()

    async def stream(data: bytes) -> None:
        endpoint = tcp_endpoint.TcpEndpoint(responder(), counts.Counts(), share=Share(loop.time))
        connection, wire = plugged(endpoint)
        expected, faulty = whole_frames(data)
        cut = len(data) * 2 // 3
        for piece in (data[:cut], data[cut:]):
            if not wire.gone and piece:
                connection.data_received(piece)
        for _ in range(expected + 3):
            await asyncio.sleep(0)
        assert whole_frames(bytes(wire.sent)) == (expected, False)
        assert wire.gone == faulty
        if not wire.gone:
            connection.abort()
            await asyncio.sleep(0)
        await endpoint.close()

    def serial(data: bytes) -> None:
        line = rtu_frames.RtuFrames(1)
        for unit, body in [*line.feed(data[:99]), *line.feed(data[99:])]:
            assert unit in (0, 1)
            check_answer(framed(1, unit, body), answering.answer(framed(1, unit, body)))
        assert any(line.feed(rtu_frames.framed(1, READ[7:])) == [(1, READ[7:])] for _ in range(2))

    def feed(data: bytes) -> None:
        size = frame_size(data)
        assert -1 <= size <= MAX_FRAME
        if size > 0 and size == len(data):
            check_answer(data, answering.answer(data))
        loop.run_until_complete(stream(data))
        serial(data)
        assert answering.answer(READ)[9:] == registers.encode_block(snapshot()), "nothing may be written there"

    weakref.finalize(feed, loop.close)
    return feed

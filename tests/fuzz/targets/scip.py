"""What a lidar sends: the splitter, the codec and the listener."""

import math
from collections.abc import Callable

from hal.hokuyo.models import identify
from hal.hokuyo.passive import PassiveHokuyo
from hal.hokuyo.payload import ScanRequest, parse_scan
from hal.hokuyo.scip import BadFrame, FrameSplitter, parse_reply, parse_stamp, parse_text
from tests.hal.hokuyo import encoder

MEGABYTES = 50

GREETING = encoder.text("VV", encoder.VV_UTM) + encoder.text("PP", encoder.PP_UTM)
GOOD = ScanRequest("MD", 0, 2)


def good(stamp: int) -> bytes:
    return encoder.scan("MD0000000201000", stamp, "0CB1Dh7D`")


def seeds() -> list[bytes]:
    steps = [[(40 * k % 30000, 9 * k % 9000), (50 * k % 30000, 3 * k % 9000)][: 1 + (k % 7 == 0)] for k in range(130)]
    single, lit = [[echo[0][:1]] for echo in steps], [[echo[0]] for echo in steps]
    return [
        GREETING + encoder.scan("MD0000012901000", 77, encoder.payload(single)),
        encoder.scan("ME0000012901000", 78, encoder.payload(lit)),
        encoder.scan("NE0000012901000", 79, encoder.payload(steps)),
        encoder.scan("MS0000012901000", 80, encoder.payload([[(k % 4096,)] for k in range(130)], chars=2)),
        encoder.answer("GD0000012901", "00", encoder.lines(encoder.number(81, 4)) + encoder.lines("0CB1Dh" * 65)),
        encoder.text(
            "II", [("MODL", "UTM-30LX"), ("LASR", "ON"), ("SCSP", "2400"), ("TIME", "000123"), ("STAT", "ok")]
        ),
        encoder.answer("TM1", "00", encoder.lines(encoder.number(123456, 4))),
        encoder.answer("QT", "00") + encoder.answer("MD0000012901000", "00") + encoder.answer("BM", "02"),
        b"".join(good(5000 + 25 * k) for k in range(6)),
        encoder.text("PP", [*encoder.PP_UTM[:-1], ("SCAN", "0")]) + encoder.text("VV", [("SERI", ""), ("FIRM", "?")]),
    ]


def mend(data: bytes) -> bytes:
    """Every line of a reply after its echo gets its right sum."""
    replies = []
    for reply in data.split(b"\n\n"):
        echo, *lines = reply.split(b"\n")
        summed = [line[:-1] + bytes([sum(line[:-1]) % 64 + 48]) if len(line) > 1 else line for line in lines]
        replies.append(b"\n".join([echo, *summed]))
    return b"\n\n".join(replies)


def feeder() -> Callable[[bytes], None]:
    splitter, state = FrameSplitter(), {"t": 0.0}
    requests = (GOOD, ScanRequest("ME", 0, 129), ScanRequest("NE", 0, 129), ScanRequest("MS", 0, 129))
    listener = PassiveHokuyo()

    def read(frame: bytes) -> bool:
        assert b"\n\n" not in frame
        try:
            reply = parse_reply(frame)
        except BadFrame:
            return False
        seen = False
        for request in (*requests, reply.echo):
            try:
                wanted = ScanRequest.of_echo(request) if isinstance(request, bytes) else request
                scan = parse_scan(wanted, reply)
            except BadFrame:
                continue
            assert len(scan.distance) in range(wanted.beams[0], wanted.beams[1] + 1)
            assert 0 <= scan.stamp < 1 << 24
            seen |= wanted == GOOD
        for parse in (parse_text, parse_stamp):
            try:
                parse(reply)
            except BadFrame:
                continue
        return seen

    def feed(data: bytes) -> None:
        state["t"] += 1.0
        t = state["t"]
        for frame in splitter.feed(data):
            read(frame)
        assert any(read(frame) for k in range(2) for frame in splitter.feed(good(k))), "not within two frames"
        for scan in listener.feed(data, t):
            assert math.isfinite(scan.t_mono)
            assert scan.t_mono <= scan.t_rx, f"{scan.t_mono - scan.t_rx:.3f} s ahead"
            assert len(scan.ranges) == len(scan.code)
        listener.feed(b"\n\n" + GREETING, t)  # a sensor of another name may have spoken
        found = [scan for k in range(8) for scan in listener.feed(good(5000 + 25 * k), t + 0.1 + 0.025 * k)]
        assert found, "the listener does not come back"
        assert listener.geometry is not None
        assert listener.geometry.serial == "H0900001"
        for vv, pp in ((dict(encoder.VV_UTM), texts(data)), (texts(data), dict(encoder.PP_UTM))):
            refused_or(identify, vv, pp)

    return feed


def texts(data: bytes) -> dict[str, str]:
    """Key and value of whatever looks like a line of text."""
    pairs = (line.decode("latin-1").split(";")[0].partition(":") for line in data.split(b"\n"))
    return {key: value for key, colon, value in pairs if colon}


def refused_or(make: Callable[..., object], *arguments: object) -> None:
    from hal.errors import HalError

    try:
        make("x", *arguments)
    except (HalError, BadFrame):
        return

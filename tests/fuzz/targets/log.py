"""Logs that are to be replayed: CARMEN's text, captures of a serial line, our own recordings."""

import struct
import zlib
from collections.abc import Callable
from itertools import islice

from daemon.replay.sources import open_log
from hal.errors import HalError
from hal.imu import RawImu
from hal.odometry import RawOdometry
from hal.replay.recording import MARKER, Kind, pack_frame, pack_head, pack_imu, pack_odometry
from tests.fuzz.targets import a_file, refused, scip

MEGABYTES = 3
EVENTS = 20_000


def carmen() -> bytes:
    beams = " ".join(f"{1.0 + 0.01 * k:.2f}" for k in range(9))
    rows = ["PARAM robot_frontlaser_offset 0.1", "# a comment"]
    for k in range(4):
        pose = f"{0.1 * k:.3f} 0.0 0.01"
        rows.append(f"ODOM {pose} 0.5 0.0 0.0 {100.0 + k} robot {k}.0")
        rows.append(f"FLASER 9 {beams} {pose} {pose} {100.0 + k} robot {k}.1")
        fan = "0 -1.5708 3.1416 0.3927 80.0 0.01 0 9"
        rows.append(f"ROBOTLASER1 {fan} {beams} 0 {pose} {pose} 0 0 0 0 0 {100.5 + k} robot {k}.2")
        rows.append(f"RAWLASER1 {fan} {beams} 0 {100.7 + k} robot {k}.3")
    return "\n".join(rows).encode() + b"\n"


def capture() -> bytes:
    parts = [scip.GREETING, *(scip.good(5000 + 25 * k) for k in range(5))]
    return b"".join(struct.pack(">QI", 1_000_000 + 25_000 * k, len(part)) + part for k, part in enumerate(parts))


def recording() -> bytes:
    head = pack_head({"recording": "a", "segment": 0, "t_utc": 1e9, "t_mono": 5.0, "config": {}})
    frames = [pack_frame(Kind.OPEN, 0, 1.0, b"/dev/ttyACM0 115200"), pack_frame(Kind.RX, 0, 1.1, scip.GREETING)]
    for k in range(3):
        t = 1.2 + 0.025 * k
        frames.append(pack_frame(Kind.RX, 0, t, scip.good(5000 + 25 * k)))
        frames.append(pack_frame(Kind.ODOMETRY, 0, t, pack_odometry(RawOdometry(t, t, 0.1 * k, 0.0, 0.0))))
        frames.append(pack_frame(Kind.IMU, 0, t, pack_imu(RawImu(t, t, 0.1))))
    frames += [pack_frame(Kind.NOTE, 0, 2.0, b"a gap"), pack_frame(Kind.LOST, 0, 2.1, b"unplugged")]
    frames += [pack_frame(Kind.BAUD, 0, 2.1, b"19200"), pack_frame(Kind.CYCLE, 0, 2.2, b"\x90")]
    return head + b"".join(frames)


def seeds() -> list[bytes]:
    return [carmen(), capture(), recording()]


def mend(data: bytes) -> bytes:
    """The sums of a recording: of its head, and of each record whose marker and length still stand."""
    if not data.startswith(b"LUMIREC\n") or len(data) < 18:
        return data
    end = 14 + struct.unpack_from("<I", data, 10)[0]
    if end + 4 > len(data):
        return data
    out, at = bytearray(data), end + 4
    out[end : end + 4] = struct.pack("<I", zlib.crc32(bytes(out[:end])))
    while (at := out.find(MARKER, at)) >= 0 and at + 20 <= len(out):
        kind, channel, length, t_mono = struct.unpack_from("<BBId", out, at + 2)
        payload = bytes(out[at + 20 : at + 20 + length])
        if len(payload) == length:
            crc = zlib.crc32(payload, zlib.crc32(struct.pack("<BBId", kind, channel, length, t_mono)))
            out[at + 16 : at + 20] = struct.pack("<I", crc)
            at += 20 + length
        else:
            at += 2
    return bytes(out)


def feeder() -> Callable[[bytes], None]:
    file = a_file("a.log")

    def play() -> None:
        source = open_log(file)
        for _ in islice(source.events(), EVENTS):
            pass
        source.report.sentences()

    def feed(data: bytes) -> None:
        file.write_bytes(data)
        said = refused(play, by=HalError)
        assert not said or "a.log" in said

    return feed

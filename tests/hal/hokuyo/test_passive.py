"""The listener: geometry from the bytes or given, streams by their echoes, damage counted; a real capture decodes."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hal.hokuyo.passive import PassiveHokuyo
from hal.hokuyo.payload import ScanRequest, parse_scan
from hal.hokuyo.scip import FrameSplitter, parse_reply, parse_text
from hal.lidar import VALID, LidarGeometry, RawScan
from tests.hal.hokuyo import encoder

UTM = encoder.text("VV", encoder.VV_UTM) + encoder.text("PP", encoder.PP_UTM)
ECHO = "MD0000000201000"


def frame(k: int, echo: str = ECHO, ranges: tuple[int, int, int] = (1000, 5, 60001)) -> bytes:
    return encoder.scan(echo, 1000 + 25 * k, encoder.payload([[(r,)] for r in ranges]))


def test_scans_with_codes_apart_from_ranges() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM, 0.0)
    assert listener.geometry is not None
    assert listener.geometry.serial == "H0900001"
    scans = [scan for k in range(10) for scan in listener.feed(frame(k), 1.0 + 0.025 * k)]
    assert [scan.seq for scan in scans] == list(range(10))
    assert scans[0].ranges.tolist() == [1000, 0, 0]
    assert scans[0].code.tolist() == [VALID, 5, 60001]
    assert scans[3].t_tick == 1075
    assert np.allclose(np.diff([scan.t_mono for scan in scans]), 0.025, atol=1e-4)
    assert 0.018 < scans[9].t_rx - scans[9].t_mono < 0.021
    assert listener.status.scans == 10
    assert listener.status.missed == 0


def test_without_geometry_scans_are_counted_and_with_a_given_one_used() -> None:
    blind = PassiveHokuyo()
    assert blind.feed(frame(0), 1.0) == []
    assert (blind.status.scans, blind.status.invalid) == (0, 1)
    given = LidarGeometry("UTM-30LX", "", "", 1440, 540, 0, 1080, 23, 60000, 0.001, 0.025, 0.025 / 1440)
    listener = PassiveHokuyo(given)
    (scan,) = listener.feed(frame(0), 1.0)
    assert scan.geometry is given


def test_odd_texts_and_their_order_do_not_matter() -> None:
    """VV with bytes above 127, or after PP; a PP that the firmware sums in its own way, twice; scans after either."""
    latin = encoder.text("VV", encoder.VV_UTM).replace(b"Hokuyo", b"H\xf6kuy\xf6")
    pp = encoder.text("PP", encoder.PP_UTM)
    odd = pp.replace(b"SCAN:2400;" + pp.rstrip()[-1:], b"SCAN:2400;z")
    assert odd != pp
    for texts, serial in (
        (latin + pp, "H0900001"),
        (pp + latin, "H0900001"),
        (odd + odd, ""),
        (latin + odd + odd, None),
    ):
        listener = PassiveHokuyo()
        listener.feed(texts, 0.0)
        (scan,) = listener.feed(frame(0), 1.0)
        assert scan.geometry.serial == ("H0900001" if serial is None else serial)


def test_damage_is_counted_and_leaves_a_gap_in_seq() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM, 0.0)
    damaged = frame(1).replace(b"0", b"1", 1)
    wire = [frame(0), damaged, frame(2), b"AT\n0Ee\n\n", frame(3)]
    scans = [scan for k, piece in enumerate(wire) for scan in listener.feed(piece, 1.0 + 0.025 * min(k, 3))]
    assert [scan.seq for scan in scans] == [0, 2, 3]
    assert listener.status.invalid == 1
    assert listener.status.missed == 1


def test_another_request_is_another_stream() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM, 0.0)
    (a,) = listener.feed(frame(0), 1.0)
    (b,) = listener.feed(frame(1, "MD0010001201000"), 1.025)
    assert (a.first_step, b.first_step) == (0, 10)
    (c,) = listener.feed(frame(2, "MD0010001201004"), 1.05)  # counted
    (d,) = listener.feed(frame(3, "MD0010001201003"), 1.075)
    assert d.t_mono > c.t_mono


def test_a_gap_in_the_recording_joins_nothing() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM + frame(0)[:-20], 1.0)
    listener.restart()
    (scan,) = listener.feed(frame(-30), 500.0)
    assert abs(scan.t_rx - scan.t_mono) < 0.05
    assert listener.status.clock_resets == 0


def chunks(path: Path) -> Iterator[tuple[float, bytes]]:
    data, at = path.read_bytes(), 0
    while at < len(data):
        micros, size = struct.unpack_from(">qI", data, at)
        yield 1e-6 * micros, data[at + 12 : at + 12 + size]
        at += 12 + size


def test_recorded_dialogue_with_a_real_sensor(log_root: Path) -> None:
    """Every reply of a real URG-04LX decodes, as the listener sees it and one by one."""
    captures = sorted((log_root / "scip").glob("*.logr"))
    assert captures
    for capture in captures:
        asked = b"".join(data for _, data in chunks(capture.with_suffix(".logw"))).split(b"\n")[:-1]
        splitter, listener = FrameSplitter(), PassiveHokuyo()
        frames: list[bytes] = []
        scans: list[RawScan] = []
        for t_rx, data in chunks(capture):
            frames += splitter.feed(data)
            scans += listener.feed(data, t_rx)
        replies = [parse_reply(piece) for piece in frames]
        assert splitter.dropped_bytes == 0
        assert splitter.feed(b"") == []
        assert not {reply.echo for reply in replies} - set(asked)
        assert len(replies) == 10
        for reply in replies:
            if reply.echo in (b"VV", b"PP", b"II"):
                assert reply.status == "00"
                assert len(parse_text(reply)) >= 5
            elif reply.echo.startswith(b"GD"):
                scan = parse_scan(ScanRequest.of_echo(reply.echo), reply)
                assert len(scan.distance) == 682
            else:
                assert (reply.echo, reply.status, reply.body) in {(b"BM", "02", b""), (b"CR00", "03", b"")}
        assert (listener.status.invalid, listener.status.resyncs, listener.status.error) == (0, 0, None)
        (scan_seen,) = scans
        codes, counts = np.unique(scan_seen.code, return_counts=True)
        assert dict(zip(codes.tolist(), counts.tolist(), strict=True)) == {VALID: 581, 0: 94, 7: 6, 10: 1}
        assert scan_seen.geometry.amax == 725


def test_single_scans_refusals_and_nonsense_parameters() -> None:
    listener = PassiveHokuyo()
    assert listener.feed(encoder.text("PP", [("MODL", "toaster")]), 0.0) == []
    assert "toaster" not in str(listener.geometry)
    assert "expected a number" in str(listener.status.error)
    listener.feed(UTM, 0.0)
    listener.feed(UTM, 0.5)  # the same again changes nothing
    (scan,) = listener.feed(encoder.scan("GD0000000201", 4000, "0CB1Dh7D`", "00"), 1.0)
    assert scan.ranges.tolist() == [1234, 5432, 30000]
    assert listener.feed(encoder.answer("GD0000000201", "10") + encoder.answer("MD0000000201000", "00"), 1.1) == []
    assert listener.status.invalid == 0
    assert listener.status.dialect == "SCIP 2 capture GD"


def test_noise_between_frames_is_a_resynchronisation() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM + frame(0), 1.0)
    listener.feed(b"\x55" * 400, 1.01)
    assert listener.status.resyncs == 1
    listener.feed(b"\n\n", 1.02)
    assert len(listener.feed(frame(1), 1.025)) == 1


def test_a_stamp_that_does_not_continue_the_clock_is_not_guessed_at() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM, 0.0)
    for k in range(30):
        assert len(listener.feed(frame(k), 1.0 + 0.025 * k)) == 1
    assert listener.feed(frame(5000), 1.75) == []
    assert listener.status.invalid == 1
    assert len(listener.feed(frame(31), 1.775)) == 1


def test_two_character_distances_saturate() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM, 0.0)
    (scan,) = listener.feed(encoder.scan("MS0000000201000", 1, "CBoooo"), 1.0)
    assert scan.ranges.tolist() == [1234, 0, 0]
    assert scan.code.tolist() == [VALID, 4095, 4095]


def test_echoes_are_kept_apart() -> None:
    listener = PassiveHokuyo()
    listener.feed(UTM, 0.0)
    steps = [[(1000,), (5,), (2000,)], [(3000,)], [(70000,), (400,)]]
    (scan,) = listener.feed(encoder.scan("ND0000000201000", 1, encoder.payload(steps)), 1.0)
    assert scan.ranges.tolist() == [1000, 3000, 0]
    assert scan.code.tolist() == [VALID, VALID, 70000]
    assert scan.echoes is not None
    assert scan.echoes.tolist() == [[0, 2000, 0], [0, 0, 0], [400, 0, 0]]

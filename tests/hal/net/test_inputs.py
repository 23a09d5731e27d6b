"""Odometry and IMU datagrams: bytes by hand, damage, order, restarts, two senders, times."""

import asyncio
import logging
import math
import socket
import struct
import time
import zlib
from collections.abc import Callable
from itertools import count, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.clock import SystemClock
from hal.errors import DataInvalid, DeviceRefused
from hal.imu import RawImu
from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, SHARED_CLOCK, InputDatagram, decode, encode
from hal.net.inputs import ABSENT_S, MAX_AGE_S, SESSION_TIMEOUT_S, Continuity, InputPort
from hal.odometry import RawOdometry

finite = st.floats(allow_nan=False, allow_infinity=False)
near = st.floats(-1e4, 1e4)
plausible = st.floats(-1e7, 1e7)
word = st.integers(0, 2**32 - 1)


def datagram(seq: int, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), session: int = 1) -> bytes:
    return encode(InputDatagram(ODOMETRY_MAGIC, session, seq, 0, 0.0, pose))


class Listening:
    """A port without a socket, and what it delivers."""

    def __init__(self) -> None:
        self.port = InputPort(SystemClock(), "127.0.0.1", 0)
        self.odometry: list[RawOdometry] = []
        self.imu: list[RawImu] = []
        self.port.send_odometry_to(self.odometry.append)
        self.port.send_imu_to(self.imu.append)
        self.t = 100.0

    def receive(self, data: bytes, after: float = 0.05) -> None:
        self.t += after
        self.port.receive(data, self.t)

    @property
    def poses(self) -> list[tuple[float, float, float]]:
        return [(round(o.x, 9), round(o.y, 9), round(o.yaw, 9)) for o in self.odometry]


# --- bytes -----------------------------------------------------------------------------------------------------------


def test_bytes_by_hand() -> None:
    body = b"LUOD" + struct.pack("<HHIIIIdddd", 1, 60, 7, 8, 1, 0, 12.5, 1.0, 2.0, 3.0)
    data = body + struct.pack("<I", zlib.crc32(body))
    assert decode(data) == InputDatagram(ODOMETRY_MAGIC, 7, 8, SHARED_CLOCK, 12.5, (1.0, 2.0, 3.0))
    body = b"LUIM" + struct.pack("<HHIIIIdd", 1, 44, 7, 8, 0, 0, 12.5, -0.25)
    data = body + struct.pack("<I", zlib.crc32(body))
    assert decode(data) == InputDatagram(IMU_MAGIC, 7, 8, 0, 12.5, (-0.25,))


@given(word, word, word, finite, st.tuples(plausible, plausible, plausible) | st.tuples(plausible))
def test_round_trip(session: int, seq: int, flags: int, t: float, values: tuple[float, ...]) -> None:
    magic = IMU_MAGIC if len(values) == 1 else ODOMETRY_MAGIC
    sent = InputDatagram(magic, session, seq, flags, t, values)
    assert decode(encode(sent)) == sent


def test_every_damaged_bit_is_noticed() -> None:
    good = datagram(1, (1.0, 2.0, 3.0))
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        with pytest.raises(DataInvalid):
            decode(bytes(bad))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d[:20], "too short"),
        (lambda d: b"XXXX" + d[4:], "unknown magic"),
        (lambda d: d[:4] + b"\x02\x00" + d[6:], "version 2"),
        (lambda d: d + b"\x00", "its length field is 60, but it has 61 bytes"),
        (lambda d: b"LUIM" + d[4:], "its length field is 60"),
        (lambda d: d[:-1] + bytes([d[-1] ^ 1]), "CRC-32"),
        (lambda d: datagram(1, (math.nan, 0.0, 0.0)), "not finite"),
        (lambda d: datagram(1, (0.0, math.inf, 0.0)), "not finite"),
        (lambda d: datagram(1, (0.0, 0.0, -1.1e7)), "beyond 1e"),
        (lambda d: encode(InputDatagram(ODOMETRY_MAGIC, 1, 1, 0, math.nan, (0.0, 0.0, 0.0))), "not finite"),
    ],
)
def test_what_is_wrong_is_said(change: Callable[[bytes], bytes], words: str) -> None:
    with pytest.raises(DataInvalid, match=words):
        decode(change(datagram(1)))


# --- order -----------------------------------------------------------------------------------------------------------


def test_loss_repetition_and_overtaking_are_told_apart() -> None:
    listening = Listening()
    for seq in (10, 11, 11, 14, 13, 15):
        listening.receive(datagram(seq, (seq, 0.0, 0.0)))
    assert [o.x for o in listening.odometry] == [10.0, 11.0, 14.0, 15.0]
    counts = listening.port.counts["odometry"]
    assert (counts.received, counts.lost, counts.duplicate, counts.late) == (4, 2, 1, 1)


def test_the_numbering_wraps() -> None:
    listening = Listening()
    for seq in (2**32 - 2, 2**32 - 1, 0, 1):
        listening.receive(datagram(seq))
    assert listening.port.counts["odometry"].received == 4
    assert listening.port.counts["odometry"].lost == 0


def test_damage_is_counted_and_dropped() -> None:
    listening = Listening()
    for data in (b"", b"LUOD", bytes(60), datagram(1)[:-1]):
        listening.receive(data)
    assert listening.port.invalid == 4
    assert listening.odometry == []


def test_both_kinds_are_numbered_apart() -> None:
    listening = Listening()
    for seq in (5, 6):
        listening.receive(datagram(seq))
        listening.receive(encode(InputDatagram(IMU_MAGIC, 1, seq, 0, 0.0, (0.5,))))
    assert len(listening.odometry) == len(listening.imu) == 2
    assert listening.imu[0].yaw_rate == 0.5
    assert listening.port.counts["imu"].lost == 0


# --- restarts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("session", [2, 1], ids=["new session", "same session"])
def test_a_restarted_sender_makes_no_jump(session: int) -> None:
    """It begins again at its origin, heading elsewhere; what is delivered goes on from where it was."""
    listening = Listening()
    listening.receive(datagram(1000, (5.0, 0.0, 0.0)))
    listening.receive(datagram(1001, (5.0, 1.0, math.pi / 2)))
    listening.receive(datagram(1, (0.0, 0.0, 0.0), session), after=SESSION_TIMEOUT_S + 0.1)
    listening.receive(datagram(2, (1.0, 0.0, 0.0), session))
    assert listening.poses[1:] == [
        (5.0, 1.0, round(math.pi / 2, 9)),
        (5.0, 1.0, round(math.pi / 2, 9)),
        (5.0, 2.0, round(math.pi / 2, 9)),
    ]
    assert listening.port.counts["odometry"].restarts == 1


def test_a_quick_restart_under_the_same_session_is_taken_after_the_timeout() -> None:
    listening = Listening()
    listening.receive(datagram(1000, (5.0, 0.0, 0.0)))
    for seq in range(1, 40):
        listening.receive(datagram(seq, (float(seq), 0.0, 0.0)))
    counts = listening.port.counts["odometry"]
    assert counts.late == pytest.approx(SESSION_TIMEOUT_S / 0.05, abs=1)
    assert counts.restarts == 1
    steps = [b.x - a.x for a, b in pairwise(listening.odometry)]
    assert steps[0] == pytest.approx(0.0)
    assert steps[1:] == pytest.approx([1.0] * len(steps[1:]))


def test_a_second_sender_is_ignored_while_the_first_is_heard() -> None:
    listening = Listening()
    for seq in range(1, 30):
        listening.receive(datagram(seq, (seq * 0.1, 0.0, 0.0), session=1))
        listening.receive(datagram(seq, (50.0, 50.0, 0.0), session=2))
    assert all(o.y == 0.0 for o in listening.odometry)
    assert listening.port.counts["odometry"].foreign == 29
    assert listening.port.counts["odometry"].restarts == 0


def test_a_second_sender_and_what_is_no_reading_are_said_once_while_they_last(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    listening = Listening()

    def both(seconds: float, wrong: bytes) -> list[str]:
        caplog.clear()
        for _ in range(round(seconds / 0.1)):
            listening.receive(datagram(next(numbers)))
            listening.receive(wrong)
        return [record.message for record in caplog.records]

    numbers = count(1)
    rival, damaged = datagram(1, session=2), datagram(1)[:-1]
    assert both(0.8, rival) == both(0.8, damaged) == [], "a quick restart, some damage: no line of the log"
    assert both(3.0, rival) == [
        "port 0: readings from a sender are ignored while another sender is active (end one of them)"
    ]
    assert both(3.0, damaged) == [
        "port 0: a datagram from a sender is not a valid reading: "
        "input datagram: its length field is 60, but it has 59 bytes"
    ]
    assert both(3.0, rival) == both(3.0, damaged) == []
    listening.t += ABSENT_S
    assert len(both(3.0, rival)) == len(both(3.0, damaged)) == 1, "on another day it is news"


@given(st.lists(st.tuples(near, near, near), min_size=2, max_size=6))
def test_continuity_keeps_relative_motion(poses: list[tuple[float, float, float]]) -> None:
    """Restarting between any two poses delivers the same relative motions within each stretch."""
    continuity = Continuity()
    first = continuity.transform(*poses[0])
    assert first == pytest.approx(poses[0])
    continuity.restart()
    delivered = [continuity.transform(*pose) for pose in poses[1:]]
    assert delivered[0] == pytest.approx(first, abs=1e-6)
    for (a, b), (c, d) in zip(pairwise(poses[1:]), pairwise(delivered), strict=True):
        assert relative(c, d) == pytest.approx(relative(a, b), abs=1e-5)


def relative(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return c * dx + s * dy, -s * dx + c * dy, b[2] - a[2]


# --- times -----------------------------------------------------------------------------------------------------------


def shared(t: float) -> bytes:
    return encode(InputDatagram(ODOMETRY_MAGIC, 1, int(t * 1000) % 2**32, SHARED_CLOCK, t, (0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("age", "believed"),
    [(0.02, True), (0.0, True), (-0.0005, False), (-0.1, False), (MAX_AGE_S - 0.1, True), (MAX_AGE_S + 0.1, False)],
)
def test_a_shared_clock_is_believed_within_reason(age: float, believed: bool) -> None:
    listening = Listening()
    listening.port.receive(shared(100.0 - age), 100.0)
    (reading,) = listening.odometry
    assert reading.t_mono == pytest.approx(100.0 - age if believed else 100.0)
    assert reading.t_mono <= reading.t_rx == 100.0


def test_another_clock_is_not_mixed_with_ours() -> None:
    listening = Listening()
    listening.receive(datagram(1))
    assert listening.odometry[0].t_mono == listening.odometry[0].t_rx == listening.t


# --- over a real socket ----------------------------------------------------------------------------------------------


async def test_sources_share_one_port_and_stamp_with_the_kernels_time() -> None:
    """The loop is held up for 0.2 s with datagrams in the socket: their stamps are of arrival, not of reading."""
    odometry: list[RawOdometry] = []
    imu: list[RawImu] = []
    port = InputPort(SystemClock(), "127.0.0.1", 0)
    tasks = [asyncio.create_task(port.odometry.run(odometry.append)), asyncio.create_task(port.imu.run(imu.append))]
    await asyncio.sleep(0.01)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        before = time.monotonic()
        for seq in range(20):
            sender.sendto(datagram(seq, (seq, 0.0, 0.0)), ("127.0.0.1", port.port))
        sender.sendto(encode(InputDatagram(IMU_MAGIC, 1, 0, 0, 0.0, (0.5,))), ("127.0.0.1", port.port))
        after = time.monotonic()
    time.sleep(0.2)  # noqa: ASYNC251  # the loop is to be held up
    await asyncio.sleep(0.05)
    address = port.port
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", address))
    before, after = (before, after)
    assert [o.x for o in odometry] == [float(n) for n in range(20)]
    assert len(imu) == 1
    for reading in (*odometry, *imu):
        assert before - 0.02 <= reading.t_rx <= after + 0.02


def test_two_sources_that_cannot_listen_both_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second asks while the first still looks the name up; when that fails, it must not believe it is listening."""
    from hal.net import inet

    async def slow(host: str, port: int, *, passive: bool = False) -> list[inet.Address]:
        await asyncio.sleep(0.01)
        return [(socket.AF_INET, ("127.0.0.1", port))]

    monkeypatch.setattr(inet, "resolve", slow)

    async def run(number: int) -> None:
        port = InputPort(SystemClock(), "robot.local", number)
        ends = await asyncio.wait_for(
            asyncio.gather(port.odometry.run(lambda _: None), port.imu.run(lambda _: None), return_exceptions=True), 5.0
        )
        assert [type(end) for end in ends] == [DeviceRefused, DeviceRefused]

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        asyncio.run(run(taken.getsockname()[1]))


def test_a_kernel_stamp_from_before_a_clock_step_is_not_believed() -> None:
    from hal.net.rx_timestamp import _SO_TIMESTAMPNS, kernel_age

    def stamp(age: float) -> list[tuple[int, int, bytes]]:
        ns = time.clock_gettime_ns(time.CLOCK_REALTIME) - int(age * 1e9)
        return [(socket.SOL_SOCKET, _SO_TIMESTAMPNS, struct.pack("@ll", ns // 10**9, ns % 10**9))]

    assert kernel_age(stamp(0.25)) == pytest.approx(0.25, abs=0.1)
    assert kernel_age(stamp(-5.0)) == 0.0
    assert kernel_age(stamp(3600.0)) == 0.0
    assert kernel_age([]) == 0.0


def test_a_port_in_use_is_refused_with_a_remedy() -> None:
    async def run(port: int) -> None:
        source = InputPort(SystemClock(), "127.0.0.1", port)
        with pytest.raises(
            DeviceRefused, match=rf"input datagrams on 127.0.0.1:{port}: the port is in use .*odometry\.port"
        ):
            await source.odometry.run(lambda _: None)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        asyncio.run(run(taken.getsockname()[1]))

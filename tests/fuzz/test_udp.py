"""Datagrams that nobody should send, to every reader of datagrams: refused by its own error, or taken whole."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import registers
from hal.clock import SystemClock
from hal.errors import DataInvalid
from hal.imu import RawImu
from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, InputDatagram, decode, encode
from hal.net.inputs import InputPort
from hal.odometry import RawOdometry
from tests.daemon.publish.modbus.test_registers import snapshot, snapshots

MUTATIONS = 20_000


def mutated(data: bytes, chance: random.Random) -> bytes:
    """One of the things that happen to datagrams: bits, bytes, cuts, doubled parts, swapped parts."""
    cut = chance.randrange(len(data))
    kind = chance.randrange(5)
    if kind == 0:
        return data[:cut] + bytes([data[cut] ^ 1 << chance.randrange(8)]) + data[cut + 1 :]
    if kind == 1:
        return data[:cut] + chance.randbytes(chance.randrange(1, 9)) + data[cut + 8 :]
    if kind == 2:
        return data[:cut]
    if kind == 3:
        return data + data[cut:]
    return data[cut:] + data[:cut]


def test_no_mutated_pose_datagram_is_taken_for_another() -> None:
    chance, good = random.Random(7), registers.encode_datagram(snapshot())
    values = registers.decode_datagram(good)
    for _ in range(MUTATIONS):
        try:
            got = registers.decode_datagram(mutated(good, chance))
        except ValueError:
            continue
        assert got == values


@pytest.mark.parametrize("magic", [ODOMETRY_MAGIC, IMU_MAGIC])
def test_no_mutated_input_datagram_is_taken_for_another(magic: bytes) -> None:
    chance = random.Random(8)
    sent = InputDatagram(magic, 1, 2, 0, 3.0, (4.0, 5.0, 6.0) if magic == ODOMETRY_MAGIC else (4.0,))
    for _ in range(MUTATIONS):
        try:
            got = decode(mutated(encode(sent), chance))
        except DataInvalid:
            continue
        assert got == sent


@given(st.binary(max_size=300))
def test_rubbish_is_refused_by_name(data: bytes) -> None:
    with pytest.raises(ValueError, match="datagram"):
        registers.decode_datagram(data)
    with pytest.raises(DataInvalid):
        decode(data)


@given(snapshots)
def test_every_snapshot_makes_a_datagram_that_reads_back(taken: object) -> None:
    data = registers.encode_datagram(taken)  # type: ignore[arg-type]  # hypothesis builds Snapshots
    assert len(data) == registers.DATAGRAM_SIZE
    assert registers.decode_datagram(data)["state"] == taken.state  # type: ignore[attr-defined]  # the same


numbers = st.floats(allow_nan=True, allow_infinity=True)
sendings = st.builds(
    lambda magic, session, seq, flags, t, values: encode(
        InputDatagram(magic, session, seq, flags, t, values if magic == ODOMETRY_MAGIC else values[:1])
    ),
    st.sampled_from([ODOMETRY_MAGIC, IMU_MAGIC]),
    st.integers(0, 2),
    st.integers(0, 4) | st.integers(0, 2**32 - 1),
    st.integers(0, 3),
    numbers,
    st.tuples(numbers, numbers, numbers),
)


@given(st.lists(st.tuples(sendings | st.binary(max_size=80), st.floats(0.0, 3.0)), max_size=40))
def test_whatever_comes_in_what_is_delivered_is_sound(arrivals: list[tuple[bytes, float]]) -> None:
    """No exception, every datagram counted once, only finite values, times not in the future and never far back."""
    port = InputPort(SystemClock(), "127.0.0.1", 0)
    odometry: list[RawOdometry] = []
    imu: list[RawImu] = []
    port.send_odometry_to(odometry.append)
    port.send_imu_to(imu.append)
    t = 1000.0
    for data, pause in arrivals:
        t += pause
        port.receive(data, t)
    counts = port.counts.values()
    told = sum(c.received + c.late + c.duplicate + c.foreign for c in counts)
    assert told + port.invalid == len(arrivals)
    assert sum(c.received for c in counts) == len(odometry) + len(imu)
    for reading in (*odometry, *imu):
        assert reading.t_rx - 1.0 <= reading.t_mono <= reading.t_rx
    assert all(map(math.isfinite, (r.yaw_rate for r in imu)))
    assert all(math.isfinite(v) for o in odometry for v in (o.x, o.y, o.yaw))

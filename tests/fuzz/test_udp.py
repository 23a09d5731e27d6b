"""Datagrams that nobody should send, to every reader of datagrams: refused by its own error, or taken whole."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import registers
from hal.clock import SystemClock
from hal.imu import RawImu
from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, InputDatagram, encode
from hal.net.inputs import InputPort
from hal.odometry import RawOdometry
from tests.daemon.publish.modbus.test_registers import snapshots


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

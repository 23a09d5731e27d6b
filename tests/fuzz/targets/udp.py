"""Datagrams: what brings odometry and gyro readings, what asks for poses, and what a client of the pose reads."""

import math
import struct
import zlib
from collections.abc import Callable

from daemon.publish import udp_subscriptions
from daemon.publish.modbus import registers
from hal.clock import SystemClock
from hal.errors import DataInvalid
from hal.imu import RawImu
from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, InputDatagram, decode, encode
from hal.net.inputs import InputPort
from hal.odometry import RawOdometry
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.fuzz.targets import refused

MEGABYTES = 10


def seeds() -> list[bytes]:
    readings = [
        InputDatagram(ODOMETRY_MAGIC, 7, k, k % 2, 1000.0 + k, (0.1 * k, -0.2, 3.0)) for k in (0, 1, 2, 5, 2**32 - 1)
    ]
    gyro = [InputDatagram(IMU_MAGIC, 8, k, 1, 1000.0, (0.5,)) for k in (0, 3)]
    cookie = udp_subscriptions.Leases(bytes(32))._cookie((("192.0.2.1", udp_subscriptions.SIZE), ()), 1000.0)
    asked = [udp_subscriptions.Message(udp_subscriptions.Status(k), 60, (0, cookie)[k % 2]) for k in range(5)]
    asked += [udp_subscriptions.Message(udp_subscriptions.Status.ASK, lease, cookie) for lease in (0, 1, 65535)]
    sent = [*(encode(one) for one in (*readings, *gyro)), registers.encode_datagram(snapshot())]
    return [*sent, *(udp_subscriptions.encode(one) for one in asked)]


def mend(data: bytes) -> bytes:
    """The length that there is, and the sum that belongs to it."""
    if len(data) < 16:
        return data
    if data[:4] in (ODOMETRY_MAGIC, IMU_MAGIC):
        data = data[:6] + struct.pack("<H", len(data) & 0xFFFF) + data[8:]
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def feeder() -> Callable[[bytes], None]:
    port, state = InputPort(SystemClock(), "127.0.0.1", 0), {"t": 1000.0, "fed": 0}
    leases = udp_subscriptions.Leases(bytes(32))
    odometry: list[RawOdometry] = []
    imu: list[RawImu] = []
    port.send_odometry_to(odometry.append)
    port.send_imu_to(imu.append)

    def feed(data: bytes) -> None:
        state["t"] += 0.01
        state["fed"] += 1
        port.receive(data, state["t"])
        counts = port.counts.values()
        assert sum(c.received + c.late + c.duplicate + c.foreign for c in counts) + port.invalid == state["fed"]
        for reading in (*odometry, *imu):
            assert reading.t_rx - 1.0 <= reading.t_mono <= reading.t_rx
        assert all(map(math.isfinite, (r.yaw_rate for r in imu)))
        assert all(math.isfinite(v) for o in odometry for v in (o.x, o.y, o.yaw))
        odometry.clear()
        imu.clear()
        for reader, error in ((decode, DataInvalid), (registers.decode_datagram, ValueError)):
            said = refused(reader, data, by=error)
            assert "datagram" in said or mend(data) == data, "what is taken carries its own sum"
        subscribing(data)

    def subscribing(data: bytes) -> None:
        asked: list[udp_subscriptions.Message] = []
        refused(lambda: asked.append(udp_subscriptions.decode(data)), by=ValueError)
        for message in asked:
            answer = leases.answer((("192.0.2.1", len(data)), ()), message, state["t"])
            assert answer is None or len(udp_subscriptions.encode(answer)) <= len(data)
            assert len(leases) <= udp_subscriptions.SUBSCRIBERS

    return feed

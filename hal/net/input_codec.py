"""Codec of the odometry and IMU datagrams: bytes to values and back, no sockets.

Both datagrams are little-endian and end with the CRC-32 (zlib, IEEE 802.3) of everything before it::

    0   4s   magic  "LUOD" odometry, "LUIM" IMU
    4   u16  version, 1
    6   u16  length of the whole datagram
    8   u32  session: a number the sender draws when it starts
    12  u32  seq: one more with every datagram of this kind, wraps
    16  u32  flags: bit 0: `time` is CLOCK_MONOTONIC of the daemon's own computer
    20  u32  0
    24  f64  time of the reading in seconds, in the sender's clock
    32  f64  odometry: x (m) | IMU: yaw rate (rad/s, counter-clockwise)
    40  f64  odometry: y (m)
    48  f64  odometry: yaw (rad, counter-clockwise, wrapped or not)

An odometry datagram has 60 bytes, an IMU datagram 44. Odometry is cumulative, so a lost datagram loses nothing.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Final

from hal.errors import DataInvalid

VERSION: Final = 1
ODOMETRY_MAGIC: Final = b"LUOD"
IMU_MAGIC: Final = b"LUIM"
SHARED_CLOCK: Final = 1  # flag: `time` is this computer's CLOCK_MONOTONIC

_HEAD: Final = struct.Struct("<4sHHIIII")
_BODY: Final = {ODOMETRY_MAGIC: struct.Struct("<dddd"), IMU_MAGIC: struct.Struct("<dd")}
_CRC: Final = struct.Struct("<I")
ODOMETRY_SIZE: Final = _HEAD.size + _BODY[ODOMETRY_MAGIC].size + _CRC.size
IMU_SIZE: Final = _HEAD.size + _BODY[IMU_MAGIC].size + _CRC.size
LARGEST: Final = 1e7  # m, rad, rad/s: a pose further out could not be followed to a millimetre
_DEVICE: Final = "input datagram"


@dataclass(frozen=True, slots=True)
class InputDatagram:
    """One datagram: its kind by `magic`, `values` are (x, y, yaw) or (yaw rate,)."""

    magic: bytes
    session: int
    seq: int
    flags: int
    time: float
    values: tuple[float, ...]


def encode(datagram: InputDatagram) -> bytes:
    """Bytes of a datagram."""
    body = _BODY[datagram.magic].pack(datagram.time, *datagram.values)
    length = _HEAD.size + len(body) + _CRC.size
    data = _HEAD.pack(datagram.magic, VERSION, length, datagram.session, datagram.seq, datagram.flags, 0) + body
    return data + _CRC.pack(zlib.crc32(data))


def decode(data: bytes) -> InputDatagram:
    """A datagram from its bytes.

    Raises:
        DataInvalid: not such a datagram, another version, damaged, or a value out of range.
    """
    if len(data) < _HEAD.size + _CRC.size:
        raise DataInvalid(_DEVICE, f"{len(data)} bytes are too short")
    magic, version, length, session, seq, flags, _ = _HEAD.unpack_from(data)
    body = _BODY.get(magic)
    if body is None:
        raise DataInvalid(_DEVICE, f"unknown magic {magic!r}", "expected LUOD or LUIM")
    if version != VERSION:
        raise DataInvalid(_DEVICE, f"version {version}", f"this daemon reads version {VERSION}")
    if length != len(data) or length != _HEAD.size + body.size + _CRC.size:
        raise DataInvalid(_DEVICE, f"its length field is {length}, but it has {len(data)} bytes")
    if _CRC.unpack_from(data, length - _CRC.size)[0] != zlib.crc32(data[: -_CRC.size]):
        raise DataInvalid(_DEVICE, "CRC-32 differs")
    t_sender, *values = body.unpack_from(data, _HEAD.size)
    if not math.isfinite(t_sender) or not all(abs(value) <= LARGEST for value in values):
        raise DataInvalid(_DEVICE, f"a value is not finite, or beyond {LARGEST:g}")
    return InputDatagram(magic, session, seq, flags, t_sender, tuple(values))

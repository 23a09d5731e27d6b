"""Table of all published points: source of the Modbus block, UDP datagram, float mirror, and their documents.

The points of :data:`BODY` are the same, in the same order and scale, in both forms; only the byte order and the header
and end around them differ::

    Modbus    magic u16, version u16 | BODY, big-endian, high word first  | seq_end u32        64 registers at 0
    datagram  "LUMI",    version u16, length u16 | BODY, two tails, little-endian | CRC-32     172 bytes
    mirror    seq u32 | float32 of every scaled point, covariance | seq_end u32                at 100

The tails are TAIL of :mod:`daemon.publish.modbus.lights_block` and of :mod:`daemon.publish.modbus.integrity_block`;
each has a block of registers of its own.

Every 32- and 64-bit point is naturally aligned in the datagram. The contract: a point never moves and never changes its
meaning under the same version number (the tests compare a fixed copy of the layout). A datagram may grow at its end
under the same version; readers use `length`.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable
from operator import attrgetter
from typing import Final

from daemon.publish.modbus import integrity_block, lights_block
from daemon.publish.modbus.points import I16, I32, U16, U32, U64, FloatPoint, Layout, Point, Rule, Value
from daemon.snapshot import Snapshot, State

VERSION: Final = 1
MODBUS_MAGIC: Final = 0x4C4C  # "LL"
DATAGRAM_MAGIC: Final = b"LUMI"
MIRROR_ADDRESS: Final = 100

Getter = Callable[[Snapshot], Value]


def _part(name: str, index: int) -> Getter:
    """Getter of one component of a triple that may be missing as a whole."""
    triple = attrgetter(name)

    def get(snapshot: Snapshot) -> Value:
        values = triple(snapshot)
        return None if values is None else float(values[index])

    return get


def _yaw(name: str) -> Getter:
    """Getter of the third component of a pose, wrapped to [-pi, pi]."""
    part = _part(name, 2)

    def get(snapshot: Snapshot) -> Value:
        yaw = part(snapshot)
        return None if yaw is None or not math.isfinite(yaw) else math.remainder(yaw, math.tau)

    return get


def _sigma(index: int) -> Getter:
    """Getter of the square root of a variance; a negative variance is not known."""

    def get(snapshot: Snapshot) -> Value:
        covariance = snapshot.covariance
        return math.sqrt(covariance[index]) if covariance is not None and covariance[index] >= 0.0 else None

    return get


def _rho(cross: int, first: int, second: int) -> Getter:
    """Getter of a correlation coefficient; 0 where a variance is 0, not known where it is not finite."""

    def get(snapshot: Snapshot) -> Value:
        covariance = snapshot.covariance
        if covariance is None:
            return None
        product = covariance[first] * covariance[second]
        if product == 0.0:
            return 0.0
        rho = covariance[cross] / math.sqrt(product) if 0.0 < product < math.inf else math.nan
        return max(-1.0, min(1.0, rho)) if math.isfinite(rho) else None

    return get


def _cycle(snapshot: Snapshot) -> Value:
    return None if snapshot.cycle_us is None else snapshot.cycle_us * 1e-6


def _heartbeat(snapshot: Snapshot) -> Value:
    tenths = snapshot.t_sent * 10.0
    return int(tenths) if math.isfinite(tenths) else 0


Bit = tuple[str, str, Callable[[Snapshot], bool]]

FLAGS: Final[tuple[Bit, ...]] = (
    (
        "pose_valid",
        "there is a pose in the map frame; unconfirmed in AMBIGUOUS, RELOCATING, LOST",
        lambda s: s.pose is not None,
    ),
    ("odom_valid", "there is a pose in the odom frame", lambda s: s.odom is not None),
    ("x_known", "x of the map pose is observed, not only predicted", lambda s: s.known[0]),
    ("y_known", "y of the map pose is observed", lambda s: s.known[1]),
    ("yaw_known", "the heading in the map is observed", lambda s: s.known[2]),
    (
        "loop_closed",
        "at least one loop closure since the start; `loop_counter` counts them",
        lambda s: s.loop_counter > 0,
    ),
    (
        "bounded",
        "there is a protection level of the map pose: `protection`",
        lambda s: s.trust.horizontal_m is not None,
    ),
    ("alert", "the protection level is above the alert limit, or there is none", lambda s: s.trust.alert),
    (
        "loop_latched",
        "a loop was closed after the last acknowledged one (Modbus, `loop_seen`)",
        lambda s: s.loop_latched,
    ),
)
DEVICES: Final[tuple[Bit, ...]] = (
    ("lidar_fitted", "a lidar is configured", lambda s: s.lidar_ok is not None),
    ("lidar_ok", "the lidar is configured and delivers valid scans", lambda s: bool(s.lidar_ok)),
    ("adc_fitted", "a photodiode converter is configured", lambda s: s.adc_ok is not None),
    ("adc_ok", "the converter is configured and delivers valid samples", lambda s: bool(s.adc_ok)),
    ("odometry_fitted", "an odometry input is configured", lambda s: s.odometry_ok is not None),
    ("odometry_ok", "odometry is configured and delivers valid readings", lambda s: bool(s.odometry_ok)),
)


def _bits(table: tuple[Bit, ...]) -> Getter:
    tests = tuple((1 << number, test) for number, (_, _, test) in enumerate(table))

    def get(snapshot: Snapshot) -> Value:
        return sum(mask for mask, test in tests if test(snapshot))

    return get


def _pose(frame: str, source: str, text: str) -> tuple[Point, ...]:
    yaw_text = "Counter-clockwise from the frame's x axis, in [-pi, pi]."
    return (
        Point(f"{frame}_x", f"position x, {text}", I32, _part(source, 0), "", 10_000, "m"),
        Point(f"{frame}_y", f"position y, {text}", I32, _part(source, 1), "", 10_000, "m"),
        Point(f"{frame}_yaw", f"heading, {text}", I32, _yaw(source), yaw_text, 1_000_000, "rad"),
    )


_SIGMA_TEXT: Final = "One standard deviation, rounded up; the largest value means this or more."
_RHO_TEXT: Final = "Correlation coefficient of the map pose's covariance."
_KEYFRAME_TEXT: Final = "Keyframe ID in the latest loop closure; not known before the first."
_STATES: Final = ", ".join(f"{state.value} {state.name}" for state in State)

BODY: Final = Layout(
    (
        Point("seq", "snapshot number", U32, attrgetter("seq"), "Increases by one with every snapshot.", rule=Rule.WRAP,
              can_be_unknown=False),
        Point("state", "state", U16, attrgetter("state"), f"{_STATES}.", can_be_unknown=False),
        Point("reason", "reason for the state", U16, attrgetter("reason"), "See below; 0: none.", can_be_unknown=False),
        Point("fault", "gravest present fault", U16, attrgetter("fault"), "See below; 0: none.", can_be_unknown=False),
        Point("flags", "flags", U16, _bits(FLAGS), "Bits, see below.", can_be_unknown=False),
        Point("heartbeat", "heartbeat", U16, _heartbeat,
          "Ten per second of the daemon's clock; stops when the cycle stops.", rule=Rule.WRAP, can_be_unknown=False),
        Point("age", "age of the pose", U16, lambda s: s.t_sent - s.t_mono,
          "From the time of the pose to the time of sending.", 10_000, "s"),
        Point("t_mono", "time of the pose", U64, attrgetter("t_mono"), "Monotonic clock of the daemon's computer; "
              "never steps.", 1_000_000, "s"),
        Point("t_utc", "time of sending, UTC", U64, attrgetter("t_utc"),
          "Since 1970-01-01; steps when the computer's clock is set. The time of the pose is `age` earlier.", 1_000_000,
          "s"),
        *_pose("map", "pose", "map frame"),
        *_pose("predicted", "predicted", "map frame, predicted to the time of sending"),
        *_pose("odom", "odom", "odom frame (smooth, never jumps)"),
        Point("sigma_x", "sigma of map_x", U16, _sigma(0), _SIGMA_TEXT, 10_000, "m", ceil=True),
        Point("sigma_y", "sigma of map_y", U16, _sigma(2), _SIGMA_TEXT, 10_000, "m", ceil=True),
        Point("sigma_yaw", "sigma of map_yaw", U16, _sigma(5), _SIGMA_TEXT, 10_000, "rad", ceil=True),
        Point("rho_x_y", "correlation x, y", I16, _rho(1, 0, 2), _RHO_TEXT, 10_000),
        Point("rho_x_yaw", "correlation x, yaw", I16, _rho(3, 0, 5), _RHO_TEXT, 10_000),
        Point("rho_y_yaw", "correlation y, yaw", I16, _rho(4, 2, 5), _RHO_TEXT, 10_000),
        Point("v_x", "forward speed", I16, _part("velocity", 0), "In the base frame.", 1000, "m/s"),
        Point("v_y", "sideways speed", I16, _part("velocity", 1), "In the base frame, left positive.", 1000, "m/s"),
        Point("yaw_rate", "turn rate", I16, _part("velocity", 2), "Counter-clockwise.", 1000, "rad/s"),
        Point("jumps", "jump count", U16, attrgetter("jumps"),
          "Number of changes of the map pose against the odom pose by more than 5 cm or 1 deg at once.", rule=Rule.WRAP,
          can_be_unknown=False),
        Point("map_id", "map", U32, attrgetter("map_id"), "Identity of the map frame; 0: none yet.", rule=Rule.WRAP,
              can_be_unknown=False),
        Point("loop_new", "loop closure, new end", U32, attrgetter("loop_new"), _KEYFRAME_TEXT),
        Point("loop_old", "loop closure, old end", U32, attrgetter("loop_old"), _KEYFRAME_TEXT),
        Point("loop_counter", "loop closures", U16, attrgetter("loop_counter"), "Accepted since the start.",
              rule=Rule.WRAP, can_be_unknown=False),
        Point("links", "lamps in view", U16, attrgetter("links"), "Not known: no photodiode is configured."),
        Point("light_id", "strongest light", U16, attrgetter("light_id"), "Number of the strongest lamp in view."),
        Point("scan_rate", "scan rate", U16, attrgetter("scan_rate"), "Valid scans per second.", 100, "Hz"),
        Point("missed", "scans missed", U32, attrgetter("missed"), "Since the start.", rule=Rule.WRAP,
              can_be_unknown=False),
        Point("overruns", "cycles over budget", U32, attrgetter("overruns"), "Since the start.", rule=Rule.WRAP,
              can_be_unknown=False),
        Point("cycle", "cycle time", U16, _cycle, "Computing time of the last cycle.", 100_000, "s"),
        Point("devices", "devices", U16, _bits(DEVICES), "Bits, see below.", can_be_unknown=False),
    )
)  # fmt: skip

_COVARIANCE: Final = (("xx", "m^2"), ("xy", "m^2"), ("yy", "m^2"), ("x_yaw", "m rad"), ("y_yaw", "m rad"),
                      ("yaw_yaw", "rad^2"))  # fmt: skip
MIRROR: Final[tuple[FloatPoint, ...]] = (
    *(FloatPoint(p.name, p.label, p.unit, p.value) for p in BODY.points if p.per_unit > 1 and p.wire is not U64),
    *(
        FloatPoint(f"cov_{name}", f"covariance {name.replace('_', ', ')}", unit, _part("covariance", i))
        for i, (name, unit) in enumerate(_COVARIANCE)
    ),
)

_BLOCK_HEAD: Final = struct.Struct(">HH")
_BLOCK_TAIL: Final = struct.Struct(">I")
BODY_ADDRESS: Final = _BLOCK_HEAD.size // 2
BLOCK_WORDS: Final = BODY_ADDRESS + BODY.words + _BLOCK_TAIL.size // 2

_MIRROR: Final = struct.Struct(f">I{len(MIRROR)}fI")
MIRROR_WORDS: Final = _MIRROR.size // 2
_MIRROR_PLAN: Final = tuple((p.encode, p.value) for p in MIRROR)

_DATAGRAM_HEAD: Final = struct.Struct("<4sHH")
_CRC: Final = struct.Struct("<I")
BODY_OFFSET: Final = _DATAGRAM_HEAD.size
TAIL_OFFSET: Final = BODY_OFFSET + BODY.little.size
TRUST_OFFSET: Final = TAIL_OFFSET + lights_block.TAIL.little.size
SMALLEST_DATAGRAM: Final = TAIL_OFFSET + _CRC.size
"""Size without a tail, in bytes, as the first programs of this version sent it."""
DATAGRAM_SIZE: Final = TRUST_OFFSET + integrity_block.TAIL.little.size + _CRC.size
_TAILS: Final = ((TAIL_OFFSET, lights_block.TAIL), (TRUST_OFFSET, integrity_block.TAIL))


def encode_block(snapshot: Snapshot) -> bytes:
    """The 64 input registers at address 0 (big-endian, 128 bytes)."""
    raw = BODY.raw(snapshot)
    return _BLOCK_HEAD.pack(MODBUS_MAGIC, VERSION) + BODY.big.pack(*raw) + _BLOCK_TAIL.pack(raw[0])


def encode_mirror(snapshot: Snapshot) -> bytes:
    """The float32 mirror at :data:`MIRROR_ADDRESS` (big-endian, high word first)."""
    seq = BODY.points[0].encode(snapshot.seq)
    return _MIRROR.pack(seq, *[encode(value(snapshot)) for encode, value in _MIRROR_PLAN], seq)


def encode_datagram(snapshot: Snapshot) -> bytes:
    """The UDP pose datagram (little-endian, CRC-32 of everything before it at the end)."""
    head = _DATAGRAM_HEAD.pack(DATAGRAM_MAGIC, VERSION, DATAGRAM_SIZE)
    tails = b"".join([tail.little.pack(*tail.raw(snapshot)) for _, tail in _TAILS])
    data = head + BODY.little.pack(*BODY.raw(snapshot)) + tails
    return data + _CRC.pack(zlib.crc32(data))


def decode_block(block: bytes) -> dict[str, Value]:
    """Decode the 64 registers to values by name.

    Raises:
        ValueError: not this block, a version this decoder does not support, or torn (seq differs at its ends).
    """
    if len(block) != 2 * BLOCK_WORDS:
        raise ValueError(f"the block has {BLOCK_WORDS} registers, got {len(block) / 2:g}")
    magic, version = _BLOCK_HEAD.unpack_from(block)
    if magic != MODBUS_MAGIC:
        raise ValueError(f"magic is {magic:#06x}, expected {MODBUS_MAGIC:#06x}: not a lumiloop register block")
    if version != VERSION:
        raise ValueError(f"register map version {version}, this reader needs version {VERSION}")
    raw = BODY.big.unpack_from(block, _BLOCK_HEAD.size)
    (seq_end,) = _BLOCK_TAIL.unpack_from(block, len(block) - _BLOCK_TAIL.size)
    if raw[0] != seq_end:
        raise ValueError(f"torn block: seq is {raw[0]} at its begin and {seq_end} at its end; read it in one request")
    return BODY.values(raw)


def decode_mirror(mirror: bytes) -> dict[str, Value]:
    """Decode the float32 mirror to values by name, with `seq`.

    Raises:
        ValueError: wrong size or torn.
    """
    if len(mirror) != _MIRROR.size:
        raise ValueError(f"the mirror has {MIRROR_WORDS} registers, got {len(mirror) / 2:g}")
    seq, *values, seq_end = _MIRROR.unpack(mirror)
    if seq != seq_end:
        raise ValueError(f"torn mirror: seq is {seq} at its begin and {seq_end} at its end; read it in one request")
    floats = {p.name: None if v != v else v for p, v in zip(MIRROR, values, strict=True)}
    return {"seq": seq, **floats}


def decode_datagram(data: bytes) -> dict[str, Value]:
    """Decode a pose datagram to values by name; bytes that a later minor revision appended are skipped.

    Values that an earlier program did not send are absent.

    Raises:
        ValueError: not a pose datagram, another version, damaged.
    """
    if len(data) < SMALLEST_DATAGRAM or data[:4] != DATAGRAM_MAGIC:
        raise ValueError("not a lumiloop pose datagram")
    _, version, length = _DATAGRAM_HEAD.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"datagram version {version}, this reader needs version {VERSION}")
    if length != len(data):
        raise ValueError(f"the datagram states {length} bytes and has {len(data)}")
    (crc,) = _CRC.unpack_from(data, length - _CRC.size)
    if crc != zlib.crc32(data[: length - _CRC.size]):
        raise ValueError("damaged datagram: CRC-32 differs")
    values = BODY.values(BODY.little.unpack_from(data, BODY_OFFSET))
    for offset, tail in _TAILS:
        if length >= offset + tail.little.size + _CRC.size:
            values |= tail.values(tail.little.unpack_from(data, offset))
    return values


def decode_bits(table: tuple[Bit, ...], word: Value) -> dict[str, bool]:
    """Named booleans of :data:`FLAGS` or :data:`DEVICES`."""
    bits = int(word or 0)
    return {name: bool(bits >> number & 1) for number, (name, _, _) in enumerate(table)}

"""Typed messages of the local stream: bytes in, records out, no I/O (docs/stream.md is the contract).

Fields that this version does not define are skipped. States and faults stay numbers, because a newer daemon may have
more of them.
"""

from __future__ import annotations

import zlib
from typing import Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from daemon.publish.stream.server import SCHEMA, framed

Triple = tuple[float, float, float]
LONGEST: Final = 8 << 20
"""Largest size of a message in bytes; a longer one is not from a lumiloop."""


class NotTheStream(Exception):
    """The data cannot be read by this version; the text states the defect and the remedy."""


class Hello(msgspec.Struct, frozen=True, kw_only=True):
    """First message: version of the stream, name of the robot, process of the daemon."""

    schema: int
    name: str
    pid: int
    topics: dict[str, str] = {}


class Refused(msgspec.Struct, frozen=True, kw_only=True):
    """Last message: the defect of our request."""

    text: str


class Trust(msgspec.Struct, frozen=True, kw_only=True):
    """Integrity of the pose; see `daemon.snapshot.Trust`."""

    horizontal_m: float | None = None
    yaw_rad: float | None = None
    limit_m: float | None = None
    alert: bool = False
    laser: bool = False
    light: bool = False
    wheels: bool = False
    gap: float | None = None
    places: int | None = None


class CycleTiming(msgspec.Struct, frozen=True, kw_only=True):
    """Cycle timing; see `daemon.snapshot.CycleTiming`. Spreads: median, 99th percentile, maximum, us."""

    rung: int = 0
    thinned: int = 0
    without_map: int = 0
    carried: int = 0
    stalls: int = 0
    stall_s: float | None = None
    stall_in: int | None = None
    cycle: tuple[int, int, int] | None = None
    late: tuple[int, int, int] | None = None
    stages: tuple[tuple[int, int, int] | None, ...] = ()


class Condition(msgspec.Struct, frozen=True, kw_only=True):
    """Health of the components; see `daemon.snapshot.Condition`."""

    uptime_s: int = 0
    faults: tuple[int, ...] = ()
    restarts: tuple[int, ...] = ()
    down: tuple[int, ...] = ()
    hanging: tuple[int, ...] = ()


class Pose(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``pose``: the snapshot of a cycle, SI units; see `daemon.snapshot.Snapshot` for each field."""

    seq: int
    t_mono: float
    t_sent: float
    t_utc: float
    state: int
    state_name: str
    reason: int
    meaning: str = ""
    remedy: str = ""
    pose: Triple | None = None
    odom: Triple | None = None
    predicted: Triple | None = None
    covariance: tuple[float, float, float, float, float, float] | None = None
    velocity: Triple | None = None
    known: tuple[bool, bool, bool] = (False, False, False)
    jumps: int = 0
    map_id: int = 0
    loop_counter: int = 0
    links: int | None = None
    light_id: int | None = None
    scan_rate: float | None = None
    missed: int = 0
    overruns: int = 0
    cycle_us: int | None = None
    lidar_ok: bool | None = None
    adc_ok: bool | None = None
    odometry_ok: bool | None = None
    fault: int = 0
    trust: Trust = Trust()
    pulse: CycleTiming | None = None
    condition: Condition | None = None

    def utc(self, t_mono: float) -> float:
        """Convert an instant of the daemon's clock to seconds since the Unix epoch."""
        return self.t_utc - self.t_sent + t_mono


class Link(msgspec.Struct, frozen=True, kw_only=True):
    """One lamp in view; see `daemon.snapshot.LightLink`."""

    code: int
    lamp_id: int | None = None
    use: int = 0
    strength: float = 0.0
    residual: float | None = None


class DimmedLamp(msgspec.Struct, frozen=True, kw_only=True):
    """One PWM-dimmed lamp in view; see `daemon.snapshot.DimmedLamp`."""

    hertz: float
    swing: float
    other_hertz: float | None = None


class Lights(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``lights``: the light solution; see `daemon.snapshot.LightPicture`. Empty: no photodiode."""

    fix: int = 0
    used: int = 0
    t_mono: float | None = None
    pose: Triple | None = None
    sigma: Triple | None = None
    floor: float | None = None
    clock_ppm: float | None = None
    blocks: int = 0
    blocks_lost: int = 0
    links: tuple[Link, ...] = ()
    dimmed: tuple[DimmedLamp, ...] = ()


class Scan(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``scan``: one scan of the lidar; bearings in rad from its front, counter-clockwise.

    ``range_min``, ``range_max`` (m): measuring range of the device; ``beam_dt``, ``period`` (s): of a beam, of a scan.
    """

    seq: int
    t_mono: float
    bearing_first: float
    bearing_step: float
    ranges: bytes
    range_min: float = 0.0
    range_max: float = 100.0
    beam_dt: float = 0.0
    period: float = 0.0

    def ranges_m(self) -> npt.NDArray[np.float32]:
        """Distance of each beam; infinite: no echo within range; not a number: no valid measurement."""
        return np.frombuffer(self.ranges[: len(self.ranges) // 4 * 4], "<f4")


class StateChange(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``state``: a change of the published state."""

    t_mono: float
    state: int
    state_name: str
    meaning: str = ""
    remedy: str = ""


class Loop(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``loop``: a loop closure; residual in m; poses of both keyframes in the map, None: not available."""

    t_mono: float
    counter: int
    keyframe_new: int | None = None
    keyframe_old: int | None = None
    reason: int | None = None
    residual: float | None = None
    at_new: Triple | None = None
    at_old: Triple | None = None


class Fault(msgspec.Struct, frozen=True, kw_only=True):
    """One present fault; ``cause``: the present fault that it follows from, 0: none."""

    fault: int
    meaning: str = ""
    remedy: str = ""
    cause: int = 0


class Faults(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``faults``: all present faults, gravest cause first, each before what follows; the first has no time."""

    present: tuple[Fault, ...]
    t_mono: float | None = None


class Statistics(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``statistics``: counters since the start; seconds unless stated otherwise."""

    t_mono: float
    uptime: float = 0.0
    memory_mb: float = 0.0
    cycles: int = 0
    overruns: int = 0
    cycle_us: int | None = None
    jobs_failed: int = 0
    scan_period: float | None = None
    scans: int = 0
    scans_missed: int = 0
    scans_invalid: int = 0
    scans_dropped: int = 0
    resyncs: int = 0
    reconnects: int = 0
    blocks: int | None = None
    blocks_lost: int | None = None
    odometry_jumps: int = 0


class Raw(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``raw``: traffic between daemon and a device; docs/stream.md lists the kinds."""

    device: str
    kind: str
    t_mono: float
    data: bytes = msgspec.field(name="bytes")
    rate: float | None = None
    bits: int | None = None


class MapTiles(msgspec.Struct, frozen=True, kw_only=True):
    """Topic ``map``: some tiles with their present content; ``more``: others follow at once."""

    map_id: int
    resolution: float
    side: int
    unit: float
    version: int
    more: bool
    tiles: tuple[tuple[int, int, bytes], ...]

    def cells(self, packed: bytes) -> npt.NDArray[np.int8]:
        """Decode one tile's log-odds in units of ``unit``: (side, side), rows from below.

        Raises:
            NotTheStream: the bytes are no tile.
        """
        size = self.side * self.side
        try:
            unpacked = zlib.decompressobj().decompress(packed, size + 1)
        except zlib.error as error:
            raise NotTheStream(f"a map tile cannot be inflated ({error}), so this is not a lumiloop stream") from None
        if len(unpacked) != size:
            raise NotTheStream(f"a map tile has {len(unpacked)} cells, not {size}, so this is not a lumiloop stream")
        return np.frombuffer(unpacked, np.int8).reshape(self.side, self.side)


Data = Pose | Lights | Scan | StateChange | Loop | Faults | Statistics | Raw | MapTiles
Frame = Hello | Refused | Data

TYPES: Final[dict[str, type[Data]]] = {
    "pose": Pose,
    "lights": Lights,
    "scan": Scan,
    "state": StateChange,
    "loop": Loop,
    "faults": Faults,
    "statistics": Statistics,
    "raw": Raw,
    "map": MapTiles,
}


class _Envelope(msgspec.Struct):
    topic: str
    data: msgspec.Raw = msgspec.Raw()


_envelope: Final = msgspec.msgpack.Decoder(_Envelope).decode
_hello: Final = msgspec.msgpack.Decoder(Hello).decode
_refused: Final = msgspec.msgpack.Decoder(Refused).decode
_data: Final = {topic: msgspec.msgpack.Decoder(kind).decode for topic, kind in TYPES.items()}


def decode(body: bytes) -> Frame | None:
    """Decode one message without its length; None for a topic that this version does not define.

    Raises:
        NotTheStream: no message, or one of another version.
    """
    try:
        envelope = _envelope(body)
        if envelope.topic == "hello":
            return _of_this_version(_hello(body))
        if envelope.topic == "error":
            return _refused(body)
        reader = _data.get(envelope.topic)
        return None if reader is None else reader(envelope.data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise NotTheStream(f"a message cannot be decoded ({error}), so this is not a lumiloop stream") from None


def read(topic: str, data: bytes) -> Data:
    """Decode the data of a topic.

    Raises:
        msgspec.DecodeError: they are not of that topic.
        KeyError: no such topic.
    """
    return _data[topic](data)


def request(topics: tuple[str, ...]) -> bytes:
    """Encode the message that subscribes to topics."""
    want: dict[str, Any] = {"want": list(topics)}
    return framed(want)


def _of_this_version(hello: Hello) -> Hello:
    if hello.schema != SCHEMA:
        told = f"the daemon has version {hello.schema} of the stream, and this program version {SCHEMA}"
        raise NotTheStream(f"{told}; install both from the same release")
    return hello

"""Converts stream messages to ROS 2 messages, for files, live servers and replayed recordings.

Coordinate frames after REP-103 and REP-105: ``map`` > ``odom`` > ``base_link`` > ``laser``. The pose in the map may
jump, the one in ``odom`` does not. Stamps of poses ascend strictly: a snapshot without a new measurement has no pose of
its own, and a correction of the same instant appears with the next measurement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from daemon.config.schema import Mount
from daemon.publish.stream.messages import (
    Fault,
    Faults,
    Frame,
    Lights,
    Loop,
    MapTiles,
    Pose,
    Raw,
    Scan,
    StateChange,
    Statistics,
    Triple,
)
from daemon.snapshot import GUESSED, State
from taps.ros import types as ros
from taps.stream.tiles import TileMap, trinary

MAP, ODOM, BASE, LASER = "map", "odom", "base_link", "laser"

STEP_S: Final = 0.5
"""A smaller correction of the computer's UTC does not change the stamps, s."""
REPEAT_S: Final = 5.0
"""Period at which static data are repeated, for late subscribers."""
SLOWEST_HZ: Final = 1.0
"""Lowest rate of diagnostics."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: type, description, whether a late subscriber receives the last message (transient local)."""

    kind: str
    what: str
    latched: bool = False


TOPICS: Final = {
    "/scan": Topic("sensor_msgs/msg/LaserScan", "each scan after REP-117; the stamp is the first beam's"),
    "/pose": Topic("geometry_msgs/msg/PoseWithCovarianceStamped", "the pose in the map, while the position is known"),
    "/odom": Topic("nav_msgs/msg/Odometry", "the pose in odom, continuous, with the velocity"),
    "/tf": Topic("tf2_msgs/msg/TFMessage", "map > odom > base_link"),
    "/tf_static": Topic("tf2_msgs/msg/TFMessage", "base_link > laser", latched=True),
    "/map": Topic("nav_msgs/msg/OccupancyGrid", "the map", latched=True),
    "/diagnostics": Topic("diagnostic_msgs/msg/DiagnosticArray", "state, faults with remedy, cycle, devices, lights"),
    "/lumiloop/state": Topic("lumiloop_msgs/msg/State", "each change of state", latched=True),
    "/lumiloop/lights": Topic("lumiloop_msgs/msg/Lights", "every lamp in view"),
    "/lumiloop/loop": Topic("lumiloop_msgs/msg/Loop", "each loop closure"),
    "/lumiloop/raw": Topic("lumiloop_msgs/msg/Raw", "bytes between daemon and devices"),
}

WELL: Final = (State.TRACKING, State.MAPPING)
POOR: Final = (State.DEGRADED, State.STARTING, State.RELOCATING)
OK, WARN, ERROR = 0, 1, 2


@dataclass(frozen=True, slots=True)
class RosMessage:
    """One encoded message: topic, time (ns since the Unix epoch), CDR bytes."""

    topic: str
    t_ns: int
    data: bytes


def map_to_odom(T: Triple, odom: Triple) -> Triple:
    """``T_map_odom`` of ``T_map_base`` and ``T_odom_base``."""
    turn = math.remainder(T[2] - odom[2], 2.0 * math.pi)
    c, s = math.cos(turn), math.sin(turn)
    return T[0] - c * odom[0] + s * odom[1], T[1] - s * odom[0] - c * odom[1], turn


class Translator:
    """Converts stream messages to ROS 2 messages.

    Args:
        mount: of the lidar. utc: maps ``t_mono`` to UTC (s); None: from the poses, with no message before the first.
        ordered: never step back with the computer's UTC, as for a file.
    """

    def __init__(self, mount: Mount, utc: Callable[[float], float] | None = None, ordered: bool = False) -> None:
        self._mount = mount
        self._utc = utc
        self._ordered = ordered
        self._offset: float | None = None
        self._place_ns = self._light_ns = -1
        self._reset()

    def restart(self) -> None:
        """Begin with another run of the daemon: drop its data, keep the clock and the order of stamps."""
        self._reset()

    def _reset(self) -> None:
        self._static = self._diagnosed = -math.inf
        self._state: tuple[int, int] | None = None
        self._faults: Faults | None = None
        self._statistics: Statistics | None = None
        self._lights: Lights | None = None
        self._tiles = TileMap()
        self._drawn = -math.inf
        self._now = 0.0

    def convert(self, frame: Frame) -> Iterator[RosMessage]:
        """The ROS 2 messages of one stream message."""
        match frame:
            case Pose():
                yield from self._pose(frame)
            case Scan():
                yield from self._scan(frame)
            case Lights():
                yield from self._lights_message(frame)
            case Loop():
                yield from self._loop(frame)
            case Raw():
                yield from self._raw(frame)
            case StateChange():
                self._diagnosed = -math.inf
            case Faults():
                self._faults, self._diagnosed = frame, -math.inf
            case Statistics():
                self._statistics = frame
            case MapTiles():
                self._tiles.update(frame)

    def grid(
        self, t_mono: float, origin: tuple[float, float], resolution: float, log_odds: Any
    ) -> Iterator[RosMessage]:
        """The map as a whole: (rows, columns) log-odds, rows from below, 0 unknown."""
        t = self._at(t_mono)
        if t is None or log_odds.size == 0:
            return
        cells = trinary(log_odds)
        info = ros.make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=ros.time(t),
            resolution=resolution,
            width=cells.shape[1],
            height=cells.shape[0],
            origin=ros.pose(*origin, 0.0),
        )
        yield self._out("/map", t, header=ros.header(t, MAP), info=info, data=cells.ravel())

    def _at(self, t_mono: float) -> float | None:
        """UTC (s) of ``t_mono``; None while unknown."""
        if self._utc is not None:
            return self._utc(t_mono)
        return None if self._offset is None else self._offset + t_mono

    def _out(self, topic: str, t: float, **fields: Any) -> RosMessage:
        kind = TOPICS[topic].kind
        return RosMessage(topic, ros.nanoseconds(t), ros.encode(kind, ros.make(kind, **fields)))

    def _pose(self, frame: Pose) -> Iterator[RosMessage]:
        self._set_clock(frame.utc(0.0))
        t = self._at(frame.t_mono)
        assert t is not None
        self._now = frame.t_mono
        yield from self._static_transforms(t)
        yield from self._map()
        if (frame.odom or frame.pose) is not None and ros.nanoseconds(t) > self._place_ns:
            self._place_ns = ros.nanoseconds(t)
            yield from self._places(t, frame)
        if (frame.state, frame.reason) != self._state:
            self._state, self._diagnosed = (frame.state, frame.reason), -math.inf
            yield self._changed(t, frame)
        if frame.t_mono - self._diagnosed >= 1.0 / SLOWEST_HZ:
            self._diagnosed = frame.t_mono
            yield self._out("/diagnostics", t, header=ros.header(t, ""), status=self._statuses(frame))

    def _set_clock(self, offset: float) -> None:
        """Follow the computer's UTC, which is ``offset`` + ``t_mono`` (s), where it has been stepped."""
        step = math.inf if self._offset is None else offset - self._offset
        if step > STEP_S or (step < -STEP_S and not self._ordered):
            self._offset = offset
            if step < 0.0:
                self._place_ns = self._light_ns = -1

    def _places(self, t: float, frame: Pose) -> Iterator[RosMessage]:
        """The poses of an instant in each frame."""
        if frame.odom is not None:
            yield self._odom(t, frame, frame.odom)
            moving = [ros.transform(t, ODOM, BASE, frame.odom)]
            if frame.pose is not None:
                moving.insert(0, ros.transform(t, MAP, ODOM, map_to_odom(frame.pose, frame.odom)))
            yield self._out("/tf", t, transforms=moving)
        if frame.pose is not None and frame.covariance is not None and frame.state not in GUESSED:
            place = ros.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=ros.pose(*frame.pose),
                covariance=ros.planar(frame.covariance),
            )
            yield self._out("/pose", t, header=ros.header(t, MAP), pose=place)

    def _static_transforms(self, t: float) -> Iterator[RosMessage]:
        if not 0.0 <= self._now - self._static < REPEAT_S:
            self._static = self._now
            T = (self._mount.x, self._mount.y, math.radians(self._mount.yaw))
            yield self._out("/tf_static", t, transforms=[ros.transform(t, BASE, LASER, T, self._mount.inverted)])

    def _odom(self, t: float, frame: Pose, odom: Triple) -> RosMessage:
        nothing = np.zeros(36)
        vx, vy, turning = frame.velocity or (0.0, 0.0, 0.0)
        twist = ros.make(
            "geometry_msgs/msg/Twist",
            linear=ros.make("geometry_msgs/msg/Vector3", x=vx, y=vy, z=0.0),
            angular=ros.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=turning),
        )
        return self._out(
            "/odom",
            t,
            header=ros.header(t, ODOM),
            child_frame_id=BASE,
            pose=ros.make("geometry_msgs/msg/PoseWithCovariance", pose=ros.pose(*odom), covariance=nothing),
            twist=ros.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=nothing),
        )

    def _changed(self, t: float, frame: Pose) -> RosMessage:
        level = frame.trust.horizontal_m
        return self._out(
            "/lumiloop/state",
            t,
            header=ros.header(t, MAP),
            state=frame.state & 0xFF,
            state_name=frame.state_name,
            meaning=frame.meaning,
            remedy=frame.remedy,
            protection_level_m=math.nan if level is None else level,
            alert=frame.trust.alert,
        )

    def _scan(self, frame: Scan) -> Iterator[RosMessage]:
        t = self._at(frame.t_mono)
        if t is None:
            return
        ranges = frame.ranges_m()
        yield self._out(
            "/scan",
            t,
            header=ros.header(t, LASER),
            angle_min=frame.bearing_first,
            angle_max=frame.bearing_first + frame.bearing_step * max(0, len(ranges) - 1),
            angle_increment=frame.bearing_step,
            time_increment=frame.beam_dt,
            scan_time=frame.period,
            range_min=frame.range_min,
            range_max=frame.range_max,
            ranges=ranges,
            intensities=np.empty(0, np.float32),
        )

    def _lights_message(self, frame: Lights) -> Iterator[RosMessage]:
        self._lights = frame
        t = None if frame.t_mono is None else self._at(frame.t_mono)
        if t is None or ros.nanoseconds(t) <= self._light_ns:
            return
        self._light_ns = ros.nanoseconds(t)
        x, y, yaw = frame.pose or (math.nan,) * 3
        links = [
            ros.make(
                "lumiloop_msgs/msg/Link",
                code=link.code & 0xFFFF,
                lamp_id=-1 if link.lamp_id is None else link.lamp_id,
                use=link.use & 0xFF,
                strength=link.strength,
                residual=math.nan if link.residual is None else link.residual,
            )
            for link in frame.links
        ]
        yield self._out(
            "/lumiloop/lights",
            t,
            header=ros.header(t, MAP),
            fix=frame.fix & 0xFF,
            used=frame.used & 0xFF,
            pose=ros.make("geometry_msgs/msg/Pose2D", x=x, y=y, theta=yaw),
            sigma=np.array(frame.sigma or (math.nan,) * 3),
            blocks=frame.blocks & 0xFFFFFFFF,
            blocks_lost=frame.blocks_lost & 0xFFFFFFFF,
            links=links,
        )

    def _loop(self, frame: Loop) -> Iterator[RosMessage]:
        t = self._at(frame.t_mono)
        if t is not None:
            yield self._out(
                "/lumiloop/loop",
                t,
                header=ros.header(t, MAP),
                counter=frame.counter & 0xFFFFFFFF,
                keyframe_new=-1 if frame.keyframe_new is None else frame.keyframe_new,
                keyframe_old=-1 if frame.keyframe_old is None else frame.keyframe_old,
                reason=(frame.reason or 0) & 0xFF,
                residual=math.nan if frame.residual is None else frame.residual,
            )

    def _raw(self, frame: Raw) -> Iterator[RosMessage]:
        t = self._at(frame.t_mono)
        if t is not None:
            yield self._out(
                "/lumiloop/raw",
                t,
                header=ros.header(t, LASER if frame.device == "lidar" else BASE),
                device=frame.device,
                kind=frame.kind,
                rate=frame.rate or 0.0,
                bits=frame.bits or 8,
                data=np.frombuffer(frame.data, np.uint8),
            )

    def _map(self) -> Iterator[RosMessage]:
        """The map, if it has changed, at most every :data:`REPEAT_S`."""
        if self._tiles.changed and not 0.0 <= self._now - self._drawn < REPEAT_S:
            self._drawn = self._now
            corner, whole = self._tiles.whole()
            yield from self.grid(self._now, corner, self._tiles.resolution, whole)

    def _statuses(self, frame: Pose) -> list[Any]:
        level = OK if frame.state in WELL else WARN if frame.state in POOR else ERROR
        text = f"{frame.state_name}: {frame.meaning}" if frame.meaning else frame.state_name
        found = [_status(level, "state", text, {"remedy": frame.remedy, "jumps": frame.jumps, "map": frame.map_id})]
        present = () if self._faults is None else self._faults.present
        found += [_of_fault(one) for one in present]
        pulse = frame.pulse
        if pulse is not None:
            late = {"rung": pulse.rung, "stalls": pulse.stalls, "overruns": frame.overruns, "cycle_us": frame.cycle_us}
            found.append(_status(WARN if pulse.rung else OK, "cycle", f"degradation level {pulse.rung}", late))
        if self._statistics is not None:
            figures = {name: getattr(self._statistics, name) for name in self._statistics.__struct_fields__}
            found.append(_status(OK, "counters", "since the start", figures))
        if self._lights is not None and self._lights.t_mono is not None:
            lights = {"in view": len(self._lights.links), "blocks": self._lights.blocks}
            found.append(_status(OK, "lights", f"{self._lights.used} used", lights))
        return found


def _of_fault(fault: Fault) -> Any:
    """A fault; one that follows from another is a warning, because its cause is the error."""
    values = {"remedy": fault.remedy} | ({"cause": fault.cause} if fault.cause else {})
    return _status(WARN if fault.cause else ERROR, f"fault {fault.fault}", fault.meaning, values)


def _status(level: int, name: str, message: str, values: dict[str, Any]) -> Any:
    pairs = [
        ros.make("diagnostic_msgs/msg/KeyValue", key=key, value="" if value is None else str(value))
        for key, value in values.items()
    ]
    return ros.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=f"lumiloop: {name}",
        message=message,
        hardware_id="",
        values=pairs,
    )

"""Converts stream messages to Prometheus metrics (text exposition format 0.0.4). No I/O."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import msgspec

from daemon.publish.stream.client import Lost
from daemon.publish.stream.messages import Faults, Frame, Hello, Lights, Pose, Statistics
from daemon.snapshot import LinkUse, Part, Stage, State

OLD_S: Final = 3.0
"""A pose older than this is not valid; a daemon without any message for this long counts as down."""
CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_QUANTILES: Final = ("0.5", "0.99", "1")
_COUNTERS: Final = {
    "cycles": "cycles of the estimate",
    "overruns": "cycles that exceeded their budget",
    "scans": "scans received",
    "scans_missed": "scans lost",
    "scans_invalid": "unusable scans",
    "scans_dropped": "scans replaced by a later one",
    "resyncs": "resynchronisations of the lidar's byte stream",
    "reconnects": "reconnections of the lidar",
    "blocks": "blocks of photodiode samples",
    "blocks_lost": "unused blocks of photodiode samples",
    "odometry_jumps": "jumps of wheel odometry",
    "jobs_failed": "failed background jobs",
}
Labels = dict[str, str]
Sample = tuple[Labels, float]


@dataclass(slots=True)
class Latest:
    """The latest message of each kind.

    Attributes:
        up: whether the daemon is connected. held: the last message with a pose of this run, also after a loss.
        t_pose: arrival of the latest pose message. t_message: arrival of the latest message.
    """

    up: bool = False
    hello: Hello | None = None
    pose: Pose | None = None
    held: Pose | None = None
    lights: Lights | None = None
    faults: Faults | None = None
    statistics: Statistics | None = None
    t_pose: float = -math.inf
    t_message: float = -math.inf

    def alive(self, now: float) -> bool:
        """Whether the daemon is connected and sends; a hanging one keeps its connection but is silent."""
        return self.up and now - self.t_message <= OLD_S

    def latest(self, now: float) -> Pose | None:
        """The latest pose message; without a pose once the daemon is gone, or has been silent for :data:`OLD_S`."""
        if self.pose is not None and now - self.t_pose <= OLD_S:
            return self.pose
        return None if self.held is None else msgspec.structs.replace(self.held, pose=None)

    def update(self, frame: Frame | Lost, now: float) -> None:
        """Store one message; ``now``: CLOCK_MONOTONIC, which is also the daemon's clock."""
        self.t_message = now
        match frame:
            case Lost():
                self.up, self.pose, self.lights, self.faults, self.statistics = False, None, None, None, None
            case Hello():  # another run: the last pose of the run before is not valid any more
                self.up, self.hello, self.held = True, frame, None
            case Pose():
                self.pose, self.t_pose = frame, now
                self.held = frame if frame.pose is not None else self.held
            case Lights():
                self.lights = frame
            case Faults():
                self.faults = frame
            case Statistics():
                self.statistics = frame
            case _:
                return


def exposition(latest: Latest, now: float) -> str:
    """Every series, with help and type."""
    return "".join(_family(*family) for family in _families(latest, now))


def _families(latest: Latest, now: float) -> Iterator[tuple[str, str, str, Iterable[Sample]]]:
    alive = latest.alive(now)
    yield "lumiloop_up", "gauge", "whether the daemon answers", [({}, float(alive))]
    if not alive:
        return
    if latest.hello is not None:
        yield "lumiloop_info", "gauge", "name of the robot", [({"robot": latest.hello.name}, 1.0)]
    if latest.pose is not None:
        yield from _of_pose(latest.pose, now)
    if latest.lights is not None and latest.lights.t_mono is not None:
        yield from _of_lights(latest.lights)
    if latest.faults is not None:
        present = [({"fault": str(one.fault), "meaning": one.meaning}, 1.0) for one in latest.faults.present]
        yield "lumiloop_fault", "gauge", "1 for each present fault", present
        yield "lumiloop_faults_present", "gauge", "number of present faults", [({}, float(len(present)))]
    if latest.statistics is not None:
        yield from _of_statistics(latest.statistics)


def _of_pose(pose: Pose, now: float) -> Iterator[tuple[str, str, str, Iterable[Sample]]]:
    states = [({"state": state.name}, float(state == pose.state)) for state in State]
    yield "lumiloop_state", "gauge", "1 for the present state", states
    yield "lumiloop_pose_age_seconds", "gauge", "age of the pose", [({}, now - pose.t_mono)]
    if pose.pose is not None:
        x, y, yaw = pose.pose
        place = [({"axis": "x"}, x), ({"axis": "y"}, y)]
        yield "lumiloop_pose_metres", "gauge", "the pose in the map", place
        yield "lumiloop_pose_yaw_radians", "gauge", "its heading", [({}, yaw)]
    if pose.covariance is not None:
        xx, _, yy, _, _, turn = (max(0.0, value) for value in pose.covariance)
        sigma = [({"axis": "x"}, math.sqrt(xx)), ({"axis": "y"}, math.sqrt(yy))]
        yield "lumiloop_pose_sigma_metres", "gauge", "its deviation", sigma
        yield "lumiloop_pose_sigma_yaw_radians", "gauge", "sigma of the heading", [({}, math.sqrt(turn))]
    known = [({"axis": axis}, float(observed)) for axis, observed in zip(("x", "y", "yaw"), pose.known, strict=True)]
    yield "lumiloop_axis_known", "gauge", "whether an axis is observed", known
    if pose.trust.horizontal_m is not None:
        level: list[Sample] = [({}, pose.trust.horizontal_m)]
        yield "lumiloop_protection_level_metres", "gauge", "protection level of the pose", level
    yield (
        "lumiloop_alert",
        "gauge",
        ("the protection level is above its limit, or there is none"),
        [({}, float(pose.trust.alert))],
    )
    yield "lumiloop_jumps_total", "counter", "jumps of the map pose", [({}, float(pose.jumps))]
    yield "lumiloop_loops_total", "counter", "loop closures", [({}, float(pose.loop_counter))]
    if pose.scan_rate is not None:
        yield "lumiloop_scan_rate_hertz", "gauge", "scans a second", [({}, pose.scan_rate)]
    if pose.pulse is not None:
        yield "lumiloop_rung", "gauge", "degradation level", [({}, float(pose.pulse.rung))]
        yield "lumiloop_stalls_total", "counter", "stalls of the cycle", [({}, float(pose.pulse.stalls))]
        yield "lumiloop_cycle_seconds", "summary", "computing time of recent cycles", _spread(pose.pulse.cycle)
        yield "lumiloop_late_seconds", "summary", "start delay of recent cycles", _spread(pose.pulse.late)
        stages = [
            ({"stage": stage.name.lower(), **labels}, value)
            for stage, spread in zip(Stage, pose.pulse.stages, strict=False)
            for labels, value in _spread(spread)
        ]
        yield "lumiloop_stage_seconds", "summary", "computing time of each stage", stages
    if pose.condition is not None:
        restarts = [
            ({"part": part.name.lower()}, float(n)) for part, n in zip(Part, pose.condition.restarts, strict=False)
        ]
        yield "lumiloop_part_restarts_total", "counter", "restarts of a part", restarts


def _of_lights(lights: Lights) -> Iterator[tuple[str, str, str, Iterable[Sample]]]:
    uses = [link.use for link in lights.links]
    counted = [({"use": use.name.lower()}, float(uses.count(use))) for use in LinkUse]
    yield "lumiloop_links", "gauge", "lamps in view, by link use", counted
    lamps = [
        ({"lamp": str(link.lamp_id), "code": str(link.code)}, link.residual)
        for link in lights.links
        if link.lamp_id is not None and link.residual is not None
    ]
    yield "lumiloop_lamp_residual", "gauge", "ln of received over expected RSS", lamps


def _of_statistics(statistics: Statistics) -> Iterator[tuple[str, str, str, Iterable[Sample]]]:
    for name, what in _COUNTERS.items():
        value = getattr(statistics, name)
        if value is not None:
            yield f"lumiloop_{name}_total", "counter", what, [({}, float(value))]
    yield "lumiloop_uptime_seconds", "gauge", "since the daemon's start", [({}, statistics.uptime)]
    yield "lumiloop_resident_memory_bytes", "gauge", "memory of the daemon", [({}, 1e6 * statistics.memory_mb)]


def _spread(spread: tuple[int, int, int] | None) -> list[Sample]:
    if spread is None:
        return []
    return [({"quantile": q}, 1e-6 * value) for q, value in zip(_QUANTILES, spread, strict=True)]


def _family(name: str, kind: str, what: str, samples: Iterable[Sample]) -> str:
    series: dict[str, float] = {}  # Prometheus refuses a page that has a series twice: the first one stays
    for labels, value in samples:
        series.setdefault(_labels(labels), value)
    lines = [f"{name}{labels} {_number(value)}\n" for labels, value in series.items()]
    return f"# HELP {name} {what}\n# TYPE {name} {kind}\n{''.join(lines)}" if lines else ""


def _labels(labels: Labels) -> str:
    pairs = ",".join(f'{key}="{_escaped(value)}"' for key, value in labels.items())
    return f"{{{pairs}}}" if pairs else ""


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else "NaN" if math.isnan(value) else "+Inf" if value > 0 else "-Inf"

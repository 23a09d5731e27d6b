"""How good the published pose was: the truth of the same instant, errors, states, and a verdict."""

import contextlib
import json
import math
import socket
import statistics
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from daemon.health.reasons import REASONS, Reason
from daemon.publish.modbus.client import Reading
from daemon.snapshot import State
from tools.demo.acts import Act
from tools.sim.robot.truth import Pose, at_time, in_map

ABSURD_M: Final = 0.5
"""Median position error beyond which the demo has failed."""
SLOW_SHARE: Final = 0.1
"""Of the readings, from which on a slow computer is named beside what went wrong."""
MISSED_SHARE: Final = 0.01
"""Of the scans, from which on the summary names them."""
GOOD: Final = (State.MAPPING, State.TRACKING)
READY: Final = (*GOOD, State.DEGRADED, State.RELOCATING)
"""States in which the daemon follows a sensor."""


@dataclass(slots=True)
class Track:
    """True poses of the last seconds, from the simulator's datagrams."""

    sock: socket.socket
    poses: deque[tuple[float, Pose]] = field(default_factory=lambda: deque(maxlen=400))
    driven_m: float = 0.0

    def collect(self, lifted: bool = False) -> None:
        """Take what has arrived; ``lifted``: the robot is in the air, and its motion is no drive."""
        with contextlib.suppress(BlockingIOError):
            while True:
                told = json.loads(self.sock.recv(512))
                pose = (told["x"], told["y"], told["yaw"])
                if self.poses and not lifted:
                    was = self.poses[-1][1]
                    self.driven_m += math.hypot(pose[0] - was[0], pose[1] - was[1])
                self.poses.append((told["t_mono"], pose))

    def at(self, t_mono: float) -> Pose | None:
        """The true pose at an instant, interpolated; None where it is not covered."""
        return at_time(self.poses, t_mono)


@dataclass(slots=True)
class Score:
    """What has been read and how good it was; errors in m and rad."""

    origin: tuple[Pose, Pose] | None = None  # the first pose and the truth of its instant
    surveyed: bool = False  # the map frame is the survey's, hence the truth's, from the first TRACKING on
    acts: list[Act] = field(default_factory=list)
    error_m: list[float] = field(default_factory=list)
    error_rad: list[float] = field(default_factory=list)
    tracking_m: float = 0.0  # the largest error while the state was TRACKING
    states: dict[str, int] = field(default_factory=dict)
    reads: int = 0
    slow: int = 0  # readings that say that the computer is too slow
    unanswered: int = 0
    cycle_s: list[float] = field(default_factory=list)
    trip_s: list[float] = field(default_factory=list)
    last: Reading = field(default_factory=dict)
    driven_m: float = 0.0
    watched_s: float = 0.0
    _told: tuple[int, int] | None = None

    def take(self, reading: Reading, truth: Pose | None) -> None:
        """One reading of the published block, and where the robot truly was then."""
        self.reads += 1
        self.last = reading
        state = State(int(reading["state"] or 0)).name
        self.states[state] = self.states.get(state, 0) + 1
        self.slow += reading.get("reason") == Reason.OVERLOADED
        if reading["cycle"] is not None:
            self.cycle_s.append(float(reading["cycle"]))
        pose = pose_of(reading)
        if pose is None or truth is None:
            return
        if self.origin is None and self.surveyed:
            if state != State.TRACKING.name:
                return
            self.origin = truth, truth
        if self.origin is None:
            self.origin = pose, truth
        want = in_map(truth, self.origin[1], self.origin[0])
        self.error_m.append(math.hypot(pose[0] - want[0], pose[1] - want[1]))
        self.error_rad.append(math.remainder(pose[2] - want[2], math.tau))
        if state == State.TRACKING.name:
            self.tracking_m = max(self.tracking_m, self.error_m[-1])

    def news(self) -> list[str]:
        """State and reason in words, once for each change."""
        said = int(self.last["state"] or 0), int(self.last["reason"] or 0)
        if said == self._told:
            return []
        self._told = said
        return [f"{State(said[0]).name}: {REASONS[Reason(said[1])][0]}"]


def pose_of(reading: Reading) -> Pose | None:
    """The published map pose, if there is one."""
    x, y, yaw = (reading[f"map_{axis}"] for axis in ("x", "y", "yaw"))
    return None if x is None or y is None or yaw is None else (float(x), float(y), float(yaw))


def summary(score: Score) -> dict[str, Any]:
    """The run in figures."""
    errors, angles = score.error_m, [abs(math.degrees(angle)) for angle in score.error_rad]
    known, seconds = bool(errors), score.watched_s
    return {
        "seconds": round(seconds, 2),
        "driven_m": round(score.driven_m, 2),
        "poses_compared": len(errors),
        "error_m": {"median": statistics.median(errors), "max": max(errors), "last": errors[-1]} if known else None,
        "error_while_tracking_m": score.tracking_m if known else None,
        "error_deg": {"median": statistics.median(angles), "max": max(angles), "last": angles[-1]} if known else None,
        "states": score.states,
        "too_slow": score.slow / max(score.reads, 1),
        "acts": [act.figures for act in score.acts],
        "scan_rate_hz": score.last.get("scan_rate"),
        "scans_missed": score.last.get("missed"),
        "cycle_ms": 1e3 * statistics.median(score.cycle_s) if score.cycle_s else None,
        "cycles_over_budget": score.last.get("overruns"),
        "modbus_reads_per_s": score.reads / max(seconds, 1e-9),
        "modbus_round_trip_ms": 1e3 * statistics.median(score.trip_s) if score.trip_s else None,
        "modbus_unanswered": score.unanswered,
    }


def told(figures: dict[str, Any]) -> list[str]:
    """The summary for a person: how far the robot drove, how wrong the pose was, and whether the computer kept up."""
    lines = [f"{figures['driven_m']:.1f} m driven in {figures['seconds']:.0f} s"]
    if figures["error_m"] is not None:
        off, turned = figures["error_m"], figures["error_deg"]
        lines.append(
            f"error of the pose: median {100 * off['median']:.1f} cm and {turned['median']:.2f} deg, "
            f"largest {100 * off['max']:.1f} cm and {turned['max']:.2f} deg, "
            f"largest while TRACKING {100 * figures['error_while_tracking_m']:.1f} cm"
        )
    sent = (figures["scan_rate_hz"] or 0.0) * figures["seconds"]
    missed, share = figures["scans_missed"] or 0, figures["too_slow"]
    if share > 0.0 or missed > MISSED_SHARE * sent:
        lines.append(
            f"the computer was too slow for {100.0 * share:.0f} % of the time, {missed} of about {sent:.0f} "
            "scans were missed; the figures are better on an idle computer"
        )
    return lines


def cause(figures: dict[str, Any]) -> str:
    """What a person can do about a run that went wrong, as a half sentence; empty where nothing is known of it."""
    share = figures["too_slow"]
    return (
        f"; the computer was too slow for {100.0 * share:.0f} % of it: end other programs" if share > SLOW_SHARE else ""
    )


def verdict(figures: dict[str, Any]) -> str:
    """What is wrong with the run; empty when nothing is."""
    if not any(figures["states"].get(state.name) for state in GOOD):
        return f"the pose was never MAPPING or TRACKING, but: {figures['states'] or 'nothing was read'}"
    if figures["error_m"] is None:
        return f"no pose could be compared with the truth, the states were {figures['states']}"
    if figures["error_m"]["median"] > ABSURD_M:
        return f"the median position error is {figures['error_m']['median']:.2f} m"
    return ""

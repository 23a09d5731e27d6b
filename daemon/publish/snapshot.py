"""The one picture of the world that every publisher shows: built once per cycle, never changed afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

UNKNOWN: Final = None
"""A field that nobody can know yet is None here and the documented "not known" value on the wire."""


class State(IntEnum):
    """The published state machine. Numbers are part of the contract: never renumber."""

    STARTING = 0  # warming up, nothing to say yet
    NO_LIDAR = 1  # no valid scan for three scan periods
    MAPPING = 2  # the pose follows the laser, but no witness has proved it yet
    TRACKING = 3  # two witnesses agree, or one has proved itself
    DEGRADED = 4  # the pose is held, at least one axis or witness is missing
    AMBIGUOUS = 5  # several places fit
    LOST = 6  # no pose worth using
    RELOCATING = 7  # looking for the place


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What is published after one cycle. SI units, `T_map_base` unless said otherwise; None: not known.

    Attributes:
        seq: counts snapshots. t_mono: instant the pose is true for. t_sent: when this was built. t_utc: `t_sent` as
            seconds since the Unix epoch.
        pose: T_map_base (x, y, yaw). odom: T_odom_base. predicted: T_map_base carried to `t_sent` by `velocity`.
        covariance: (xx, xy, yy, x-yaw, y-yaw, yaw-yaw), m and rad.
        velocity: (v_x, v_y, yaw rate) in the base frame.
        known: (x, y, yaw) whether the axis is observed.
        reason: index into the table of reasons (daemon/state.py), 0: none.
        jumps: how often T_map_odom jumped. map_id: identity of the map frame, 0: not known.
        loop_counter: accepted loop closures; loop_new, loop_old: keyframe IDs of the latest, None before the first.
        links: light links in view; None where no photodiode is configured. light_id: the strongest's ID.
        scan_rate: scans per second. missed: scans lost. overruns: cycles over budget. cycle_us: last cycle's duration.
        lidar_ok, adc_ok, odometry_ok: None where not configured.
        fault: number of the gravest present fault, 0: none.
    """

    seq: int
    t_mono: float
    t_sent: float
    t_utc: float
    state: State
    reason: int
    pose: tuple[float, float, float] | None = None
    odom: tuple[float, float, float] | None = None
    predicted: tuple[float, float, float] | None = None
    covariance: tuple[float, float, float, float, float, float] | None = None
    velocity: tuple[float, float, float] | None = None
    known: tuple[bool, bool, bool] = (False, False, False)
    jumps: int = 0
    map_id: int = 0
    loop_counter: int = 0
    loop_new: int | None = None
    loop_old: int | None = None
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

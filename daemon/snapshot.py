"""The snapshot: everything that is published of one cycle, immutable."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

UNKNOWN: Final = None
"""A field that nobody can know yet is None here and the documented "not known" value on the wire."""


class State(IntEnum):
    """The published state machine. Numbers are part of the contract: never renumber."""

    STARTING = 0  # warming up, nothing to say yet
    NO_LIDAR = 1  # no valid scan for three scan periods, or not steadily again
    MAPPING = 2  # the pose follows the laser, but no witness has proved it yet
    TRACKING = 3  # two witnesses agree, or one has proved itself
    DEGRADED = 4  # the pose is held, at least one axis or witness is missing
    AMBIGUOUS = 5  # several places fit
    LOST = 6  # no pose worth using
    RELOCATING = 7  # looking for the place


GUESSED: Final = (State.LOST, State.RELOCATING, State.AMBIGUOUS)
"""States in which the place is not known: a pose that is published meanwhile is a guess."""


class LightFix(IntEnum):
    """How far the position from lights has come (`estimator.result.Fix`). Numbers are part of the contract."""

    NONE = 0  # no lamps in view, or too few
    STARTING = 1  # position known, heading and gains still being found
    GOOD = 2  # position and heading known
    HELD = 3  # carried on by odometry alone, every link is paused
    AMBIGUOUS = 4  # several places fit
    LOST = 5  # what is received contradicts the position: starting anew


class LinkUse(IntEnum):
    """What a received lamp is used for (`estimator.result.LinkState`). Numbers are part of the contract."""

    OTHER = 0  # something that this version does not know
    ACCEPTED = 1  # used
    OCCLUDED = 2  # weaker than it can be here: something stands in its way
    REJECTED = 3  # stronger than it can be here: moved, exchanged, or its code in use twice
    RIM = 4  # at the edge of the field of view
    FAINT = 5  # not above the noise
    TWIN = 6  # two lamps of this code are in view
    UNSURVEYED = 7  # no lamp of this code is known
    MISSING = 8  # not received, though it must be here: dead, or covered
    PAUSED = 9  # clear, but not among those that are used (Link_n)


class LoopReason(IntEnum):
    """Why a loop closure was accepted (`estimator.result.LoopReason`). Numbers are part of the contract."""

    OTHER = 0  # something that this version does not know
    NEAR = 1  # laser: the scan fits the map where it was expected
    SEARCHED = 2  # laser: the scan fits the map in one place of all that were possible
    SUPPORTED = 3  # laser, twice: two keyframes from different places agree on it
    LIT = 4  # light and laser: the same lamps are seen from the same place, and the scan fits the map there
    PLACED = 5  # found in the whole map: the one place that fits all that was seen since the place was lost


class Stage(IntEnum):
    """Parts of a cycle, in the order in which they are published. Numbers are part of the contract: never renumber."""

    BRIDGE = 0  # answers of the worker; devices' readings become SI records
    LIGHTS = 1  # decoding a block of samples, the filter of lights, odometry up to then
    SEARCH = 2  # for lamps that are not followed yet
    MATCH = 3  # the scan against the map, and what comes of it
    MAP = 4  # keyframes and loops
    STEP = 5  # what else belongs to the estimate
    JUDGE = 6  # state, bound, snapshot
    PUBLISH = 7  # registers, datagrams, stream, recording
    OUTSIDE = 8  # no cycle was running


Spread = tuple[int, int, int]
"""Median, 99 of 100, and largest, microseconds."""


@dataclass(frozen=True, slots=True)
class CycleTiming:
    """How the cycle itself is doing; None: not known.

    Attributes:
        rung: what is left out for lack of time, or by a pause (`estimator.measurements.DegradationLevel`).
        thinned, without_map, carried: cycles on rung 1, 2, 3 since the start.
        stalls: how often no cycle began in time; stall_s, stall_in: how long the latest lasted, and where.
        cycle, late: computing time of a cycle, and how late it began. stages: of each of :class:`Stage`, in order.
    """

    rung: int = 0
    thinned: int = 0
    without_map: int = 0
    carried: int = 0
    stalls: int = 0
    stall_s: float | None = None
    stall_in: Stage | None = None
    cycle: Spread | None = None
    late: Spread | None = None
    stages: tuple[Spread | None, ...] = ()


class Part(IntEnum):
    """Parts of the daemon that are restarted when they fail. Numbers are part of the contract: never renumber."""

    LIDAR = 0
    PHOTODIODE = 1
    ODOMETRY = 2
    IMU = 3
    MODBUS = 4
    RTU = 5
    POSE = 6
    SUBSCRIPTIONS = 7
    STREAM = 8
    MAP = 9
    OTHER = 10


class Thread(IntEnum):
    """Threads of the daemon that are watched. Numbers are part of the contract: never renumber."""

    SOLVER = 0
    SEARCH = 1
    MAP = 2
    POSE = 3
    RECORDING = 4
    I2C = 5


@dataclass(frozen=True, slots=True)
class Condition:
    """How the daemon's parts are.

    Attributes:
        uptime_s: seconds since the start. faults: numbers of all that are present, gravest first.
        restarts: of each of :class:`Part`, in order. down: those that are down. hanging: threads that do not come back.
    """

    uptime_s: int = 0
    faults: tuple[int, ...] = ()
    restarts: tuple[int, ...] = (0,) * len(Part)
    down: frozenset[Part] = frozenset()
    hanging: frozenset[Thread] = frozenset()


NO_CONDITION: Final = Condition()


LISTED_LINKS: Final = 16
"""Links that a snapshot lists, the strongest."""


@dataclass(frozen=True, slots=True)
class LightLink:
    """One lamp in view.

    Attributes:
        code: as received. lamp_id: None where it is not clear which lamp. use: what it is used for.
        strength: amplitude of the modulated photocurrent, A. residual: ln(received / expected).
    """

    code: int
    lamp_id: int | None
    use: LinkUse
    strength: float
    residual: float | None = None


@dataclass(frozen=True, slots=True)
class LightPicture:
    """What lights alone say, without the laser; None: not known.

    Attributes:
        fix: how far the position has come. used: links it rests on.
        t_mono: end of the latest usable block of samples. pose: T_map_base. sigma: of x, y, yaw (m, rad).
        floor: diffuse light, part of a lamp's own. clock_ppm: error of the sample clock.
        blocks, blocks_lost: received since the start, and those of them of no use.
        links: strongest first.
    """

    fix: LightFix = LightFix.NONE
    used: int = 0
    t_mono: float | None = None
    pose: tuple[float, float, float] | None = None
    sigma: tuple[float, float, float] | None = None
    floor: float | None = None
    clock_ppm: float | None = None
    blocks: int = 0
    blocks_lost: int = 0
    links: tuple[LightLink, ...] = ()


@dataclass(frozen=True, slots=True)
class Trust:
    """How far the pose can be trusted; None: not known.

    Attributes:
        horizontal_m, yaw_rad: protection level, a bound on the error of the map pose (docs/integrity.md); None: none.
        limit_m: alert limit that is set; None: none. alert: the bound is above it, or there is none.
        laser, light, wheels: what the bound rests on.
        gap: squared Mahalanobis distance between the pose and the one from light alone.
        places: how many places fit while the place is looked for; None: it is known.
    """

    horizontal_m: float | None = None
    yaw_rad: float | None = None
    limit_m: float | None = None
    alert: bool = False
    laser: bool = False
    light: bool = False
    wheels: bool = False
    gap: float | None = None
    places: int | None = None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What is published after one cycle. SI units, `T_map_base` unless said otherwise; None: not known.

    Attributes:
        seq: counts snapshots. t_mono: instant the pose is true for. t_sent: when this was built. t_utc: `t_sent` as
            seconds since the Unix epoch.
        pose: T_map_base (x, y, yaw). odom: T_odom_base. predicted: T_map_base carried to `t_sent` by `velocity`.
        covariance: (xx, xy, yy, x-yaw, y-yaw, yaw-yaw), m and rad; None while the place in the map is looked for.
        velocity: (v_x, v_y, yaw rate) in the base frame.
        known: (x, y, yaw) whether the axis is observed.
        reason: index into the table of reasons (daemon/health/reasons.py), 0: none.
        jumps: how often T_map_odom jumped. map_id: identity of the map frame, 0: not known.
        loop_counter: accepted loop closures; loop_new, loop_old: keyframe IDs of the latest, None before the first;
            loop_reason (:class:`LoopReason`), loop_residual (m): likewise. loop_latched: a loop was closed that
            nobody has said to have seen.
        links: lights in view; None where no photodiode is configured. light_id: the strongest's lamp ID.
        light: what lights alone say; None where no photodiode is configured.
        scan_rate: scans per second. missed: scans lost. overruns: cycles over budget. cycle_us: last cycle's duration.
        lidar_ok, adc_ok, odometry_ok: None where not configured.
        fault: number of the gravest present fault, 0: none. trust: how far the pose can be trusted.
        pulse: how the cycle itself is doing. condition: how the daemon's parts are doing.
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
    light: LightPicture | None = None
    scan_rate: float | None = None
    missed: int = 0
    overruns: int = 0
    cycle_us: int | None = None
    lidar_ok: bool | None = None
    adc_ok: bool | None = None
    odometry_ok: bool | None = None
    fault: int = 0
    trust: Trust = Trust()
    loop_reason: int | None = None
    loop_residual: float | None = None
    loop_latched: bool = False
    pulse: CycleTiming | None = None
    condition: Condition | None = None

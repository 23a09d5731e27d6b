"""The snapshot and its types: everything that is published of one cycle, immutable."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

UNKNOWN: Final = None
"""Value of a field that is not available; the wire carries the documented "not known" value."""


class State(IntEnum):
    """Published state of localisation. Numbers are part of the contract: never renumber."""

    STARTING = 0  # warming up, no pose yet
    NO_LIDAR = 1  # no valid scan for three scan periods, or not steadily again
    MAPPING = 2  # the pose follows the lidar, but no other solution has confirmed it yet
    TRACKING = 3  # two independent solutions agree, or one is confirmed by itself
    DEGRADED = 4  # the pose is confirmed, but at least one axis or input is missing
    AMBIGUOUS = 5  # several hypotheses fit
    LOST = 6  # no usable pose
    RELOCATING = 7  # searches for the pose in the map


GUESSED: Final = (State.LOST, State.RELOCATING, State.AMBIGUOUS)
"""States without a confirmed position: a pose published in them is unconfirmed."""


class LightFix(IntEnum):
    """State of the light solution (`estimator.result.Fix`). Numbers are part of the contract."""

    NONE = 0  # no lamps in view, or too few
    STARTING = 1  # position available; heading and gains have not converged
    GOOD = 2  # position and heading available
    HELD = 3  # predicted by odometry alone, every link is paused
    AMBIGUOUS = 4  # several hypotheses fit
    LOST = 5  # the received lamps contradict the position: the light filter restarts


class LinkUse(IntEnum):
    """Use of a received lamp (`estimator.result.LinkState`). Numbers are part of the contract."""

    OTHER = 0  # a value that this version does not define
    ACCEPTED = 1  # used
    OCCLUDED = 2  # weaker than possible at this pose: something obstructs it
    REJECTED = 3  # stronger than possible at this pose: moved, exchanged, or its code in use twice
    RIM = 4  # at the edge of the field of view
    FAINT = 5  # not above the noise
    TWIN = 6  # two lamps of this code are in view
    UNSURVEYED = 7  # the survey has no lamp of this code
    MISSING = 8  # not received, though expected here: failed or covered
    PAUSED = 9  # clear, but not among those that are used (Link_n)


class LoopReason(IntEnum):
    """Reason for accepting a loop closure (`estimator.result.LoopReason`). Numbers are part of the contract."""

    OTHER = 0  # a value that this version does not define
    NEAR = 1  # lidar: the scan fits the map at the predicted pose
    SEARCHED = 2  # lidar: the scan fits the map at only one of all possible poses
    SUPPORTED = 3  # lidar, twice: two keyframes at different positions agree
    LIT = 4  # light and lidar: the same lamps are received at the same position, and the scan fits the map there
    PLACED = 5  # found in the whole map: the one pose that fits all measurements since the pose was lost


class Stage(IntEnum):
    """Stages of a cycle, in the order in which they are published. Numbers are part of the contract: never renumber."""

    BRIDGE = 0  # job results of the worker; conversion of device readings to SI records
    LIGHTS = 1  # decoding of a block of samples, light filter, odometry up to that time
    SEARCH = 2  # acquisition of lamps that are not tracked yet
    MATCH = 3  # scan match and pose update
    MAP = 4  # keyframes and loops
    STEP = 5  # the rest of the estimator step
    JUDGE = 6  # state, protection level, snapshot
    PUBLISH = 7  # registers, datagrams, stream, recording
    OUTSIDE = 8  # time between cycles


Spread = tuple[int, int, int]
"""Median, 99th percentile and maximum, us."""


@dataclass(frozen=True, slots=True)
class CycleTiming:
    """Cycle timing; None: not available.

    Attributes:
        rung: degradation level, by lack of time or by a pause (`estimator.measurements.DegradationLevel`).
        thinned, without_map, carried: cycles on degradation level 1, 2, 3 since the start.
        stalls: number of times that no cycle started in time; stall_s, stall_in: duration and stage of the latest.
        cycle, late: computing time and start delay of a cycle. stages: time of each :class:`Stage`, in order.
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
    """Components of the daemon that are restarted when they fail. Numbers are part of the contract: never renumber."""

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
    """Threads of the daemon with hang detection. Numbers are part of the contract: never renumber."""

    SOLVER = 0
    SEARCH = 1
    MAP = 2
    POSE = 3
    RECORDING = 4
    I2C = 5


@dataclass(frozen=True, slots=True)
class Condition:
    """Health of the daemon's components.

    Attributes:
        uptime_s: seconds since the start. faults: numbers of all present faults, the gravest cause
            first, each followed by its consequences.
        restarts: of each :class:`Part`, in order. down: components that are down. hanging: threads that do not respond.
    """

    uptime_s: int = 0
    faults: tuple[int, ...] = ()
    restarts: tuple[int, ...] = (0,) * len(Part)
    down: frozenset[Part] = frozenset()
    hanging: frozenset[Thread] = frozenset()


NO_CONDITION: Final = Condition()


LISTED_LINKS: Final = 16
"""Largest number of links in a snapshot; the strongest are listed."""

LISTED_DIMMED: Final = 3
"""Largest number of PWM-dimmed lamps in a snapshot: as many as the decoder follows."""


@dataclass(frozen=True, slots=True)
class LightLink:
    """One lamp in view.

    Attributes:
        code: as received. lamp_id: None where the code does not identify the lamp. use: see :class:`LinkUse`.
        strength: RSS, A. residual: ln(received / expected).
    """

    code: int
    lamp_id: int | None
    use: LinkUse
    strength: float
    residual: float | None = None


@dataclass(frozen=True, slots=True)
class DimmedLamp:
    """A PWM-dimmed lamp in view, which carries no code.

    Attributes:
        hertz: its frequency. swing: photocurrent between off and on, A.
        other_hertz: a frequency that the samples cannot tell from it; None: the frequency is certain.
    """

    hertz: float
    swing: float
    other_hertz: float | None = None

    def __str__(self) -> str:
        """As in "a PWM lamp of 1.0 kHz, 5 uA"."""
        other = "" if self.other_hertz is None else f" or {_frequency(self.other_hertz)}"
        return f"a PWM lamp of {_frequency(self.hertz)}{other}, {1e6 * self.swing:.2g} uA"


def _frequency(hertz: float) -> str:
    return f"{hertz / 1e3:.1f} kHz" if hertz >= 999.5 else f"{hertz:.0f} Hz"


@dataclass(frozen=True, slots=True)
class LightPicture:
    """The light solution, which does not use the lidar's position; None: not available.

    Attributes:
        fix: state of the solution. used: number of links in use.
        t_mono: end of the latest usable block of samples. pose: T_map_base. sigma: of x, y, yaw (m, rad).
        floor: diffuse floor, as a share of a lamp's own light. clock_ppm: error of the sample clock.
        blocks, blocks_lost: received since the start, and those of them that are unusable.
        links: strongest first. dimmed: PWM-dimmed lamps in view.
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
    dimmed: tuple[DimmedLamp, ...] = ()


@dataclass(frozen=True, slots=True)
class Trust:
    """Integrity of the pose; None: not available.

    Attributes:
        horizontal_m, yaw_rad: protection level of the map pose (docs/integrity.md); None: not available.
        limit_m: alert limit; None: not configured. alert: the protection level exceeds it, or is not available.
        laser, light, wheels: solutions behind the protection level.
        gap: squared normalised separation between the published pose and the light solution.
        places: number of hypotheses during relocalisation; None: no relocalisation.
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
    """Everything that is published after one cycle. SI units, `T_map_base` unless stated otherwise.

    None: not available.

    Attributes:
        seq: counts snapshots. t_mono: instant for which the pose is valid. t_sent: instant of building this snapshot.
            t_utc: `t_sent` as seconds since the Unix epoch.
        pose: T_map_base (x, y, yaw). odom: T_odom_base. predicted: T_map_base extrapolated to `t_sent` by `velocity`.
        covariance: (xx, xy, yy, x-yaw, y-yaw, yaw-yaw), m and rad; None during relocalisation.
        velocity: (v_x, v_y, yaw rate) in the base frame.
        known: (x, y, yaw) whether measurements determine the axis.
        reason: index into the table of reasons (daemon/health/reasons.py), 0: none.
        jumps: number of jumps of T_map_odom. map_id: identity of the map frame, 0: not available.
        loop_counter: accepted loop closures; loop_new, loop_old: keyframe IDs of the latest, None before the first;
            loop_reason (:class:`LoopReason`), loop_residual (m): likewise. loop_latched: a loop closure that no client
            has acknowledged.
        links: number of lamps in view; None where no photodiode is configured. light_id: lamp ID with the largest RSS.
        light: the light solution; None where no photodiode is configured.
        scan_rate: scans per second. missed: scans lost. overruns: cycles over budget. cycle_us: last cycle's duration.
        lidar_ok, adc_ok, odometry_ok: None where not configured.
        fault: number of the gravest present fault, 0: none. trust: integrity of the pose.
        pulse: cycle timing. condition: health of the components.
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

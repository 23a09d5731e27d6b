"""How cycles and their inputs are: the record that vitals, statistics and the stream's figures are taken from."""

from __future__ import annotations

from dataclasses import dataclass

from daemon.health.faults import Fault
from daemon.snapshot import CycleTiming, State
from hal.adc import AdcStatus
from hal.lidar import LidarStatus


@dataclass(frozen=True, slots=True)
class PhotodiodeFacts:
    """The photodiode and its lamps.

    Attributes:
        ok: usable blocks come. status: of the driver, live.
        blocks: received since the start. blocks_lost: those of no use, and those that were lost on their way.
        blocks_dropped: that no cycle took. unfit: damaged. off_rate: clocked beyond the decoder's reach.
        stalled: blocks in which the bus stood still. lamp_faults: of lamps and survey. links: in the latest result.
    """

    ok: bool
    status: AdcStatus
    blocks: int
    blocks_lost: int
    blocks_dropped: int
    unfit: int
    off_rate: bool
    stalled: int
    lamp_faults: frozenset[Fault]
    links: int


@dataclass(frozen=True, slots=True)
class CycleFacts:
    """How cycles and their inputs are at one instant. Counters count since the start.

    Attributes:
        t_mono: the instant. state: what is said about the pose.
        cycles, overruns: so far. cycle_us: duration of the latest. timing: quantiles and stalls.
        short: cycles that left out map work or the laser for lack of time. period: of scans, s.
        lidar: status of the driver, live. lidar_silent: scans came, and come no longer.
        scans_dropped: that no cycle took. scans_late: that arrived late. scans_misfit: they are at odds with the map.
        lag_s: estimated lag of the laser behind the wheels.
        odometry_ok: None where there is none. odometry_jumps: readings that no motion explains.
        odometry_disagrees: with the laser. readings, readings_missed, readings_old: of odometry that came, were lost,
            and came late. readings_seldom: they come more seldom than before.
        photodiode: None where there is none. jobs_failed: of the worker. alert: the bound on the position error is
            above its limit, and that has been logged. sink_failing: a publisher raises.
    """

    t_mono: float
    state: State
    cycles: int
    overruns: int
    cycle_us: int | None
    timing: CycleTiming
    short: int
    period: float
    lidar: LidarStatus
    lidar_silent: bool
    scans_dropped: int
    scans_late: int
    scans_misfit: bool
    lag_s: float
    odometry_ok: bool | None
    odometry_jumps: int
    odometry_disagrees: bool
    readings: int
    readings_missed: int
    readings_old: int
    readings_seldom: bool
    photodiode: PhotodiodeFacts | None
    jobs_failed: int
    alert: bool
    sink_failing: bool

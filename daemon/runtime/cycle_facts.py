"""Facts record of the cycle and its inputs: source of the vitals, the log statistics and the stream's figures."""

from __future__ import annotations

from dataclasses import dataclass

from daemon.health.faults import Fault
from daemon.snapshot import CycleTiming, State
from estimator import SlowErrors
from hal.adc import AdcStatus
from hal.lidar import LidarStatus


@dataclass(frozen=True, slots=True)
class PhotodiodeFacts:
    """Facts on the photodiode and its lamps.

    Attributes:
        ok: usable blocks arrive. status: of the driver, live.
        blocks: received since the start. blocks_lost: unusable ones, and those lost in transfer.
        blocks_dropped: not consumed by any cycle. unfit: damaged. off_rate: sample clock outside the decoder's range.
        stalled: blocks during which the bus stalled. lamp_faults: of lamps and survey. links: in the latest result.
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
    """Facts on cycles and their inputs at one instant. Counters count since the start.

    Attributes:
        t_mono: the instant, s. state: published state.
        cycles, overruns: so far. cycle_us: duration of the latest cycle, us. timing: quantiles and stalls.
        short: cycles that skipped map work or the lidar for lack of time. period: of scans, s.
        lidar: status of the driver, live. lidar_silent: scans have arrived before and do not arrive now.
        scans_dropped: not consumed by any cycle. scans_late: arrived late. scans_misfit: inconsistent with the map.
        scans_repeated: equal to an earlier one although the robot has moved.
        lag_s: estimated delay of the lidar behind the odometry, s.
        slow: lasting errors of odometry and lidar mount, None while none is large.
        gyro: factor of its readings over the true turn, None while it is about 1.
        odometry_ok: None where there is none. odometry_jumps: readings that no motion explains.
        odometry_disagrees: with the lidar. readings, readings_missed, readings_old: odometry readings that arrived,
        were
            lost, and arrived late. readings_seldom: they arrive less often than before.
        photodiode: None where there is none. jobs_failed: of the worker. alert: the protection level exceeds its limit,
            and that has been logged. sink_failing: a publisher raises.
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
    scans_repeated: int
    scans_misfit: bool
    lag_s: float
    slow: SlowErrors | None
    gyro: float | None
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

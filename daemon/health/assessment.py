"""Fault assessment: derives the present faults from counters and facts sampled once a second."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from daemon.health.causes import CONSEQUENCES, grouped
from daemon.health.faults import FAULTS, Fault
from estimator import SlowError, SlowErrors
from hal.adc import BusStuck, ChipMissing, Clipping, Dark, Dazzled, NoSignal, WrongChip
from hal.errors import DataInvalid, DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.lidar import Link

WINDOW_S: Final = 10.0
"""Rates are computed over the latest samples that are at least this far apart (s), or over all available."""
STALLED_PERIODS: Final = 2.0
"""Delay of the loop, in scan periods, from which the next delay could appear as a lidar without data."""
WAITED_SHARE: Final = 0.5
"""Share of a delay of the loop for which other programs must have had the processor to be its cause."""
CROWDED: Final = 0.1
"""Share of the time for which the loop waits for the processor, above which input is lost for that reason."""
FEW: Final = 2
"""Number of events that is no rate yet: shortly after the start, one event would be a large share of all."""
REPLAYED: Final = frozenset(
    (
        *(Fault.NO_LAMPS, Fault.SURVEY_CONTRADICTED, Fault.TWIN_LAMPS, Fault.LAMP_MOVED, Fault.LAMP_DEAD),
        *(Fault.LIDAR_MISFIT, Fault.LIDAR_TURNED, Fault.LIDAR_FROZEN, Fault.ODOMETRY_SILENT),
        *(Fault.ODOMETRY_DISAGREES, Fault.ODOMETRY_SCALE, Fault.GYRO_SCALE, Fault.PROTECTION_ALERT),
    )
)
"""Faults that follow from the data alone, so that a replay reproduces them. All others come from drivers or from the
computer, or are rates of data lost before recording."""


@dataclass(frozen=True, slots=True)
class Vitals:
    """Counters and facts at one instant (``t_mono``, s); counters run from the start of the process.

    Attributes:
        link, error: of the lidar driver. silent: no valid scan for three scan periods.
        scans, missed, invalid: the driver's counters. period: scan period in seconds.
        late: counter of scans that arrived late. repeated: of those equal to an earlier one while the robot moves.
        lag: time offset in s of the scan stamps behind the odometry, 0: not available. misfit: scans are inconsistent
            with the map.
        slow: lasting errors of odometry and lidar mount, None while none is large.
        gyro: factor of its readings over the true turn, None while it is about 1.
        odometry: whether it arrives, None where not configured. odometry_jumps: counter. disagree: with the lidar.
        readings, readings_missed, readings_old: counters of odometry readings that arrived, were lost, and arrived
            late.
        readings_seldom: they arrive at a lower rate than before.
        adc: whether blocks of samples arrive, None where there is no photodiode. adc_link, adc_error: of its driver.
        blocks, lost, unfit, stalled: counters of blocks. off_rate: clocked outside the decoder's range.
        lamps: faults of lamps and survey.
        cycles, overruns, jobs_failed: counters; short: of cycles without map work or lidar for lack of time.
        lateness: largest recent delay of the loop, seconds. waited: counter of seconds for which the loop was ready to
            run while other programs ran. no_descriptors: hardly any file descriptor is left.
        alert: the protection level exceeds the alert limit, and this has been reported.
        failed: names of components that are down at the moment.
    """

    t_mono: float
    link: Link = Link.CLOSED
    error: HalError | None = None
    silent: bool = False
    scans: int = 0
    missed: int = 0
    invalid: int = 0
    period: float = 0.1
    odometry: bool | None = None
    odometry_jumps: int = 0
    disagree: bool = False
    late: int = 0
    repeated: int = 0
    misfit: bool = False
    lag: float = 0.0
    slow: SlowErrors | None = None
    gyro: float | None = None
    readings: int = 0
    readings_missed: int = 0
    readings_old: int = 0
    readings_seldom: bool = False
    adc: bool | None = None
    adc_link: Link = Link.CLOSED
    adc_error: HalError | None = None
    blocks: int = 0
    lost: int = 0
    unfit: int = 0
    stalled: int = 0
    off_rate: bool = False
    lamps: frozenset[Fault] = frozenset()
    cycles: int = 0
    overruns: int = 0
    short: int = 0
    jobs_failed: int = 0
    lateness: float = 0.0
    waited: float = 0.0
    no_descriptors: bool = False
    alert: bool = False
    failed: frozenset[str] = frozenset()


def assess(now: Vitals, before: Vitals) -> tuple[Fault, ...]:
    """Present faults, the gravest cause first, each followed by its consequences (`daemon.health.causes`).

    ``before`` are vitals of about :data:`WINDOW_S` ago.
    """
    found = [*_lidar(now, before), *_odometry(now, before), *_computer(now, before), *_outputs(now)]
    if now.adc is not None:
        found += [*_photodiode(now, before), *now.lamps]
    if _slow(now, before, frozenset(found)):
        found.append(Fault.COMPUTER_SLOW)
    return grouped(found)


def describe(fault: Fault, now: Vitals | None = None, before: Vitals | None = None) -> str:
    """Log line of a fault: number, meaning, remedy, and the present detail.

    The detail is from the driver or the data in ``now``, or from what has changed since ``before``.
    """
    text, remedy = FAULTS[fault]
    own = now is not None and fault is Fault.LIDAR_REFUSED and now.error is not None and now.error.remedy
    if own:  # the table's remedy is for serial ports and networks; the driver has the one for its device
        remedy = ""
    line = f"fault {int(fault)}: {text} ({remedy})" if remedy else f"fault {int(fault)}: {text}"
    if fault is Fault.COMPUTER_SLOW and now is not None and before is not None:
        return f"{line}: {_load(now, before)}"
    return f"{line}: {words}" if now is not None and (words := _words(fault, now)) else line


def _load(now: Vitals, before: Vitals) -> str:
    """Returns what the computer's time went into, between two samples."""
    cycles, over = now.cycles - before.cycles, now.overruns - before.overruns
    span = now.t_mono - before.t_mono
    waited = f"other programs used the processor for {now.waited - before.waited:.1f} of {span:.0f} s"
    return f"{waited}, {over} of {cycles} cycles exceeded their budget"


def _words(fault: Fault, now: Vitals) -> str:
    """Detail of a fault: the driver's error, the components that are down, or the time offset; empty without one."""
    if now.error is not None and fault is _noun(now.error):
        return str(now.error)
    if now.adc_error is not None and fault is _adc_noun(now.adc_error):
        return str(now.adc_error)
    if fault in (Fault.PUBLISHER_FAILED, Fault.PART_FAILED):
        return ", ".join(sorted(_publishers(now) if fault is Fault.PUBLISHER_FAILED else _others(now)))
    if fault in (Fault.LIDAR_TURNED, Fault.ODOMETRY_SCALE) and now.slow is not None:
        return _of_mount(now.slow) if fault is Fault.LIDAR_TURNED else _of_wheels(now.slow)
    if fault is Fault.GYRO_SCALE and now.gyro is not None:
        return f"it measures {now.gyro:.2f} times the true turn"
    late = fault is (Fault.LIDAR_LATE if now.lag > 0.0 else Fault.ODOMETRY_GAPS)
    return f"scan stamps are late by {now.lag:+.2f} s against odometry" if now.lag and late else ""


def _of_mount(slow: SlowErrors) -> str:
    """Estimated deviation of the lidar mount."""
    (yaw, yaw_sigma), (y, y_sigma) = zip(
        slow.value[SlowError.MOUNT_YAW :], slow.sigma[SlowError.MOUNT_YAW :], strict=True
    )
    turned = f"{math.degrees(yaw):+.1f} deg (sigma {math.degrees(yaw_sigma):.1f})"
    return f"its yaw differs from `lidar.mount` by {turned}, its y by {100.0 * y:+.0f} cm (sigma {100.0 * y_sigma:.0f})"


def _of_wheels(slow: SlowErrors) -> str:
    """Estimated errors of odometry."""
    way, turn, drift, _, _ = slow.value
    scales = f"multiply its distances by {1.0 + way:.2f} and its turns by {1.0 + turn:.2f}"
    return f"{scales}; driving straight on, it misses {math.degrees(drift):+.1f} deg per metre"


def _lidar(now: Vitals, before: Vitals) -> Iterable[Fault]:
    down = now.link is not Link.STREAMING or now.silent
    if down and now.error is not None:
        yield _noun(now.error)
    elif now.silent:
        yield Fault.LIDAR_SILENT
    scans, missed, invalid = now.scans - before.scans, now.missed - before.missed, now.invalid - before.invalid
    if invalid > FEW + 0.05 * (scans + invalid):
        yield Fault.LIDAR_GARBLED
    if not down and missed > FEW + 0.02 * (scans + missed):
        yield Fault.LIDAR_GAPS
    if now.late - before.late > FEW + 0.05 * scans or (now.lag > 0.0 and not down):
        yield Fault.LIDAR_LATE
    if now.repeated - before.repeated > FEW:
        yield Fault.LIDAR_FROZEN
    if now.misfit:
        yield Fault.LIDAR_MISFIT
    if now.slow is not None and now.slow.mount:
        yield Fault.LIDAR_TURNED


def _noun(error: HalError) -> Fault:
    nouns = {DeviceMissing: Fault.LIDAR_MISSING, DeviceRefused: Fault.LIDAR_REFUSED, DeviceFault: Fault.LIDAR_BROKEN}
    return next((fault for noun, fault in nouns.items() if isinstance(error, noun)), Fault.LIDAR_SILENT)


ADC_NOUNS: Final[tuple[tuple[type[HalError], Fault], ...]] = (
    (ChipMissing, Fault.ADC_MISSING),
    (WrongChip, Fault.ADC_WRONG),
    (BusStuck, Fault.ADC_BUS_STUCK),
    (Dark, Fault.DARK),
    (Dazzled, Fault.DAZZLED),
    (NoSignal, Fault.NO_SIGNAL),
    (Clipping, Fault.CLIPPED),
    (DeviceMissing, Fault.ADC_BUS_MISSING),
    (DeviceRefused, Fault.ADC_BUS_REFUSED),
    (DataInvalid, Fault.ADC_GARBLED),
    (HalError, Fault.ADC_BUS_FAULTY),
)
"""Faults by type of a converter's driver error; the first match counts."""


def _adc_noun(error: HalError) -> Fault:
    return next(fault for noun, fault in ADC_NOUNS if isinstance(error, noun))


def _photodiode(now: Vitals, before: Vitals) -> Iterable[Fault]:
    if now.adc_error is not None:
        yield _adc_noun(now.adc_error)
    elif not (now.adc or before.adc) and now.adc_link is Link.STREAMING and 0 < before.cycles < now.cycles:
        yield Fault.ADC_SILENT
    blocks, lost = now.blocks - before.blocks, now.lost - before.lost
    unfit, stalled = now.unfit - before.unfit, now.stalled - before.stalled
    if unfit > FEW + 0.05 * blocks and not isinstance(now.adc_error, NoSignal | DataInvalid):
        yield Fault.ADC_GARBLED
    if now.off_rate:
        yield Fault.ADC_RATE
    if stalled > FEW + 0.1 * blocks:
        yield Fault.ADC_STALLS
    if now.adc and lost > FEW + 0.02 * (blocks + lost):
        yield Fault.ADC_GAPS


def _odometry(now: Vitals, before: Vitals) -> Iterable[Fault]:
    if now.odometry is False and now.cycles > 0:  # readings are counted from the first cycle on
        yield Fault.ODOMETRY_SILENT
    if now.odometry_jumps > before.odometry_jumps:
        yield Fault.ODOMETRY_JUMPS
    if now.disagree:
        yield Fault.ODOMETRY_DISAGREES
    readings, missed = now.readings - before.readings, now.readings_missed - before.readings_missed
    old = now.readings_old - before.readings_old
    bad = missed > FEW + 0.05 * (readings + missed) or old > FEW + 0.05 * readings or now.readings_seldom
    if now.odometry and (bad or now.lag < 0.0):
        yield Fault.ODOMETRY_GAPS
    if now.slow is not None and now.slow.wheels:
        yield Fault.ODOMETRY_SCALE
    if now.gyro is not None:
        yield Fault.GYRO_SCALE
    if now.alert:
        yield Fault.PROTECTION_ALERT


def _computer(now: Vitals, before: Vitals) -> Iterable[Fault]:
    if now.cycles and now.lateness > STALLED_PERIODS * now.period:  # delays are normal while kernels are compiled
        yield Fault.LOOP_STALLED
    if now.overruns - before.overruns > FEW + 0.05 * (now.cycles - before.cycles):
        yield Fault.OVERRUNS
    if now.short - before.short > FEW + 0.05 * (now.cycles - before.cycles):
        yield Fault.OVERLOADED
    if now.jobs_failed > before.jobs_failed:
        yield Fault.WORKER_FAILED
    if now.no_descriptors:
        yield Fault.NO_DESCRIPTORS


def _slow(now: Vitals, before: Vitals, found: frozenset[Fault]) -> bool:
    """Returns True if the computer is too slow: cycles take too long, or the loop has to wait for the processor."""
    if found & {Fault.OVERRUNS, Fault.OVERLOADED}:
        return True
    waited = now.waited - before.waited
    if Fault.LOOP_STALLED in found and waited >= WAITED_SHARE * now.lateness:
        return True
    crowded = waited >= CROWDED * (now.t_mono - before.t_mono) > 0.0
    return crowded and bool(found & CONSEQUENCES[Fault.COMPUTER_SLOW])


STORE: Final = {
    "map": Fault.MAP_NOT_SAVED,
    "stored map": Fault.MAP_REFUSED,
    "last pose": Fault.POSE_NOT_KEPT,
    "flight recorder": Fault.FLIGHT_RECORDER_FAILED,
    "thread": Fault.THREAD_HANGS,
}
"""Faults by name of a component or thread that stores data and is down."""
PUBLISHERS: Final = frozenset(
    ["modbus", "modbus serial", "pose", "pose subscriptions", "stream", "commands", "publisher"]
)
"""Names of components that publish, including those that the cycle calls."""


def _outputs(now: Vitals) -> Iterable[Fault]:
    if "recorder" in now.failed:
        yield Fault.RECORDER_FAILED
    for part, fault in STORE.items():
        if part in now.failed:
            yield fault
    if _publishers(now):
        yield Fault.PUBLISHER_FAILED
    if _others(now):
        yield Fault.PART_FAILED


def _publishers(now: Vitals) -> frozenset[str]:
    return now.failed & PUBLISHERS


def _others(now: Vitals) -> frozenset[str]:
    """Components that are down and have no fault of their own."""
    return now.failed - {"recorder", *STORE} - PUBLISHERS

"""Faults: what is wrong right now, each with a number, a text and a remedy, from counters sampled once a second."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from hal.adc import BusStuck, ChipMissing, Clipping, Dark, Dazzled, NoSignal, WrongChip
from hal.errors import DataInvalid, DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.lidar import Link


class Fault(IntEnum):
    """Present faults, the gravest first. Numbers are part of the contract: never renumber."""

    NONE = 0
    LIDAR_MISSING = 101
    LIDAR_REFUSED = 102
    LIDAR_BROKEN = 103
    LIDAR_SILENT = 104
    LIDAR_GARBLED = 105
    LIDAR_GAPS = 106
    LIDAR_LATE = 107
    LIDAR_MISFIT = 108
    ADC_BUS_MISSING = 151
    ADC_BUS_REFUSED = 152
    ADC_MISSING = 153
    ADC_WRONG = 154
    ADC_BUS_STUCK = 155
    ADC_BUS_FAULTY = 156
    ADC_SILENT = 157
    ADC_GARBLED = 158
    NO_SIGNAL = 159
    DARK = 160
    DAZZLED = 161
    CLIPPED = 162
    ADC_RATE = 163
    ADC_STALLS = 164
    ADC_GAPS = 165
    NO_LAMPS = 171
    SURVEY_CONTRADICTED = 172
    TWIN_LAMPS = 173
    LAMP_MOVED = 174
    LAMP_DEAD = 175
    ODOMETRY_SILENT = 201
    ODOMETRY_JUMPS = 202
    ODOMETRY_DISAGREES = 203
    ODOMETRY_GAPS = 204
    PROTECTION_ALERT = 251
    LOOP_STALLED = 301
    OVERRUNS = 302
    WORKER_FAILED = 303
    OVERLOADED = 304
    PART_FAILED = 305
    PUBLISHER_FAILED = 401
    RECORDER_FAILED = 402
    MAP_NOT_SAVED = 403
    MAP_REFUSED = 404
    POSE_NOT_KEPT = 405
    FLIGHT_RECORDER_FAILED = 406
    THREAD_HANGS = 407


FAULTS: Final[dict[Fault, tuple[str, str]]] = {
    Fault.NONE: ("no fault", ""),
    Fault.LIDAR_MISSING: ("the lidar is not there", "check power, cable and `lidar.device`; run `lumiloop probe`"),
    Fault.LIDAR_REFUSED: (
        "the lidar's port may not be used",
        "serial: join the group dialout; Ethernet: it serves one client; close what else uses it, or name another "
        "`lidar.device`",
    ),
    Fault.LIDAR_BROKEN: (
        "the lidar reports a fault of its own, or its port is open and nothing answers",
        "check its power and cable, power it off and on; if it comes back, replace it",
    ),
    Fault.LIDAR_SILENT: ("the lidar is connected and sends no valid scan", "power it off and on; check the cable"),
    Fault.LIDAR_GARBLED: ("more than 5 % of the lidar's frames are damaged", "check cable, shielding and USB hub"),
    Fault.LIDAR_GAPS: ("more than 2 % of the lidar's scans are missing", "check the computer's load and the line rate"),
    Fault.LIDAR_LATE: (
        "scans arrive more than two periods after they were measured, or are all stamped late against the wheels",
        "take load off the computer; look for a slow line, a USB hub or a network in between, and for a driver or "
        "gateway that stamps scans at arrival, not when they were measured",
    ),
    Fault.LIDAR_MISFIT: (
        "what the lidar measures does not fit the map where the robot must be, or anywhere after a start",
        "was the robot moved by hand, or does it drive where the map knows nothing yet? is the lidar covered, shifted "
        "on its mount, or does it measure wrongly?",
    ),
    Fault.ADC_BUS_MISSING: (
        "the photodiode's I2C bus is not there",
        "check `photodiode.bus`; is I2C enabled, is the adapter plugged in, does the bus server run?",
    ),
    Fault.ADC_BUS_REFUSED: (
        "the photodiode's I2C bus may not be used, or cannot do what is needed",
        "join the group i2c, unbind what else uses the converter, or use an I2C controller of the processor",
    ),
    Fault.ADC_MISSING: (
        "no converter answers on the photodiode's bus",
        "check its power and wiring, and `photodiode.converter`; run `lumiloop probe`",
    ),
    Fault.ADC_WRONG: ("another chip answers than `photodiode.converter` says", "run `lumiloop probe`, correct the key"),
    Fault.ADC_BUS_STUCK: (
        "the photodiode's bus hangs",
        "switch the converter's power off and on; look for SDA or SCL held low",
    ),
    Fault.ADC_BUS_FAULTY: (
        "reads of the photodiode's converter fail",
        "check wiring, pull-ups and cable length; read the log",
    ),
    Fault.ADC_SILENT: ("the photodiode's converter is connected and delivers nothing", "read the log"),
    Fault.ADC_GARBLED: (
        "the converter's words are damaged, or another kind of chip sends them",
        "check `photodiode.converter`, wiring and pull-ups",
    ),
    Fault.NO_SIGNAL: (
        "the photodiode gives no signal: dark, dazzled, or a dead converter",
        "look for a cover, for lamps off, for glaring light; a DC channel (`photodiode.level`) would tell which",
    ),
    Fault.DARK: ("no light reaches the photodiode", "look for a cover, a broken cable, lamps off"),
    Fault.DAZZLED: ("the photodiode's amplifier is saturated", "shade the photodiode or lower the gain"),
    Fault.CLIPPED: (
        "more than a fifth of the samples are at the rails",
        "too much modulated or flickering light: shade the photodiode or lower the gain",
    ),
    Fault.ADC_RATE: (
        "the converter is not clocked as the air interface needs it",
        "set SCL to 18 times the sample rate of `photodiode.profile`: 400 kHz for A",
    ),
    Fault.ADC_STALLS: (
        "the bus stands still inside many blocks of samples",
        "take load off the computer, or serve the bus from a process of its own: python -m hal.i2c_server",
    ),
    Fault.ADC_GAPS: ("more than 2 % of the blocks of samples are lost", "take load off the computer"),
    Fault.NO_LAMPS: (
        "there is light, and no lamp in it can be decoded",
        "are coded lamps on and in view? `photodiode.profile` must be that of the lamps",
    ),
    Fault.SURVEY_CONTRADICTED: (
        "what is received does not fit the survey",
        "is `lights.survey` that of this building? calibrate anew: lumiloop calibrate",
    ),
    Fault.TWIN_LAMPS: (
        "two lamps with one code are in view",
        "give one of them another code; read the links: lumiloop status",
    ),
    Fault.LAMP_MOVED: (
        "a lamp does not shine as surveyed",
        "moved or exchanged? the log names it; survey it anew",
    ),
    Fault.LAMP_DEAD: ("a lamp is not received where it must be", "the log names it: replace it or switch it on"),
    Fault.ODOMETRY_SILENT: ("configured odometry does not arrive", "check its sender and `odometry.port`"),
    Fault.ODOMETRY_JUMPS: ("odometry has jumped", "its sender was restarted, or two senders use `odometry.port`"),
    Fault.ODOMETRY_DISAGREES: (
        "odometry and laser disagree",
        "wheel slip; if it lasts, check odometry scale and lidar mount",
    ),
    Fault.ODOMETRY_GAPS: (
        "odometry readings are lost, late, stamped late against the scans, or come more seldom than before",
        "check the network and the sender's load; send ten readings per second or more, at once and stamped when they "
        "were measured: does something on their way stamp them at arrival?",
    ),
    Fault.PROTECTION_ALERT: (
        "the position error may be above the limit that is set, `integrity.alert_m`",
        "read state and reason; drive to where the pose is known, or set a limit that the place allows",
    ),
    Fault.LOOP_STALLED: ("the process did not get to run for two scan periods", "take load off the computer"),
    Fault.OVERRUNS: ("more than 5 % of the cycles exceed their budget", "take load off the computer"),
    Fault.OVERLOADED: (
        "map work, or the laser itself, is left out for lack of time",
        "take load off the computer, or raise `cycle.budget_ms`; the stages' times are published",
    ),
    Fault.WORKER_FAILED: ("background work has failed", "read the log; please report it"),
    Fault.PART_FAILED: (
        "a part of the daemon has failed and is started again and again",
        "read the log, which names it: is `odometry.port` taken by another program? a defect: please report it",
    ),
    Fault.PUBLISHER_FAILED: (
        "a publisher cannot send or listen",
        "read the log, which names it: is the port, or the stream's socket, taken by another program or daemon?",
    ),
    Fault.RECORDER_FAILED: ("the recording cannot be written", "free disk space, or name another directory"),
    Fault.MAP_NOT_SAVED: (
        "the map cannot be saved; what was saved before stays",
        "read the log; free disk space, end another daemon that keeps its maps there, or name another `map.folder`",
    ),
    Fault.FLIGHT_RECORDER_FAILED: (
        "the flight recorder cannot keep a state or a dump",
        "free disk space where it records, see the log for what is in the way",
    ),
    Fault.THREAD_HANGS: (
        "a thread of the daemon does not come back",
        "the log names it: look for a disk or a bus that hangs; a computation that hangs ends in a restart",
    ),
    Fault.MAP_REFUSED: (
        "a stored map cannot be used",
        "the log names the file, why, and what to do; without one a new map is begun",
    ),
    Fault.POSE_NOT_KEPT: (
        "the pose cannot be kept for the next start",
        "read the log; free disk space, or name another `map.folder` that may be written",
    ),
}
"""For every fault what it means and what a person can do."""

WINDOW_S: Final = 10.0
"""Rates are judged over the latest vitals that are at least this far apart, or all there are."""
STALLED_PERIODS: Final = 2.0
"""Scan periods by which the loop may be late: the next one would be taken for a silent lidar."""
FEW: Final = 2
"""Events that are no rate yet: shortly after the start a single one would be a large part of all."""


@dataclass(frozen=True, slots=True)
class Vitals:
    """Counters and facts of one moment (``t_mono``); counters run from the start of the process.

    Attributes:
        link, error: of the lidar driver. silent: no valid scan for three scan periods.
        scans, missed, invalid: the driver's counters. period: scan period in seconds.
        late: counter of scans that arrived late. lag: seconds by which they are stamped later than the wheels' turns,
            0: none is known. misfit: what they say is at odds with the map.
        odometry: whether it arrives, None where not configured. odometry_jumps: counter. disagree: with the laser.
        readings, readings_missed, readings_old: counters of odometry readings that came, were lost, and came late.
        readings_seldom: they come more seldom than before.
        adc: whether blocks of samples arrive, None where there is no photodiode. adc_link, adc_error: of its driver.
        blocks, lost, unfit, stalled: counters of blocks. off_rate: clocked beyond the decoder's reach.
        lamps: what is wrong with lamps and survey.
        cycles, overruns, jobs_failed: counters; short: of cycles without map work or laser for lack of time.
        lateness: worst lateness of the loop lately, seconds.
        alert: the bound on the position error is above the limit that is set, and this has been said.
        failed: names of parts that are down at the moment.
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
    misfit: bool = False
    lag: float = 0.0
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
    alert: bool = False
    failed: frozenset[str] = frozenset()


def assess(now: Vitals, before: Vitals) -> tuple[Fault, ...]:
    """Faults that are present, gravest first; ``before`` are vitals of about :data:`WINDOW_S` ago."""
    found = [*_lidar(now, before), *_odometry(now, before), *_computer(now, before), *_outputs(now)]
    if now.adc is not None:
        found += [*_photodiode(now, before), *now.lamps]
    return tuple(sorted(found))


def describe(fault: Fault, now: Vitals | None = None) -> str:
    """One line for a log: number, meaning, remedy, and what the device's driver or the data say of it ``now``."""
    text, remedy = FAULTS[fault]
    line = f"fault {int(fault)}: {text} ({remedy})" if remedy else f"fault {int(fault)}: {text}"
    return f"{line}: {words}" if now is not None and (words := _words(fault, now)) else line


def describe_over(fault: Fault, seconds: float) -> str:
    """One line for a log: a fault that is over, and how long it was there."""
    return f"over: fault {int(fault)}: {FAULTS[fault][0]}; it lasted {seconds:.0f} s"


def _words(fault: Fault, now: Vitals) -> str:
    """The driver's error that a fault stands for, the parts that are down, or the lag, if it stands for one."""
    if now.error is not None and fault is _noun(now.error):
        return str(now.error)
    if now.adc_error is not None and fault is _adc_noun(now.adc_error):
        return str(now.adc_error)
    if fault in (Fault.PUBLISHER_FAILED, Fault.PART_FAILED):
        return ", ".join(sorted(_publishers(now) if fault is Fault.PUBLISHER_FAILED else _others(now)))
    late = fault is (Fault.LIDAR_LATE if now.lag > 0.0 else Fault.ODOMETRY_GAPS)
    return f"scans are {now.lag:+.2f} s late against the wheels" if now.lag and late else ""


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
    if now.misfit:
        yield Fault.LIDAR_MISFIT


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
"""What a converter's driver says, by kind: the first that fits."""


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
    if now.odometry is False and now.cycles > 0:  # readings count from the first cycle on
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
    if now.alert:
        yield Fault.PROTECTION_ALERT


def _computer(now: Vitals, before: Vitals) -> Iterable[Fault]:
    if now.lateness > STALLED_PERIODS * now.period:
        yield Fault.LOOP_STALLED
    if now.overruns - before.overruns > FEW + 0.05 * (now.cycles - before.cycles):
        yield Fault.OVERRUNS
    if now.short - before.short > FEW + 0.05 * (now.cycles - before.cycles):
        yield Fault.OVERLOADED
    if now.jobs_failed > before.jobs_failed:
        yield Fault.WORKER_FAILED


STORE: Final = {
    "map": Fault.MAP_NOT_SAVED,
    "stored map": Fault.MAP_REFUSED,
    "last pose": Fault.POSE_NOT_KEPT,
    "flight recorder": Fault.FLIGHT_RECORDER_FAILED,
    "thread": Fault.THREAD_HANGS,
}
"""Parts that keep things, and threads, by name, and what it means that they are down."""
PUBLISHERS: Final = frozenset(["modbus", "modbus serial", "pose", "pose subscriptions", "stream", "publisher"])
"""Parts that publish, by name, and what the cycle says of those that it calls."""


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
    """Parts that are down and have no fault of their own."""
    return now.failed - {"recorder", *STORE} - PUBLISHERS

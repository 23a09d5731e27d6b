"""Faults: what is wrong right now, each with a number, a text and a remedy, from counters sampled once a second."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
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
    ODOMETRY_SILENT = 201
    ODOMETRY_JUMPS = 202
    ODOMETRY_DISAGREES = 203
    LOOP_STALLED = 301
    OVERRUNS = 302
    WORKER_FAILED = 303
    PUBLISHER_FAILED = 401
    RECORDER_FAILED = 402


FAULTS: Final[dict[Fault, tuple[str, str]]] = {
    Fault.NONE: ("no fault", ""),
    Fault.LIDAR_MISSING: ("the lidar is not there", "check power, cable and `lidar.device`; run `lumiloop probe`"),
    Fault.LIDAR_REFUSED: (
        "the lidar's port may not be used",
        "join the group dialout, close other programs that use it, or name another `lidar.device`",
    ),
    Fault.LIDAR_BROKEN: ("the lidar reports a fault of its own", "power it off and on; if it comes back, replace it"),
    Fault.LIDAR_SILENT: ("the lidar is connected and sends no valid scan", "power it off and on; check the cable"),
    Fault.LIDAR_GARBLED: ("more than 5 % of the lidar's frames are damaged", "check cable, shielding and USB hub"),
    Fault.LIDAR_GAPS: ("more than 2 % of the lidar's scans are missing", "check the computer's load and the line rate"),
    Fault.ODOMETRY_SILENT: ("configured odometry does not arrive", "check its sender and `odometry.port`"),
    Fault.ODOMETRY_JUMPS: ("odometry has jumped", "its sender was restarted, or two senders use `odometry.port`"),
    Fault.ODOMETRY_DISAGREES: (
        "odometry and laser disagree",
        "wheel slip; if it lasts, check odometry scale and lidar mount",
    ),
    Fault.LOOP_STALLED: ("the process did not get to run for two scan periods", "take load off the computer"),
    Fault.OVERRUNS: ("more than 5 % of the cycles exceed their budget", "take load off the computer"),
    Fault.WORKER_FAILED: ("background work has failed", "read the log; please report it"),
    Fault.PUBLISHER_FAILED: (
        "a publisher cannot send or listen",
        "read the log; is the port taken by another program?",
    ),
    Fault.RECORDER_FAILED: ("the recording cannot be written", "free disk space, or name another directory"),
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
        odometry: whether it arrives, None where not configured. odometry_jumps: counter. disagree: with the laser.
        cycles, overruns, jobs_failed: counters. lateness: worst lateness of the loop lately, seconds.
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
    cycles: int = 0
    overruns: int = 0
    jobs_failed: int = 0
    lateness: float = 0.0
    failed: frozenset[str] = frozenset()


def assess(now: Vitals, before: Vitals) -> tuple[Fault, ...]:
    """Faults that are present, gravest first; ``before`` are vitals of about :data:`WINDOW_S` ago."""
    found = [*_lidar(now, before), *_odometry(now, before), *_computer(now, before), *_outputs(now)]
    return tuple(sorted(found))


def describe(fault: Fault) -> str:
    """One line for a log: number, meaning, remedy."""
    text, remedy = FAULTS[fault]
    return f"fault {int(fault)}: {text} ({remedy})" if remedy else f"fault {int(fault)}: {text}"


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


def _noun(error: HalError) -> Fault:
    nouns = {DeviceMissing: Fault.LIDAR_MISSING, DeviceRefused: Fault.LIDAR_REFUSED, DeviceFault: Fault.LIDAR_BROKEN}
    return next((fault for noun, fault in nouns.items() if isinstance(error, noun)), Fault.LIDAR_SILENT)


def _odometry(now: Vitals, before: Vitals) -> Iterable[Fault]:
    if now.odometry is False:
        yield Fault.ODOMETRY_SILENT
    if now.odometry_jumps > before.odometry_jumps:
        yield Fault.ODOMETRY_JUMPS
    if now.disagree:
        yield Fault.ODOMETRY_DISAGREES


def _computer(now: Vitals, before: Vitals) -> Iterable[Fault]:
    if now.lateness > STALLED_PERIODS * now.period:
        yield Fault.LOOP_STALLED
    if now.overruns - before.overruns > FEW + 0.05 * (now.cycles - before.cycles):
        yield Fault.OVERRUNS
    if now.jobs_failed > before.jobs_failed:
        yield Fault.WORKER_FAILED


def _outputs(now: Vitals) -> Iterable[Fault]:
    if "recorder" in now.failed:
        yield Fault.RECORDER_FAILED
    if now.failed - {"recorder"}:
        yield Fault.PUBLISHER_FAILED

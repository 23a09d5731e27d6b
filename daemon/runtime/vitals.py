"""Samples what the heartbeat judges, and says how the process itself is doing."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

from daemon.health.assessment import Vitals
from daemon.runtime.cycle import Cycle


def vitals(cycle: Cycle, failed: set[str], lateness: float) -> Vitals:
    """The vitals of this moment; ``failed``: names of parts that are down, ``lateness``: of the loop, seconds."""
    parts, status, t_mono = cycle.parts, cycle.parts.status, cycle.parts.clock.now()
    lag = None if cycle.result is None else cycle.result.lag
    return Vitals(
        t_mono=t_mono,
        link=status.link,
        error=status.error,
        silent=cycle.lidar_ok(t_mono) is False and cycle.lidar_silence(t_mono) is not None,
        scans=status.scans,
        missed=status.missed + (cycle.inbox.dropped if cycle.cycles else 0),
        invalid=status.invalid,
        period=cycle.period.seconds,
        odometry=cycle.observer.odometry_ok(t_mono, cycle.inbox.wheels.latest),
        odometry_jumps=cycle.odometry.jumps,
        disagree=cycle.watch.disagree,
        late=cycle.watch.late,
        misfit=cycle.watch.misfit,
        lag=0.0 if lag is None else lag.lag_s,
        readings=cycle.watch.readings,
        readings_missed=cycle.watch.missed,
        readings_old=cycle.watch.old,
        readings_seldom=cycle.inbox.wheels.seldom(t_mono, cycle.period.seconds),
        **_photodiode(cycle, t_mono),
        cycles=cycle.cycles,
        overruns=cycle.overruns,
        short=cycle.timing.short,
        jobs_failed=parts.worker.failed,
        lateness=lateness,
        alert=cycle.alarm.said,
        failed=frozenset(failed) | (frozenset(["publisher"]) if cycle.failing else frozenset()),
    )


def _photodiode(cycle: Cycle, t_mono: float) -> dict[str, Any]:
    """The part of the vitals that is the photodiode's; nothing where there is none."""
    blocks, samples, lamps = cycle.parts.blocks, cycle.parts.samples, cycle.lamps
    if blocks is None or samples is None:
        return {}
    return {
        "adc": blocks.ok(t_mono),
        "adc_link": blocks.status.link,
        "adc_error": blocks.status.error,
        "blocks": cycle.blocks,
        "lost": blocks.status.dropped + (cycle.inbox.blocks_dropped if cycle.cycles else 0),
        "unfit": samples.unfit - samples.dead,
        "stalled": lamps.stalled,
        "off_rate": samples.off_rate,
        "lamps": lamps.faults if blocks.ok(t_mono) else frozenset(),
    }


def statistics(cycle: Cycle) -> str:
    """One line for the log."""
    status = cycle.parts.status
    return (
        f"state {cycle.verdict.state.name} cycles {cycle.cycles} overruns {cycle.overruns} scans {status.scans} "
        f"missed {status.missed} dropped {cycle.inbox.dropped} invalid {status.invalid} resyncs {status.resyncs} "
        f"reconnects {status.reconnects}{_light_statistics(cycle)} scan period {1e3 * cycle.period.seconds:.2f} ms "
        f"{_cycle_statistics(cycle)} memory {resident_mb():.0f} MB"
    )


def _cycle_statistics(cycle: Cycle) -> str:
    """How long cycles take and how late they begin, over the last minute, and what they leave out."""
    pulse = cycle.timing.latest
    said = [f"rung {pulse.rung} stalls {pulse.stalls}"]
    for name, spread in (("cycle", pulse.cycle), ("late", pulse.late)):
        if spread is not None:
            said.append(f"{name} p50 {spread[0]} p99 {spread[1]} max {spread[2]} us")
    return " ".join(said)


def _light_statistics(cycle: Cycle) -> str:
    blocks, result = cycle.parts.blocks, cycle.result
    if blocks is None:
        return ""
    lights = None if result is None else result.lights
    links = 0 if lights is None else len(lights.links)
    return f" blocks {cycle.blocks} lost {cycle.blocks_lost()} recoveries {blocks.status.recoveries} links {links}"


def resident_mb() -> float:
    """Resident memory of this process, MB; NaN where that cannot be read, as without a free file descriptor."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def process_age_s() -> float:
    """Seconds since the kernel started this process."""
    after_name = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    started = int(after_name[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started

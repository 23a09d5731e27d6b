"""Vitals for the heartbeat and the line of statistics, from the facts on the cycle and the process."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon.health.assessment import Vitals
from daemon.runtime.cycle_facts import CycleFacts
from daemon.snapshot import CycleTiming


@dataclass(frozen=True, slots=True)
class ProcessFacts:
    """Facts on the process.

    Attributes:
        lateness: delay of the loop, s. waited: time for which the loop was ready while other programs ran, s, since the
            start. no_descriptors: hardly any file descriptor is left.
    """

    lateness: float = 0.0
    waited: float = 0.0
    no_descriptors: bool = False


def vitals(facts: CycleFacts, failed: set[str], process: ProcessFacts) -> Vitals:
    """Returns the present vitals; ``failed``: names of failed components."""
    lidar = facts.lidar
    return Vitals(
        t_mono=facts.t_mono,
        link=lidar.link,
        error=lidar.error,
        silent=facts.lidar_silent,
        scans=lidar.scans,
        missed=lidar.missed + (facts.scans_dropped if facts.cycles else 0),
        invalid=lidar.invalid,
        period=facts.period,
        odometry=facts.odometry_ok,
        odometry_jumps=facts.odometry_jumps,
        disagree=facts.odometry_disagrees,
        late=facts.scans_late,
        repeated=facts.scans_repeated,
        misfit=facts.scans_misfit,
        lag=facts.lag_s,
        slow=facts.slow,
        gyro=facts.gyro,
        readings=facts.readings,
        readings_missed=facts.readings_missed,
        readings_old=facts.readings_old,
        readings_seldom=facts.readings_seldom,
        **_photodiode(facts),
        cycles=facts.cycles,
        overruns=facts.overruns,
        short=facts.short,
        jobs_failed=facts.jobs_failed,
        lateness=process.lateness,
        waited=process.waited,
        no_descriptors=process.no_descriptors,
        alert=facts.alert,
        failed=frozenset(failed) | (frozenset(["publisher"]) if facts.sink_failing else frozenset()),
    )


def _photodiode(facts: CycleFacts) -> dict[str, Any]:
    """Returns the vitals of the photodiode; empty where there is none."""
    photodiode = facts.photodiode
    if photodiode is None:
        return {}
    return {
        "adc": photodiode.ok,
        "adc_link": photodiode.status.link,
        "adc_error": photodiode.status.error,
        "blocks": photodiode.blocks,
        "lost": photodiode.status.dropped + (photodiode.blocks_dropped if facts.cycles else 0),
        "unfit": photodiode.unfit,
        "stalled": photodiode.stalled,
        "off_rate": photodiode.off_rate,
        "lamps": photodiode.lamp_faults if photodiode.ok else frozenset(),
    }


def statistics(facts: CycleFacts) -> str:
    """Returns one line for the log."""
    lidar = facts.lidar
    return (
        f"state {facts.state.name} cycles {facts.cycles} overruns {facts.overruns} scans {lidar.scans} "
        f"missed {lidar.missed} dropped {facts.scans_dropped} invalid {lidar.invalid} resyncs {lidar.resyncs} "
        f"reconnects {lidar.reconnects}{_light_statistics(facts)} scan period {1e3 * facts.period:.2f} ms "
        f"{_cycle_statistics(facts.timing)} memory {resident_mb():.0f} MB"
    )


def _cycle_statistics(timing: CycleTiming) -> str:
    """Returns cycle durations and start delays over the last minute, and the degradation level, as text."""
    parts = [f"rung {timing.rung} stalls {timing.stalls}"]
    for name, spread in (("cycle", timing.cycle), ("late", timing.late)):
        if spread is not None:
            parts.append(f"{name} p50 {spread[0]} p99 {spread[1]} max {spread[2]} us")
    return " ".join(parts)


def _light_statistics(facts: CycleFacts) -> str:
    light = facts.photodiode
    if light is None:
        return ""
    recoveries = light.status.recoveries
    return f" blocks {light.blocks} lost {light.blocks_lost} recoveries {recoveries} links {light.links}"


def resident_mb() -> float:
    """Resident memory of this process, MB; NaN where it cannot be read, as without a free file descriptor."""
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

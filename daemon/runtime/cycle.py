"""The localisation cycle: receives input, steps the estimator, updates the state, and publishes a snapshot.

A cycle runs for each scan; without scans, for each block of light samples; otherwise after 1.5 periods.

:class:`Cycle` is synchronous and has no timer, so that a replay can drive it as well. `daemon.runtime.scheduler` runs
it when it is due, in real or in virtual time. Each cycle gives a :class:`CycleRecord` of its input and decisions to an
observer. Together with the raw streams, that record suffices to repeat the run exactly.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Final

from daemon.devices.conversion import ImuBridge, OdometryBridge
from daemon.health.reasons import Reason as Cause
from daemon.health.state_log import StateLog
from daemon.integrity.evidence import SILENT_PERIODS, Evidence
from daemon.integrity.input_monitor import Watch
from daemon.integrity.lamp_monitor import LampWatch
from daemon.integrity.laser_hysteresis import LeftOut
from daemon.integrity.observer import EARLY, Observer
from daemon.integrity.position_alert import Alarm, bounded
from daemon.integrity.state_machine import judge
from daemon.integrity.state_memory import Memory
from daemon.maps.map_fallback import another, let_go
from daemon.runtime.budget import Spent
from daemon.runtime.cycle_facts import CycleFacts, PhotodiodeFacts
from daemon.runtime.cycle_parts import CycleRecord, Parts
from daemon.runtime.inbox import Taken
from daemon.runtime.scan_period import ScanPeriod
from daemon.runtime.snapshot_builder import Facts
from daemon.runtime.stage_times import TimingStatistics
from daemon.snapshot import Snapshot, Trust
from estimator import Answer, Command, DegradationLevel, Fix, LightEpoch, Limits, Order, Record, SampleBlock, StepResult
from hal.adc import RawSamples
from hal.lidar import Link

log = logging.getLogger(__name__)

OWN_SHARE: Final = 0.5
"""Share of the scan period that is the default budget."""


class Cycle:
    """Runs one localisation cycle after the other. Devices fill the ``inbox``; :meth:`run` does the rest.

    Attributes:
        cycles, overruns: so far. cycle_us: duration of the latest cycle, us. failing: numbers of the sinks that raise.
        verdict: published state, reason and known axes. result: of the latest step.
        blocks: of light samples received so far. lamps: monitor of lamps and survey.
        alarm: compares the protection level with the alert limit. trust: of the latest cycle.
        paused: by a command; map and lidar stay unused, light and odometry carry the pose.
        stage_timer: stages of the latest cycle. timing: published quantiles, degradation and stalls.
    """

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self.inbox = parts.inbox
        self.period = ScanPeriod()
        self.odometry = OdometryBridge()
        self.imu = ImuBridge()
        self.cycles = 0
        self.overruns = 0
        self.verdict = Memory()
        self.watch = Watch()
        self.result: StepResult | None = None
        begun = parts.t_begun or parts.clock.now()
        self.observer = Observer(begun, parts.odometry, parts.lidar, parts.samples is not None)
        self._builder = parts.snapshots
        self.cycle_us: int | None = None
        self.failing: set[int] = set()
        self.blocks = 0
        self.lamps = LampWatch()
        self.alarm = Alarm(parts.alert_m)
        self.trust = Trust(limit_m=parts.alert_m or None, alert=self.alarm.on)
        self.paused = False
        self._switched = ""
        self._held: list[Answer] = []
        self._left_out = LeftOut()
        self._state_log = StateLog(self.verdict.state, self.verdict.reason)
        self.stage_timer = parts.timer
        self.timing = TimingStatistics()

    def run(self) -> Snapshot:
        """Runs one cycle with all pending input and returns the published snapshot."""
        timer = self.stage_timer
        timer.begin()
        self.cycles += 1
        t_mono = self.parts.clock.now()
        taken = self.inbox.drain()
        self._obey(taken.commands)
        answers = self._answers(t_mono)
        orders = [command for command in taken.commands if command.order not in (Order.PAUSE, Order.RESUME)]
        records = (*answers, *orders, *self._bridge(taken))
        timer.lap("bridge")
        limits = self._step(records)
        self._watch_lamps(t_mono, records, limits)
        verdict = self._judge(t_mono, records, None if limits is None else self.result)
        snapshot = self._builder.build(self.result, verdict, self._facts(self.parts.clock.now()))
        timer.lap("judge")
        self._publish(snapshot)
        timer.lap("publish")
        self._account(t_mono, records, limits)
        if self.parts.tap is not None:
            record = CycleRecord(
                cycle=self.cycles,
                t_mono=t_mono,
                scan=None if taken.scan is None else taken.scan.seq,
                dropped=taken.dropped,
                odometry=taken.odometry_total,
                imu=taken.imu_total,
                commands=taken.commands,
                answers=tuple(answer.job_id for answer in answers),
                limits=limits,
                result=self.result,
                snapshot=snapshot,
                stage_us=timer.us,
                samples=taken.samples_total,
                switched=self._switched,
                waiting=self.parts.status.link is Link.WAITING,
            )
            self.parts.tap(record)
        return snapshot

    def _obey(self, commands: tuple[Command, ...]) -> None:
        for command in commands:
            if command.order in (Order.PAUSE, Order.RESUME):
                self.paused = command.order is Order.PAUSE

    def _answers(self, t_mono: float) -> tuple[Answer, ...]:
        """Returns the finished job results; a pause holds them back, because the map must not change."""
        self._held += self.parts.worker.collect(t_mono)
        if self.paused:
            return ()
        answers, self._held = tuple(replace(answer, t_begin=t_mono) for answer in self._held), []
        return answers

    def announce(self) -> None:
        """Publishes the present state without a cycle, while the estimator is still being loaded."""
        self._publish(self._builder.build(None, self.verdict, self._facts(self.parts.clock.now())))

    @property
    def map_id(self) -> int:
        """Identity of the map frame; it changes with every RESET and when a stored map is discarded."""
        return self._builder.map_id

    @map_id.setter
    def map_id(self, map_id: int) -> None:
        self._builder.map_id = map_id

    @property
    def budget_us(self) -> float:
        """Budget of a cycle, us."""
        return self.parts.budget_us or OWN_SHARE * self.period.seconds * 1e6

    def _bridge(self, taken: Taken) -> list[Record]:
        """Returns SI records of all input; the estimator itself sorts them by time."""
        records: list[Record] = []
        for reading in taken.odometry:
            jumps = self.odometry.jumps
            if (increment := self.odometry.increment(reading)) is not None:
                records.append(increment)
            if self.odometry.jumps > jumps:
                self.observer.motion_consistency.restart()
            self.observer.on_odometry(reading.t_rx)
            self.watch.on_odometry(reading)
        records += [turn for reading in taken.imu if (turn := self.imu.turn(reading)) is not None]
        records += self._light(taken.samples)
        if taken.scan is not None:
            self.period.learn(taken.scan)
            self.observer.on_scan(taken.scan.t_rx)
            self.watch.on_scan(taken.scan, self.period.seconds)
            records.append(self.parts.scans.scan(taken.scan))
        return records

    def _light(self, samples: tuple[RawSamples, ...]) -> list[Record]:
        """Returns the usable blocks of light samples."""
        bridge, watch = self.parts.samples, self.parts.blocks
        if bridge is None or watch is None:
            return []
        records: list[Record] = []
        self.blocks += len(samples)
        for raw in samples:
            if (block := bridge.block(raw)) is not None:
                watch.on_block(raw)
                self.period.learn_block(watch.seconds)
                records.append(block)
        return records

    def blocks_lost(self) -> int:
        """Number of unusable blocks of light samples: lost in transfer, damaged, or not consumed by any cycle."""
        bridge, watch = self.parts.samples, self.parts.blocks
        if bridge is None or watch is None:
            return 0
        return watch.status.dropped + bridge.unfit + self.inbox.blocks_dropped

    def lidar_silence(self, t_mono: float) -> float | None:
        """Scan periods since the last scan; None before the first."""
        return self.observer.silence(t_mono, self.period.seconds)

    def lidar_ok(self, t_mono: float) -> bool | None:
        """True while scans arrive; None where there is no lidar."""
        silence = self.lidar_silence(t_mono)
        return (silence is not None and silence < (1.0 - EARLY) * SILENT_PERIODS) if self.parts.lidar else None

    def _step(self, records: tuple[Record, ...]) -> Limits | None:
        """Steps the estimator under the caps of the budget and returns them; None if there were no records."""
        self._switched = ""
        if not records:
            return None
        if (switched := self.parts.switch.carry_out()) is not None:
            self._builder.map_id, self._switched = switched
        parts = self.parts
        light = any(isinstance(record, SampleBlock) for record in records)
        limits = parts.budget.limits(self.budget_us, light, self._carrier())
        if self.paused:
            limits = replace(limits, update_map=False, level=DegradationLevel.CARRIED)
        before, self.result = self.result, parts.step(records, limits)
        self.stage_timer.lap("step")
        self._tell_unused(limits)
        parts.worker.submit(self.result.jobs)
        reset = any(isinstance(record, Command) and record.order is Order.RESET for record in records)
        if let_go(before, self.result, self.map_id) or reset:
            self._builder.map_id = another(self.map_id, self.result.t_mono)
        return limits

    def _carrier(self) -> bool:
        """True if light or odometry can carry the pose for a while."""
        if self.observer.odometry_ok(self.parts.clock.now()):
            return True
        lights = None if self.result is None else self.result.lights
        return lights is not None and lights.fix is Fix.GOOD and self.result is not None and self.result.placed

    def _tell_unused(self, limits: Limits) -> None:
        """Sets in the observer whether the lidar is skipped, and why."""
        if self.paused or self.observer.unused is Cause.PAUSED:
            self._left_out.clear()
        overloaded = not self.paused and self._left_out.on_step(limits.level >= DegradationLevel.CARRIED)
        self.observer.unused = Cause.PAUSED if self.paused else Cause.OVERLOADED if overloaded else None
        self.timing.on_level(limits.level, self.paused)

    def _watch_lamps(self, t_mono: float, records: tuple[Record, ...], limits: Limits | None) -> None:
        if limits is not None and self.result is not None:
            fresh = any(isinstance(record, SampleBlock | LightEpoch) for record in records)
            self.lamps.on_step(t_mono, self.result.lights, fresh)

    def _judge(self, t_mono: float, records: tuple[Record, ...], fresh: StepResult | None) -> Memory:
        """Updates state and reason, and logs changes."""
        evidence = self.observer.evidence(t_mono, self.period.seconds, self.parts.status, records, fresh)
        self.verdict = judge(self.verdict, evidence)
        compared = bool(self.lidar_ok(t_mono)) and self.observer.unused is None
        self.watch.on_verdict(t_mono, self.verdict, compared)
        self.watch.on_match(None if fresh is None else fresh.match)
        self.trust = self._trust(t_mono, evidence)
        self._state_log.on_cycle(t_mono, self.verdict.state, self.verdict.reason)
        return self.verdict

    def _trust(self, t_mono: float, evidence: Evidence) -> Trust:
        """Returns the protection level, where the state permits one, and the alert against its limit."""
        result, limit_m = self.result, self.alarm.limit_m or None
        gap = None if result is None else result.gap
        protection = None if result is None else result.protection
        if protection is None or not bounded(self.verdict, evidence):
            return Trust(limit_m=limit_m, alert=self.alarm.update(t_mono, None), gap=gap, places=evidence.places)
        return Trust(
            horizontal_m=protection.horizontal_m,
            yaw_rad=protection.yaw_rad,
            limit_m=limit_m,
            alert=self.alarm.update(t_mono, protection.horizontal_m),
            laser=protection.laser,
            light=protection.light,
            wheels=protection.wheels,
            gap=gap,
            places=evidence.places,
        )

    def _facts(self, t_mono: float) -> Facts:
        parts, alive = self.parts, self.lidar_ok(t_mono)
        known = self.lidar_silence(t_mono) is not None
        rate = None if not known else 1.0 / self.period.seconds if alive else 0.0
        return Facts(
            t_mono=t_mono,
            t_utc=parts.clock.utc(),
            period=self.period.seconds,
            scan_rate=rate,
            missed=parts.status.missed + (self.inbox.dropped if self.cycles else 0),
            overruns=self.overruns,
            cycle_us=self.cycle_us,
            lidar_ok=alive,
            adc_ok=None if parts.blocks is None else parts.blocks.ok(t_mono),
            blocks=self.blocks,
            blocks_lost=self.blocks_lost(),
            odometry_ok=self.observer.odometry_ok(t_mono),
            fault=parts.fault(),
            condition=parts.condition(),
            trust=self.trust,
            pulse=self.timing.latest,
        )

    def facts(self) -> CycleFacts:
        """Returns the present facts on cycles and their input."""
        parts, inbox, watch, t_mono = self.parts, self.inbox, self.watch, self.parts.clock.now()
        result = self.result
        return CycleFacts(
            t_mono=t_mono,
            state=self.verdict.state,
            cycles=self.cycles,
            overruns=self.overruns,
            cycle_us=self.cycle_us,
            timing=self.timing.latest,
            short=self.timing.short,
            period=self.period.seconds,
            lidar=parts.status,
            lidar_silent=self.lidar_ok(t_mono) is False and self.lidar_silence(t_mono) is not None,
            scans_dropped=inbox.dropped,
            scans_late=watch.late,
            scans_repeated=watch.repeated,
            scans_misfit=watch.misfit,
            lag_s=0.0 if result is None or result.lag is None else result.lag.lag_s,
            slow=None if result is None else result.slow,
            gyro=None if result is None else result.gyro,
            odometry_ok=self.observer.odometry_ok(t_mono, inbox.wheels.latest),
            odometry_jumps=self.odometry.jumps,
            odometry_disagrees=watch.disagree,
            readings=watch.readings,
            readings_missed=watch.missed,
            readings_old=watch.old,
            readings_seldom=inbox.wheels.seldom(t_mono, self.period.seconds),
            photodiode=self._photodiode(t_mono),
            jobs_failed=parts.worker.failed,
            alert=self.alarm.said,
            sink_failing=bool(self.failing),
        )

    def _photodiode(self, t_mono: float) -> PhotodiodeFacts | None:
        bridge, watch = self.parts.samples, self.parts.blocks
        if bridge is None or watch is None:
            return None
        lights = None if self.result is None else self.result.lights
        return PhotodiodeFacts(
            ok=watch.ok(t_mono),
            status=watch.status,
            blocks=self.blocks,
            blocks_lost=self.blocks_lost(),
            blocks_dropped=self.inbox.blocks_dropped,
            unfit=bridge.unfit - bridge.dead,
            off_rate=bridge.off_rate,
            stalled=self.lamps.stalled,
            lamp_faults=self.lamps.faults,
            links=0 if lights is None else len(lights.links),
        )

    def _publish(self, snapshot: Snapshot) -> None:
        """Passes the snapshot to every sink; a sink that raises affects neither the cycle nor the other sinks."""
        for number, sink in enumerate(self.parts.sinks):
            try:
                sink(snapshot)
            except Exception:
                if number not in self.failing:
                    log.exception("a publisher has failed; the daemon logs this once until it works again")
                self.failing.add(number)
            else:
                self.failing.discard(number)

    def _account(self, t_mono: float, records: tuple[Record, ...], limits: Limits | None) -> None:
        if not self.stage_timer.measures:
            return
        us, budget_us = self.stage_timer.us, self.budget_us
        self.cycle_us = sum(us.values())
        self.overruns += self.cycle_us > budget_us
        self.timing.on_cycle(t_mono, us)
        if limits is not None and self.result is not None and not self.paused:
            light = any(isinstance(record, SampleBlock) for record in records)
            self.parts.budget.learn(Spent(us, budget_us, light), limits, self.result)

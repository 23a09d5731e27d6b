"""Replay runner: feeds a log's events to the daemon's own cycle on a virtual clock and collects the results."""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

import estimator
from daemon.config.schema import Config
from daemon.devices.conversion import SampleBridge, ScanBridge
from daemon.devices.light_setup import Lights
from daemon.devices.photodiode import BlockWatch
from daemon.health.assessment import REPLAYED, assess
from daemon.health.causes import grouped
from daemon.health.faults import Fault
from daemon.maps.container import BadMap
from daemon.maps.grid_files import finest
from daemon.maps.initial_state import begun, new_state, recorded_start, setup_of
from daemon.maps.store import Start
from daemon.maps.switching import take_over
from daemon.recording.recorder import CycleEntry, light_of, switch_name
from daemon.recording.replay_start import Restored
from daemon.replay.sources import Event, Source, Turn
from daemon.replay.trajectories import Ledger
from daemon.runtime.budget import FixedBudget
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import CycleRecord, Parts, Step
from daemon.runtime.vitals import ProcessFacts, vitals
from daemon.runtime.worker import CycleWorker, ScheduledWorker
from estimator import UNLIMITED, Array, Grid, Identity, Limits, MapImage, Order, Record, StepResult, image_of
from estimator.paper import LUMILOOP, method
from hal.adc import AdcStatus, RawSamples
from hal.imu import RawImu
from hal.lidar import Link, RawScan
from hal.odometry import RawOdometry

if TYPE_CHECKING:  # loaded only if matches are requested
    from daemon.replay.match_journal import MatchJournal
    from estimator import State


class ReplayClock:
    """Clock that the replay sets (`hal.clock.Clock`)."""

    def __init__(self) -> None:
        self.t_mono = 0.0

    def now(self) -> float:
        """Returns the log's monotonic time, s."""
        return self.t_mono

    def utc(self) -> float:
        """Returns the same: a replay has no calendar."""
        return self.t_mono


class ReplayBudget(FixedBudget):
    """No caps for a third-party log; for a recording, the caps of the repeated cycle."""

    def __init__(self) -> None:
        super().__init__()
        self.now = UNLIMITED

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Returns the caps in force."""
        return self.now


@dataclass(slots=True)
class Comparison:
    """Comparison of a replay with what its recording published.

    Attributes:
        cycles: recorded cycles. differ: cycles whose pose, state, reason or input differ in any bit, or that cannot run
            again. first: description of the first of them.
        judged: cycles of which state and reason were compared; none in older recordings.
        faults: number of these cycles that published each fault. Not compared: a replay has no devices.
    """

    cycles: int = 0
    differ: int = 0
    first: str = ""
    judged: int = 0
    faults: Counter[int] = field(default_factory=Counter)

    def note(self, cycle: int, how: str) -> None:
        """Counts a cycle that differs from the recorded one."""
        self.differ += 1
        self.first = self.first or f"cycle {cycle}: {how}"


@dataclass(slots=True)
class Timing:
    """Measured durations, s; the only part of a replay that is not repeatable."""

    cycles: array[float] = field(default_factory=lambda: array("d"))
    steps: array[float] = field(default_factory=lambda: array("d"))


class Rerun:
    """Replays one log through a new daemon cycle: feed every event, then read the results."""

    def __init__(
        self,
        source: Source,
        config: Config,
        lights: Lights | None = None,
        journal: MatchJournal | None = None,
        start: Start | None = None,
        name: str = LUMILOOP,
    ) -> None:
        """Prepares a run of the method called ``name``.

        ``start``: initial map; if the log begins with a checkpoint, the checkpoint is used. Another method than the
        daemon's begins with neither, has no caps and is not compared with the recording.

        Raises:
            DataInvalid: the checkpoint cannot be used.
        """
        self.method, own = name, name == LUMILOOP
        begin = source.begin.load() if own and source.begin is not None else None
        self.ledger = Ledger()
        self.comparison = Comparison()
        self.timing = Timing()
        self.odometry_m = 0.0
        self.readings = self.blocks = 0
        self.t_first = math.inf
        self.watch: Callable[[CycleRecord], object] | None = None
        self._source = source
        self._clock = ReplayClock()
        self._localise = own and config.map.localise
        settings = estimator.Settings(history=True, localise=self._localise)
        if own:
            self._state = begun(lights, settings, start) if begin is None else begin.keep_history()
            self._estimate: Step = partial(estimator.step, self._state)
        else:
            other = method(name)(settings, None if lights is None else setup_of(lights))
            self._state, self._estimate, lights = other.state, other.step, lights if other.lit else None
        self._lights = lights
        self._journal = journal
        if journal is not None:
            journal.attach(self._state)
        self._caps = ReplayBudget()
        self._answers: dict[int, tuple[int, ...]] = {}
        self._latest: tuple[float, float] = (0.0, 0.0)
        self._odometry: RawOdometry | None = None
        self._kept: list[CycleRecord] = []
        self._published: frozenset[int] = frozenset()
        self.cycle: Final = Cycle(self._parts(config, lights, begin))
        if begin is not None:
            begin.put_into(self.cycle)

    def _parts(self, config: Config, lights: Lights | None, begin: Restored | None) -> Parts:
        worker = self._scheduled(begin) if self._repeats else CycleWorker()
        return Parts(
            clock=self._clock,
            step=self._step,
            scans=ScanBridge(config.lidar),
            budget=self._caps,
            worker=worker,
            status=self._source.status,
            lidar=config.lidar.fitted,
            odometry=config.odometry.port > 0,
            samples=None if lights is None else SampleBridge(lights.profile),
            blocks=None if lights is None else BlockWatch(AdcStatus(), lights.profile),
            budget_us=1e3 * config.cycle.budget_ms,
            tap=self._keep,
            alert_m=config.integrity.alert_m,
            t_begun=self._source.t_begun,
        )

    def _scheduled(self, begin: Restored | None) -> ScheduledWorker:
        if begin is None:
            return ScheduledWorker(self._answers)
        return ScheduledWorker(self._answers, begin.rest["cycle"]["cycles"], begin.jobs)

    @property
    def _repeats(self) -> bool:
        """True if the run repeats a recorded one to the last bit."""
        return self._source.recorded and self.method == LUMILOOP

    @property
    def state(self) -> State:
        """Estimator state, for reading."""
        return self._state

    @property
    def t_mono(self) -> float:
        """Present time of the log's clock, s."""
        return self._clock.t_mono

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Present faults, gravest cause first; to be read once a second.

        Faults that follow from the data (:data:`~daemon.health.assessment.REPLAYED`) are derived again. All others are
        those that were published.
        """
        now = vitals(self.cycle.facts(), set(), ProcessFacts())
        again = [fault for fault in assess(now, now) if fault in REPLAYED]
        return grouped([*again, *(fault for fault in Fault if fault in self._published - REPLAYED)])

    def feed(self, event: Event) -> None:
        """Consumes one event and runs a cycle if one is due."""
        if isinstance(event, Turn):
            self._repeat(event)
            return
        self._arrive(event.t1 if isinstance(event, RawSamples) else event.t_rx)
        if isinstance(event, RawSamples):
            self.blocks += 1
            self._latest = (self._source.utc(event.t1), event.t1)
            self.cycle.inbox.put_samples(event)
        elif isinstance(event, RawScan):
            self._latest = (self._source.stamp(event), event.t_mono)
            self.cycle.inbox.put_scan(event)
            if not self._source.recorded:
                self._run()
        elif isinstance(event, RawOdometry):
            self._count(event)
            self.cycle.inbox.put_odometry(event)
        elif isinstance(event, RawImu):
            self.cycle.inbox.put_imu(event)

    def finish(self) -> None:
        """Ends the log: poses move with their keyframes to the final positions."""
        self.ledger.settle(estimator.keyframe_poses(self._state))

    def render(self) -> Grid:
        """Returns the grid map at the finest resolution that its extent allows."""
        return finest(partial(estimator.render_map, self._state))

    def image(self, identity: Identity) -> MapImage:
        """Returns the map as it is stored on a disk."""
        return image_of(self._state, identity)

    def lamps(self) -> Array | None:
        """Returns (k, 3) surveyed lamp positions in the map frame, m, and their numbers.

        None until light has aligned the map to the survey.
        """
        result = self.cycle.result
        if result is None or self._lights is None or not result.placed:
            return None
        return np.array([(lamp.x, lamp.y, lamp.lamp_id) for lamp in self._lights.survey.lamps]).reshape(-1, 3)

    def _arrive(self, t_rx: float) -> None:
        self._clock.t_mono = max(self._clock.t_mono, t_rx)
        self.t_first = min(self.t_first, self._clock.t_mono)

    def _count(self, reading: RawOdometry) -> None:
        if self._odometry is not None:
            way = math.hypot(reading.x - self._odometry.x, reading.y - self._odometry.y)
            self.odometry_m += way if math.isfinite(way) else 0.0
        self._odometry = reading
        self.readings += 1

    def _repeat(self, turn: Turn) -> None:
        """Runs a recorded cycle at its time with its commands, caps and job results, then compares it."""
        entry = turn.entry
        self._clock.t_mono = turn.t_mono
        self.t_first = min(self.t_first, turn.t_mono)
        for command in entry.orders():
            self.cycle.inbox.put_command(command)
        if self._repeats:
            if entry.switched:
                self.cycle.parts.switch.take_over = partial(self._switch, entry.switched)
            self._caps.now = entry.caps() or UNLIMITED
            self._answers[self.cycle.cycles + 1] = entry.answers
        self._source.status.link = Link.WAITING if entry.waiting else Link.STREAMING
        self._published = frozenset(entry.faults)
        try:
            record = self._run()
        except LookupError as error:
            self.comparison.cycles += 1
            self.comparison.note(entry.cycle, str(error))
        else:
            if self._repeats:
                self._compare(entry, record)

    def _switch(self, sha256: str) -> tuple[int, str]:
        """Switches to the map that the recorded run switched to; returns map ID and digest.

        Raises:
            LookupError: the map is not with the recording, or has another digest.
        """
        path = self._source.files[0].parent / switch_name(sha256)
        try:
            start = recorded_start(path, sha256, self._lights, self._localise)
        except (OSError, BadMap) as error:
            raise LookupError(f"{path.name}, the map to which the run switched, cannot be used: {error}") from error
        self.ledger.settle(estimator.keyframe_poses(self._state))
        take_over(
            self._state, new_state(self._lights, estimator.Settings(history=True, localise=self._localise), start)
        )
        return start.stored.meta.map_id, sha256

    def _compare(self, entry: CycleEntry, record: CycleRecord) -> None:
        result = record.result
        pose = None if result is None else (tuple(result.T_odom_base.tolist()), tuple(result.T_map_odom.tolist()))
        recorded = None if entry.odom is None else (entry.odom, entry.map_odom)
        light, said = light_of(result), (entry.state, entry.reason)
        judged = (int(record.snapshot.state), int(record.snapshot.reason))
        self.comparison.cycles += 1
        if entry.reason is not None:
            self.comparison.judged += 1
            self.comparison.faults.update(entry.faults)
        if (entry.scan, entry.dropped) != (record.scan, record.dropped):
            self.comparison.note(entry.cycle, f"used scan {record.scan}, recorded is {entry.scan}")
        elif entry.samples != record.samples:
            self.comparison.note(entry.cycle, f"used block {record.samples}, recorded is {entry.samples}")
        elif entry.caps() != record.limits:
            self.comparison.note(entry.cycle, "made an estimator step and the recorded cycle did not, or the reverse")
        elif pose != recorded:
            self.comparison.note(entry.cycle, f"T_odom_base, T_map_odom are {pose}, recorded are {recorded}")
        elif light != entry.light:
            self.comparison.note(entry.cycle, f"the light solution is {light}, recorded is {entry.light}")
        elif entry.reason is not None and judged != said:
            self.comparison.note(entry.cycle, f"state and reason are {judged}, recorded are {said}")

    def _run(self) -> CycleRecord:
        begun = time.perf_counter()
        self.cycle.run()
        self.timing.cycles.append(time.perf_counter() - begun)
        return self._kept.pop()

    def _step(self, records: tuple[Record, ...], limits: Limits) -> StepResult:
        if self._journal is not None:
            self._journal.begins(self.t_first)
        if any(getattr(record, "order", None) is Order.RESET for record in records):
            self.ledger.settle(estimator.keyframe_poses(self._state))
        begun = time.perf_counter()
        result = self._estimate(records, limits)
        self.timing.steps.append(time.perf_counter() - begun)
        return result

    def _keep(self, record: CycleRecord) -> None:
        self._kept.append(record)
        if self.watch is not None:
            self.watch(record)
        row = self.ledger.add(record, *self._latest)
        if self._journal is not None:
            self._journal.gave(row)

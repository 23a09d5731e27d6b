"""The daemon application: builds all components in one place, starts and supervises them, and stops them in order.

`daemon/cli/run.py` is the command.
Start order: publishers, lidar, photodiode and inputs, because their handshakes take time. A thread loads the estimator
meanwhile; then the cycles start.
Stop order: cycles, lidar (its laser is switched off), inputs, publishers, recording.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import math
from collections.abc import Callable, Coroutine
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from daemon.config.paths import state_folder
from daemon.config.schema import Config
from daemon.devices.conversion import SampleBridge, ScanBridge
from daemon.devices.light_setup import Lights, load_lights
from daemon.devices.photodiode import BlockWatch
from daemon.devices.port_tap import tapped
from daemon.environment import Environment, NoLidar
from daemon.health.assessment import Vitals
from daemon.health.present_faults import PresentFaults
from daemon.health.report import Reporter
from daemon.health.supervisor import Supervisor
from daemon.health.thread_watch import COMPUTING_S, DISK_S, ThreadWatch
from daemon.maps.autosave import About, MapAutosaver
from daemon.maps.initial_state import CannotBegin, NoMap
from daemon.maps.last_pose import LastPose
from daemon.maps.schema import digest_of
from daemon.maps.store import judge_for
from daemon.maps.switching import Maps, MapSwitch, Switch
from daemon.publish.feeds import Feeds
from daemon.publish.network import Network
from daemon.publish.stream.ticker import StreamBeat
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import Parts, PendingSwitch
from daemon.runtime.estimator_runner import EstimatorRunner
from daemon.runtime.heartbeat import Heartbeat
from daemon.runtime.inbox import Inbox
from daemon.runtime.scheduler import Pacemaker
from daemon.runtime.snapshot_builder import SnapshotBuilder
from daemon.runtime.stage_times import StageTimer
from daemon.runtime.vitals import ProcessFacts, process_age_s, resident_mb, statistics, vitals
from daemon.runtime.warmup import Warmth
from daemon.runtime.worker import ThreadWorker, Worker
from daemon.snapshot import Snapshot, State, Thread
from daemon.system.descriptors import used_up
from daemon.system.patience import within
from daemon.system.processor_wait import ProcessorWait
from daemon.system.realtime import claim, line_up
from daemon.system.sd_notify import notify
from estimator import Command, Order
from hal.adc import BusStuck, RawSamples
from hal.lidar import Lidar, RawScan
from hal.net.inputs import OnImu, OnOdometry
from hal.photodiode.bus_watchdog import HANG_S
from hal.replay.recording import Kind

if TYPE_CHECKING:
    from daemon.recording.recorder import Recorder

__all__ = ["Daemon", "Environment"]

log = logging.getLogger(__name__)

QUIET_S: Final = 2.0
"""Longest time in s that a component may take to stop: the lidar has to receive the command that switches its laser
off."""
EXTEND_US: Final = 30_000_000
"""Extension in us of the service manager's start timeout, sent repeatedly during the first start."""
STARTING_S: Final = 900.0
"""The start timeout is extended for this long (s). After that the service manager restarts a start that does not end,
because of a disk or of another process that compiles. The next start finds the kernels that are compiled already."""
TRIAL_S: Final = 2.0
"""Longest wait in s for the disk to take the count of starts."""
PLACED: Final = (State.MAPPING, State.TRACKING, State.DEGRADED)
"""States with a usable pose in the map."""


class Daemon:
    """One run of the daemon. The constructor builds all components; nothing is opened before :meth:`run`.

    Raises:
        SurveyError: the lamp survey cannot be used.
    """

    def __init__(self, settings: Config, environment: Environment, recorder: Recorder | None = None) -> None:
        self._environment, self._recorder = environment, recorder
        clock = environment.clock
        self._begun = clock.now()
        self._wait = ProcessorWait()
        lights = environment.lights or load_lights(settings)

        opener = environment.opener if recorder is None else recorder.tap(environment.opener)
        opener = opener if environment.stream is None else tapped(opener, self._on_raw, clock)
        fitted = settings.lidar.fitted
        self.lidar: Lidar = environment.make_lidar(settings.lidar, clock, opener) if fitted else NoLidar()
        self.adc = None if lights is None else environment.make_adc(settings.photodiode, clock, environment.buses)
        adc = None if self.adc is None else self.adc.status

        timer = StageTimer(environment.stopwatch)
        self._estimator = EstimatorRunner(lights, environment.start, settings.map.localise, timer.lap)
        inbox, snapshots, switch = Inbox(), SnapshotBuilder(self._first_map_id()), PendingSwitch()
        worker = environment.make_worker()

        self.autosaver = self._autosaver(settings, lights, snapshots)
        self.last_pose = None if environment.store is None else LastPose(environment.store.folder, state_folder())
        self.maps = self._map_switch(lights, switch)

        self.supervisor, self.faults = Supervisor(), PresentFaults()
        self.threads = self._watched_threads(worker)
        reporter = Reporter(clock, self.supervisor, self.threads, self.faults, (self.lidar.status, adc))
        self.network = Network(settings, clock, self._feeds(inbox, snapshots), environment.stream)

        kept = [] if self.last_pose is None else [self.last_pose.on_snapshot]
        self.cycle = Cycle(
            Parts(
                clock=clock,
                step=self._estimator,
                scans=ScanBridge(settings.lidar),
                budget=environment.make_budget(),
                worker=worker,
                status=self.lidar.status,
                lidar=fitted,
                odometry=settings.odometry.port > 0,
                samples=None if lights is None else SampleBridge(lights.profile),
                blocks=None if lights is None or adc is None else BlockWatch(adc, lights.profile),
                budget_us=1e3 * settings.cycle.budget_ms,
                timer=timer,
                inbox=inbox,
                snapshots=snapshots,
                switch=switch,
                sinks=[*self.network.sinks, *kept, *environment.sinks, _FirstPose()],
                tap=None if recorder is None else recorder.on_cycle,
                fault=self.faults.gravest,
                condition=reporter,
                alert_m=settings.integrity.alert_m,
                t_begun=0.0 if recorder is None else recorder.t_begun,  # a replay starts at the same instant
            )
        )
        if recorder is not None:
            recorder.box.attach(self.cycle, lambda: self._estimator.state, lambda: self.faults.faults)
        self.heartbeat = Heartbeat(
            self._vitals, lambda: statistics(self.cycle.facts()), lambda: self.threads.alive, self.faults
        )
        self.pacemaker = Pacemaker(self.cycle)
        on_scan, on_samples = self.pacemaker.on_scan, self.pacemaker.on_samples
        self._on_scan = on_scan if recorder is None else recorder.on_scan(on_scan)
        self._on_samples = on_samples if recorder is None else recorder.on_samples(on_samples)

    def _first_map_id(self) -> int:
        """Map identity at the start: that of the stored map if there is one, otherwise a new one."""
        start = self._environment.start
        return self._environment.draw_map_id() if start is None else start.stored.meta.map_id

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set.

        Raises:
            Exception: a defect in the cycle itself. The estimate is no longer reliable, so only a restart helps.
        """
        tasks = {name: asyncio.create_task(part, name=name) for name, part in self._parts().items()}
        stopped = asyncio.create_task(stop.wait(), name="stop")
        warming = asyncio.create_task(self._warm_up(), name="warm-up")
        if self.last_pose is not None:
            self.last_pose.start()
        try:
            await _first_to_end(warming, stopped, tasks["heartbeat"])
            if not stop.is_set():
                log.info("%s", "; ".join(claim()))
                tasks["cycle"] = asyncio.create_task(self.pacemaker.run(), name="cycle")
                notify("READY=1", "STATUS=running")
                await _first_to_end(stopped, tasks["cycle"], tasks["heartbeat"])
        finally:
            notify("STOPPING=1")
            log.info("stopping")
            self._keep_sample_clock()
            await _stop(tasks.get("cycle"))
            saving = asyncio.create_task(self.autosaver.finish(stop.is_set()), name="map at shutdown")
            for name in (
                "lidar",
                *tasks,
            ):  # the lidar first, before components that only receive: its laser has to be switched off
                await _stop(tasks.get(name))
            for task in (stopped, warming):
                await _stop(task)
            self.cycle.parts.worker.close()
            for kept in (self.last_pose, self._environment.sample_clock):
                if kept is not None:
                    kept.close()
            self._wait.close()
            await saving
            if self._recorder is not None:
                self._recorder.close(ended=stop.is_set())

    async def _warm_up(self) -> None:
        warmth = await self._environment.warm_up()
        if isinstance(warmth, Warmth) and warmth.code_us > 0.0:
            self.cycle.parts.budget.learn_code(warmth.code_us)
        if (store := self._environment.store) is not None:
            with contextlib.suppress(TimeoutError):  # a start that is not counted; the disk has a fault of its own
                within(TRIAL_S, store.trial.begin)
        if self._environment.start is not None:
            self._begin(self._environment.start.stored.meta.map_id)
            gc.freeze()  # excludes the loaded map from garbage collection
            self._remember()
        self.autosaver.loaded()

    def _begin(self, map_id: int) -> None:
        """Load the stored map into the estimator. If it cannot be used, start with a new map under a new identity.

        As soon as cycles run, an earlier generation of the stored map is loaded, as by the command SWITCH_MAP.

        Raises:
            NoMap: no stored map can be used, and `map.localise` requires one.
        """
        store = self._environment.store
        try:
            self._estimator.load()
        except CannotBegin as error:
            assert store is not None
            store.refuse(error)
            if self._estimator.localise:
                raise NoMap(
                    f"map {map_id:08x} cannot be used, but `map.localise` is true; restart the daemon"
                ) from error
            self._estimator.start = None
            self._estimator.load()
            self.cycle.map_id = self._environment.draw_map_id()
            self.autosaver.without_start()
            self.maps.ask(
                map_id, lambda why: log.warning("the daemon begins a new map: %s", why) if why else None, patient=True
            )

    def _remember(self) -> None:
        """Put the stored pose of the previous run into the inbox as a command to the estimator."""
        pose = None if self.last_pose is None else self.last_pose.of_map(self.cycle.map_id)
        if pose is not None:
            log.info("the last stored pose is x %.2f m, y %.2f m, heading %.1f deg", *pose[:2], math.degrees(pose[2]))
            self.cycle.inbox.put_command(Command(self._environment.clock.now(), Order.REMEMBERED, np.array(pose)))

    def _autosaver(self, settings: Config, lights: Lights | None, snapshots: SnapshotBuilder) -> MapAutosaver:
        survey = "" if lights is None else digest_of(lights.survey)
        about = About(settings.name, survey, settings.map.localise)
        environment, runner = self._environment, self._estimator
        return MapAutosaver(
            environment.store,
            environment.start,
            lambda: runner.state,
            lambda: snapshots.map_id,
            about,
            environment.clock,
        )

    def _map_switch(self, lights: Lights | None, pending: PendingSwitch) -> MapSwitch:
        keep = None if self._recorder is None else self._recorder.keep_switch
        maps = Maps(self._environment.store, judge_for(lights), self._estimator.made, keep)
        runner, autosaver = self._estimator, self.autosaver

        def put(switch: Switch | None, taken: Callable[[], None]) -> None:
            """Hand a switch to the cycle, or withdraw it (None). The autosaver changes its map at the same instant."""

            def take_over(switch: Switch) -> tuple[int, str]:
                runner.take_over(switch)
                autosaver.switched(switch.map_id, switch.start)
                taken()
                return switch.map_id, switch.sha256

            pending.take_over = None if switch is None else partial(take_over, switch)

        return MapSwitch(maps, autosaver, put)

    def _parts(self) -> dict[str, Coroutine[None, None, None]]:
        """Supervised components that run beside the cycle, by name, in order of start."""
        parts = {**self.network.parts, "lidar": lambda: self.lidar.run(self._take_scan)}
        if self._environment.store is not None:
            parts["map"] = self.autosaver.run
        if (adc := self.adc) is not None:
            parts["photodiode"] = lambda: adc.run(self._take_samples)
        if self.network.stream is not None:
            beat = StreamBeat(
                self.network.stream, self.cycle.facts, lambda: self._estimator.state, lambda: self.faults.faults
            )
            parts["stream beat"] = beat.run
        supervised = {name: self.supervisor.keep(name, run) for name, run in parts.items()}
        return {"heartbeat": self.heartbeat.run(), **supervised}

    def _watched_threads(self, worker: Worker) -> ThreadWatch:
        """Hang detection for every worker thread of this run."""
        threads, autosaver = ThreadWatch(), self.autosaver
        threads.watch(Thread.MAP, lambda: autosaver.busy_since, DISK_S)
        if isinstance(worker, ThreadWorker):
            threads.watch(Thread.SOLVER, lambda: worker.since[0], COMPUTING_S)
            threads.watch(Thread.SEARCH, lambda: worker.since[1], COMPUTING_S)
        if (last := self.last_pose) is not None:
            threads.watch(Thread.POSE, lambda: last.busy_since, DISK_S)
        if (recorder := self._recorder) is not None:
            threads.watch(Thread.RECORDING, lambda: recorder.disk.busy_since, DISK_S)
        if (adc := self.adc) is not None:
            threads.watch(Thread.I2C, lambda: 0.0 if isinstance(adc.status.error, BusStuck) else None, HANG_S)
        return threads

    def _on_raw(self, kind: Kind, t_mono: float, data: bytes) -> None:
        if self.network.stream is not None:
            self.network.stream.on_raw("lidar", kind.name.lower(), t_mono, data)

    def _take_samples(self, block: RawSamples) -> None:
        self._on_samples(block)
        if self.network.stream is not None:
            self.network.stream.on_samples(block)

    def _take_scan(self, scan: RawScan) -> None:
        self._on_scan(scan)
        if self.network.stream is not None:
            self.network.stream.on_scan(scan)

    def _feeds(self, inbox: Inbox, snapshots: SnapshotBuilder) -> Feeds:
        recorder = self._recorder
        on_odometry: OnOdometry = inbox.put_odometry
        on_imu: OnImu = inbox.put_imu
        if recorder is not None:
            on_odometry, on_imu = recorder.on_odometry(on_odometry), recorder.on_imu(on_imu)
        return Feeds(
            on_odometry,
            on_imu,
            on_command=inbox.put_command,
            on_save=self.autosaver.ask,
            on_dump=None if recorder is None else recorder.box.dump,
            on_switch=self.maps.ask,
            on_loop_seen=snapshots.on_loops_seen,
        )

    def _keep_sample_clock(self) -> None:
        result, store = self.cycle.result, self._environment.sample_clock
        if store is not None and result is not None and result.lights is not None:
            store.learn(result.lights.clock_ppm)

    def _vitals(self, lateness: float) -> Vitals:
        self._keep_sample_clock()
        line_up()
        if self.cycle.cycles == 0:
            self.cycle.announce()
            if self._environment.clock.now() - self._begun < STARTING_S:
                notify(f"EXTEND_TIMEOUT_USEC={EXTEND_US}", "STATUS=loading the estimator")
        failed = self.supervisor.failed | self.network.failing
        failed |= set() if self._recorder is None else self._recorder.failing
        if self.autosaver.error:
            failed.add("map")
        if self.last_pose is not None and self.last_pose.error:
            failed.add("last pose")
        if self.autosaver.refused:
            failed.add("stored map")
        if self.threads.look() - {Thread.I2C}:  # the bus has faults of its own
            failed.add("thread")
        return vitals(self.cycle.facts(), failed, self._process(max(lateness, self.pacemaker.latest())))

    def _process(self, lateness: float) -> ProcessFacts:
        """Facts on the process; in virtual time nothing but the delay, because the processor does not count there."""
        if self._environment.stopwatch is None:
            return ProcessFacts(lateness)
        return ProcessFacts(lateness, self._wait.seconds() or 0.0, used_up())


class _FirstPose:
    """Logs once the time in s from the start of the process to the first usable pose."""

    def __init__(self) -> None:
        self._said = False

    def __call__(self, snapshot: Snapshot) -> None:
        if snapshot.pose is not None and snapshot.state in PLACED and not self._said:
            self._said = True
            log.info("first pose %.2f s after the start, %.0f MB", process_age_s(), resident_mb())


async def _first_to_end(*tasks: asyncio.Task[Any]) -> None:
    """Wait until one of the tasks ends, and raise its exception if it failed."""
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()


async def _stop(task: asyncio.Task[Any] | None) -> None:
    """Cancel a task and wait at most :data:`QUIET_S` for its end; its exception is logged."""
    if task is None or task.done():
        return
    task.cancel()
    await asyncio.wait([task], timeout=QUIET_S)
    if not task.done():
        log.warning("task %s does not stop", task.get_name())
    elif not task.cancelled() and (error := task.exception()) is not None:
        log.error("task %s failed while stopping", task.get_name(), exc_info=error)

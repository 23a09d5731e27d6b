"""``lumiloop run``: puts the rooms together, keeps every part running, and stops cleanly.

Start order: publishers, lidar and inputs (their hand-shakes take time), then the estimator is loaded in a thread while
they do, then cycles. Stop order: cycles, lidar (its laser is switched off), inputs, publishers, recording.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import secrets
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from daemon import configfile
from daemon.bridge import ScanBridge
from daemon.budget import Budget, MeasuredBudget
from daemon.config import Config, LidarConfig
from daemon.cycle import Cycle, Pacemaker, Parts, Sink, Step
from daemon.health import Vitals
from daemon.heartbeat import Heartbeat
from daemon.network import Feeds, Network
from daemon.notify import notify
from daemon.publish.snapshot import Snapshot
from daemon.supervise import Supervisor
from daemon.vitals import process_age_s, resident_mb, statistics, vitals
from daemon.warmup import CannotLoad, warm_up
from daemon.worker import ThreadWorker, Worker
from estimator.records import Limits, Record
from estimator.result import StepResult
from hal.clock import Clock, SystemClock
from hal.errors import HalError
from hal.lidar import Lidar
from hal.port import PortOpener, open_port

if TYPE_CHECKING:
    from daemon.record import Recorder

log = logging.getLogger(__name__)

QUIET_S: Final = 2.0
"""Seconds a part may take to stop: the lidar has to be told to switch its laser off."""
EXTEND_US: Final = 30_000_000
"""Microseconds by which the service manager is asked, again and again, to go on waiting for the first start."""
TERMINAL_FORMAT: Final = "%(asctime)s %(levelname)-7s %(message)s"


class LidarMaker(Protocol):
    """Makes a lidar driver from its configuration."""

    def __call__(self, config: LidarConfig, clock: Clock, opener: PortOpener) -> Lidar:
        """A driver that is not running yet."""
        ...


def make_lidar(config: LidarConfig, clock: Clock, opener: PortOpener) -> Lidar:
    """The driver that the device string names; HOKUYO's where it names none.

    Raises:
        DeviceRefused: there is no such driver.
    """
    from hal.registry import lidar_factory, split

    name, device = split(config.device)
    return lidar_factory(name)(
        device, clock=clock, opener=opener, serial=config.serial, baud=config.baud, intensity=config.intensity
    )


@dataclass(slots=True)
class World:
    """What the daemon meets outside itself. A test replaces any of it; the defaults are the real thing.

    Attributes:
        stopwatch: measures stages and budget; None: nothing is measured. sinks: get every snapshot too.
        warm_up: loads the estimator. draw_map_id: identity of a new map frame.
    """

    clock: Clock
    opener: PortOpener = open_port
    make_lidar: LidarMaker = make_lidar
    make_worker: Callable[[], Worker] = ThreadWorker
    make_budget: Callable[[], Budget] = MeasuredBudget
    stopwatch: Callable[[], float] | None = time.perf_counter
    warm_up: Callable[[], Awaitable[object]] = warm_up
    sinks: tuple[Sink, ...] = ()
    draw_map_id: Callable[[], int] = lambda: 1 + secrets.randbelow(2**32 - 1)


class Daemon:
    """One run of the daemon: everything is built here, nothing is opened before :meth:`run`."""

    def __init__(self, settings: Config, world: World, recorder: Recorder | None = None) -> None:
        self.supervisor = Supervisor()
        self._world = world
        self._recorder = recorder
        opener = world.opener if recorder is None else recorder.tap(world.opener)
        self.lidar = world.make_lidar(settings.lidar, world.clock, opener)
        self.cycle = Cycle(
            Parts(
                clock=world.clock,
                step=_Estimator(),
                scans=ScanBridge(settings.lidar),
                budget=world.make_budget(),
                worker=world.make_worker(),
                status=self.lidar.status,
                odometry=settings.odometry.port > 0,
                budget_us=1e3 * settings.cycle.budget_ms,
                stopwatch=world.stopwatch,
                tap=None if recorder is None else recorder.on_cycle,
                map_id=world.draw_map_id(),
            )
        )
        self.pacemaker = Pacemaker(self.cycle)
        self._on_scan = self.pacemaker.on_scan if recorder is None else recorder.on_scan(self.pacemaker.on_scan)
        self.network = Network(settings, world.clock, self._feeds())
        self.cycle.parts.sinks += [*self.network.sinks, *world.sinks, _FirstPose()]
        self.heartbeat = Heartbeat(self._vitals, lambda: statistics(self.cycle))
        self.cycle.parts.fault = self.heartbeat.fault

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set.

        Raises:
            Exception: a defect in the cycle itself. The estimate cannot be trusted any more; only a new start helps.
        """
        tasks = {name: asyncio.create_task(part, name=name) for name, part in self._parts().items()}
        stopped = asyncio.create_task(stop.wait(), name="stop")
        warming = asyncio.create_task(_awaited(self._world.warm_up()), name="warm-up")
        try:
            await _first_to_end(warming, stopped, tasks["heartbeat"])
            if not stop.is_set():
                tasks["cycle"] = asyncio.create_task(self.pacemaker.run(), name="cycle")
                notify("READY=1", "STATUS=running")
                await _first_to_end(stopped, tasks["cycle"], tasks["heartbeat"])
        finally:
            notify("STOPPING=1")
            log.info("stopping")
            for name in ("cycle", "lidar", *tasks):  # the lidar before what only listens: its laser is to go off
                await _stop(tasks.get(name))
            for task in (stopped, warming):
                await _stop(task)
            self.cycle.parts.worker.close()
            if self._recorder is not None:
                self._recorder.close()

    def _parts(self) -> dict[str, Coroutine[None, None, None]]:
        """What runs beside the cycle, in order of start."""
        parts = {**self.network.parts, "lidar": lambda: self.lidar.run(self._on_scan)}
        supervised = {name: self.supervisor.keep(name, run) for name, run in parts.items()}
        return {"heartbeat": self.heartbeat.run(), **supervised}

    def _feeds(self) -> Feeds:
        inbox, recorder = self.cycle.inbox, self._recorder
        if recorder is None:
            return Feeds(inbox.put_odometry, inbox.put_imu, inbox.put_command)
        return Feeds(recorder.on_odometry(inbox.put_odometry), recorder.on_imu(inbox.put_imu), inbox.put_command)

    def _vitals(self, lateness: float) -> Vitals:
        if self.cycle.cycles == 0:
            self.cycle.announce()
            notify(f"EXTEND_TIMEOUT_USEC={EXTEND_US}", "STATUS=loading the estimator")
        failed = set(self.supervisor.failed)
        if self._recorder is not None and self._recorder.error:
            failed.add("recorder")
        return vitals(self.cycle, failed, lateness)


class _Estimator:
    """The estimator with its state; loaded with the first step, which the warm-up has made quick."""

    def __init__(self) -> None:
        self._step: Step | None = None

    def __call__(self, records: tuple[Record, ...], limits: Limits) -> StepResult:
        if self._step is None:
            from estimator import pipeline

            self._step = partial(pipeline.step, pipeline.new_state())
        return self._step(records, limits)


class _FirstPose:
    """Says once how long the first pose took, from the start of the process."""

    def __init__(self) -> None:
        self._said = False

    def __call__(self, snapshot: Snapshot) -> None:
        if snapshot.pose is not None and not self._said:
            self._said = True
            log.info("first pose %.2f s after the start, %.0f MB", process_age_s(), resident_mb())


async def _awaited(work: Awaitable[object]) -> None:
    await work


async def _first_to_end(*tasks: asyncio.Task[Any]) -> None:
    """Wait until one of the tasks ends; raises what it raised."""
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()


async def _stop(task: asyncio.Task[Any] | None) -> None:
    """Cancel a task and wait for it, but not for ever; what it raises on its way out is logged."""
    if task is None or task.done():
        return
    task.cancel()
    await asyncio.wait([task], timeout=QUIET_S)
    if not task.done():
        log.warning("%s does not stop", task.get_name())
    elif not task.cancelled() and (error := task.exception()) is not None:
        log.error("%s failed while stopping", task.get_name(), exc_info=error)


def main(args: argparse.Namespace) -> int:
    """The command ``run``. ``args.settings`` holds the configuration, ``args.record`` a directory or None."""
    start_log()
    settings: Config = args.settings
    log.info("%s: configuration\n%s", settings.name, configfile.dump(settings).rstrip())
    log.info("%s", _whereabouts(settings, args.record))
    recorder = None
    try:
        if args.record is not None:
            from daemon.record import Recorder

            recorder = Recorder(args.record, settings, SystemClock())
        asyncio.run(_run_until_signal(settings, recorder))
    except (HalError, CannotLoad) as error:
        log.error("%s", error)
        return 1
    return 0


def _whereabouts(settings: Config, record: Path | None) -> str:
    """One line for the person at the terminal: where the pose can be read, what is kept, how to stop."""
    modbus = f"Modbus on {settings.bind} port {settings.modbus.port} (UDP and TCP)"
    said = [modbus if settings.modbus.port else "no Modbus"]
    said += [f"pose datagrams to {', '.join(settings.pose.receivers)}"] if settings.pose.receivers else []
    said += [f"recording into {record}"] if record is not None else []
    return f"{'; '.join(said)}; Ctrl-C or SIGTERM stops"


async def _run_until_signal(settings: Config, recorder: Recorder | None) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    await Daemon(settings, World(SystemClock()), recorder).run(stop)


def start_log() -> None:
    """Log to stderr: with the journal's priorities where the journal reads it, else with the time of day."""
    handler = logging.StreamHandler(sys.stderr)
    formatter = _JournalFormat("%(message)s") if _to_journal() else logging.Formatter(TERMINAL_FORMAT)
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def _to_journal() -> bool:
    """Whether stderr is the journal's own stream and not redirected (systemd.exec(5), JOURNAL_STREAM)."""
    try:
        at = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{at.st_dev}:{at.st_ino}"


class _JournalFormat(logging.Formatter):
    """Lines as sd-daemon(3) wants them: priority first, on every line of a message."""

    PRIORITY: Final = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.DEBUG: 7}

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{self.PRIORITY.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines())

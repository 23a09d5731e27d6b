"""``lumiloop run``: runs the daemon with the stored map and the survey until a signal stops it."""

from __future__ import annotations

import argparse
import asyncio
import logging
import math
import signal
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.app import EXTEND_US, Daemon
from daemon.config import loader
from daemon.config.paths import maps_folder, runtime_folder, streams_served
from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError
from daemon.devices.light_setup import load_lights
from daemon.devices.sample_clock import SampleClock
from daemon.environment import Environment
from daemon.maps.initial_state import NoMap, started_in_time
from daemon.runtime.stall_watch import StallWatch
from daemon.runtime.warmup import CannotLoad, warm_up
from daemon.system.console import FAILED, OK, USAGE
from daemon.system.logging import start_log
from daemon.system.patience import reported
from daemon.system.realtime import give_back
from daemon.system.sd_notify import managed, notify
from hal.clock import SystemClock
from hal.errors import HalError

if TYPE_CHECKING:
    from daemon.recording.recorder import Recorder

log = logging.getLogger(__name__)

ANEW_S: Final = 10.0
"""Pause before the end of a failed start, s: the service manager would restart after 0.2 s, which suits a crash.
What was missing (a map, room for kernels or a recording) is still missing by then. Each start takes seconds of
processor time and lines of the log.
"""

SECOND: Final = (
    "two daemons cannot share sensors, ports and maps; stop the other one (systemctl stop lumiloop), or give "
    "this one its own `name`, devices and ports"
)


def main(args: argparse.Namespace) -> int:
    """Runs the command.

    ``args``: configuration (``settings``), recording folder (``record``), minutes kept (``last``).
    """
    start_log()
    settings: Config = args.settings
    overruled = f", with {len(args.set)} values of the command line" if args.set else ""
    log.info("%s: configuration %s%s", settings.name, args.source, overruled)
    log.debug("every value:\n%s", loader.dump(settings).rstrip())
    for other in streams_served(settings.name):  # this may be intended, but each device has one owner
        log.warning("a daemon with the name %s runs on this computer already (%s); %s", settings.name, other, SECOND)
    recorder = None
    give_back()
    try:
        with reported("the survey and the stored map"):
            environment = _environment(settings)
        log.info("%s", _whereabouts(settings, args.record, environment.stream))
        if args.record is not None:
            from daemon.recording.recorder import Recorder

            keep_s = math.inf if args.last is None else 60.0 * args.last
            recorder = Recorder(args.record, settings, environment.clock, environment.lights, environment.start, keep_s)
        asyncio.run(_run_until_signal(settings, environment, recorder))
    except SurveyError as error:
        log.error("%s", error)
        return USAGE
    except (HalError, CannotLoad, NoMap) as error:
        log.error("%s", error)
        _wait_before_anew()
        return FAILED
    return OK


def _wait_before_anew() -> None:
    """Delays the service manager's restart after a failed start; a stop ends the wait (SIGTERM's default action)."""
    if managed():
        notify(f"EXTEND_TIMEOUT_USEC={EXTEND_US}", "STATUS=cannot start, see the log; the daemon tries again soon")
        log.info("the daemon tries to start again in %.0f s", ANEW_S)
        time.sleep(ANEW_S)


def _environment(settings: Config) -> Environment:
    """Returns the real environment with the stored map and the survey; raises `SurveyError` and `NoMap`."""
    stream = runtime_folder() / f"{settings.name}.stream"
    if not settings.photodiode.fitted:
        store, start = started_in_time(settings.map, None)
        return Environment(SystemClock(), store=store, start=start, stream=stream)
    clock = SampleClock(settings.photodiode)
    lights = load_lights(settings, clock.ppm)
    store, start = started_in_time(settings.map, lights)
    environment = Environment(SystemClock(), store=store, start=start, stream=stream)
    return replace(environment, warm_up=partial(warm_up, lights=lights), lights=lights, sample_clock=clock)


def _whereabouts(settings: Config, record: Path | None, stream: Path | None) -> str:
    """Returns one line for the operator: where the pose is published, what is stored, how to stop."""
    modbus = f"Modbus on {settings.bind} port {settings.modbus.port} (UDP and TCP)"
    said = [modbus if settings.modbus.port else "no Modbus on the network"]
    said += [f"Modbus RTU on {settings.modbus.serial}"] if settings.modbus.serial else []
    said += [f"only for {', '.join(settings.allow)}"] if settings.allow else []
    said += [f"pose datagrams to {', '.join(settings.pose.receivers)}"] if settings.pose.receivers else []
    said += [f"stream {stream}"] if stream is not None else []
    used = "map from" if settings.map.localise else "maps in"
    said += [f"{used} {maps_folder(settings.map.folder)}"] if settings.map.kept else ["maps are not stored"]
    said += [f"recording to {record}"] if record is not None else []
    return f"{'; '.join(said)}; Ctrl-C or SIGTERM stops"


async def _run_until_signal(settings: Config, environment: Environment, recorder: Recorder | None) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    daemon = Daemon(settings, environment, recorder)
    daemon.pacemaker.watch = StallWatch()
    await daemon.run(stop)

"""``lumiloop check``: whether configuration, survey and maps are good, and whether the photodiode's bus is here."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import math
import os
import sys
from enum import Enum, auto
from pathlib import Path
from typing import Final

from daemon.cli import parser
from daemon.config import loader
from daemon.config.paths import can_be_made, maps_folder
from daemon.config.schema import Config, Mount

FAR_M: Final = 5.0
"""A lidar is on its robot."""
LOCKS: Final = Path("/proc/locks")


def main(args: argparse.Namespace) -> int:
    """The command ``check``: all that is wrong, in one round; returns the exit code.

    A bus that is not here is a remark, not a refusal: files are also checked on other computers.
    """
    wrong, gone = list[tuple[int, str]](), frozenset[str]()
    settings: Config | None
    try:
        settings = loader.load(args.config, args.set)
    except loader.ConfigError as error:
        settings, gone = error.rest, error.wrong
        wrong.append((parser.USAGE, str(error)))
    if args.print_config and settings is not None and not wrong:
        sys.stdout.write(loader.dump(settings))
        return parser.OK
    remarks = [] if settings is None else _look(settings, args.config, gone, wrong)
    if wrong:
        return parser.fail("\n".join(text for _, text in wrong), max(code for code, _ in wrong))
    sys.stdout.write("".join(f"{line}\n" for line in (f"{args.config}: good", *remarks)))
    return parser.OK


def _look(settings: Config, file: Path, gone: frozenset[str], wrong: list[tuple[int, str]]) -> list[str]:
    """What is remarked of a configuration and of what it names; what is wrong joins ``wrong``, with an exit code.

    ``gone``: keys whose values are not to be had; what hangs on them is not judged.
    """
    remarks = implausible(settings.lidar.mount)
    if settings.lights.survey:
        profile = None if "photodiode.profile" in gone else settings.photodiode.profile
        remarks += _look_at_survey(settings, profile, file, wrong)
    if settings.photodiode.fitted:
        remarks.append(_look_at_bus(settings.photodiode.bus))
    if settings.map.kept and "map.folder" not in gone:
        found, remark = look_at_maps(settings)
        if settings.map.localise and found is not Maps.READY:
            words = f"{remark}; `map.localise` in {file} asks for a map: `run` would be refused"
            wrong.append((parser.FAILED, words))
        remarks.append(remark)
    return remarks


def _look_at_survey(settings: Config, profile: str | None, file: Path, wrong: list[tuple[int, str]]) -> list[str]:
    """Likewise of the survey; ``profile`` of its lamps, None: not known."""
    from daemon.config.survey_loader import SurveyError, read_survey
    from daemon.runtime.light_setup import read_residuals
    from estimator import PROFILES

    path = Path(settings.lights.survey)
    try:
        survey = read_survey(path, None if profile is None else PROFILES[profile])
        read_residuals(path)
    except SurveyError as error:
        wrong.append((parser.USAGE, f"{error} ({loader.naming(file, 'lights.survey', path)})"))
        return []
    unused = [] if settings.photodiode.fitted else ["the survey is not used: `photodiode.bus` is empty"]
    return [f"{path}: good, {len(survey.lamps)} lamps", *unused]


def implausible(mount: Mount) -> list[str]:
    """What of a mount may be meant in other units."""
    said = [
        f"`lidar.mount.{axis}` = {metres:g}: metres from the robot's centre; is that meant?"
        for axis, metres in (("x", mount.x), ("y", mount.y))
        if abs(metres) > FAR_M
    ]
    eighths = mount.yaw / (math.pi / 4)
    if mount.yaw and abs(mount.yaw) < 6.3 and abs(eighths - round(eighths)) < 2e-3:
        said.append(f"`lidar.mount.yaw` = {mount.yaw:g}: degrees; is {math.degrees(mount.yaw):.0f} meant?")
    return said


class Maps(Enum):
    """What a folder of maps is good for."""

    READY = auto()
    EMPTY = auto()
    FROZEN = auto()
    TAKEN = auto()
    BROKEN = auto()


def look_at_maps(settings: Config) -> tuple[Maps, str]:
    """What the folder of maps is good for, and one line about it; nothing in it is touched.

    READY: there is a map to begin with. EMPTY: there is none yet, and maps can be kept. FROZEN: there is one, and what
    is learned cannot be kept, as it should be. TAKEN: the same for as long as another process keeps its maps there; it
    may be the very daemon that the configuration is of. BROKEN: there is none that can be used, or none can be kept.
    What cannot be used is said, each file by itself, by the store's own log. A folder is often another user's.
    """
    folder = maps_folder(settings.map.folder)
    if not os.access(folder, os.F_OK):
        if not can_be_made(folder):
            text = f"{folder}: cannot be made by this user, maps cannot be kept; name another in `map.folder`"
            return Maps.BROKEN, text
        return Maps.EMPTY, f"{folder}: not there yet, maps will be kept in it"
    if not folder.is_dir():
        return Maps.BROKEN, f"{folder}: is no folder, maps cannot be kept; name another in `map.folder`"
    if not os.access(folder, os.R_OK | os.X_OK):
        return Maps.BROKEN, f"{folder}: maps in it cannot be read by this user"
    from daemon.maps.store import LOCK, Store, judge_for, unjudged
    from daemon.runtime.light_setup import (  # with them comes the arithmetic, which no other remark needs
        SurveyError,
        load_lights,
    )

    store = Store(folder, mend=False)
    try:
        judge = judge_for(load_lights(settings))
    except SurveyError:  # which is told by itself
        judge = unjudged
    start = store.load(judge)
    unwritten = not settings.map.localise and not _writable(folder, folder / LOCK)
    other = "" if settings.map.localise else _keeper(folder / LOCK)
    more = "; nothing can be kept in it by this user (fault 403)" if unwritten else ""
    more += f"; {other} keeps its maps there, and no other can (fault 403)" if other else ""
    if start is None:
        broken = store.refused or unwritten
        text = f"{folder}: {'no map in it can be used' if store.refused else 'no map in it yet'}{more}"
        return Maps.BROKEN if broken else Maps.TAKEN if other else Maps.EMPTY, text
    meta, count = start.stored.meta, len(start.stored.tables["submap.key"])
    named = f" ({meta.name})" if meta.name else ""
    text = f"{folder}: map {meta.map_id:08x}{named} of {count} submaps is good{more}"
    return Maps.FROZEN if unwritten else Maps.TAKEN if other else Maps.READY, text


def _writable(folder: Path, lock: Path) -> bool:
    """Whether this user may keep maps in a folder: write into it, and take the lock that is there."""
    return os.access(folder, os.W_OK | os.X_OK) and (not lock.exists() or os.access(lock, os.R_OK | os.W_OK))


def _keeper(lock: Path) -> str:
    """Who holds the lock of a folder of maps, in words; empty: nobody."""
    try:
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # and back at once: who starts meanwhile tries again
    except BlockingIOError:
        about = lock.stat()
        named = f"{os.major(about.st_dev):02x}:{os.minor(about.st_dev):02x}:{about.st_ino}"
    except OSError:
        return ""
    else:
        return ""
    with contextlib.suppress(OSError):
        for line in LOCKS.read_text().splitlines():
            words = line.split()  # 3: FLOCK  ADVISORY  WRITE 1234 08:01:5678 0 EOF
            if "FLOCK" in words and words[-3] == named:
                return f"process {words[-4]}"
    return "another process"  # of a container of its own, or on a file system that has other numbers here


def _look_at_bus(name: str) -> str:
    """One line about the photodiode's bus, which is opened and closed again."""
    import asyncio

    from hal.errors import HalError
    from hal.port.opening import open_bus

    async def look() -> str:
        bus = await open_bus(name)
        await bus.close()
        return bus.about

    try:
        about = asyncio.run(look())
    except HalError as error:
        return f"as seen from here, {error}"
    return f"{name}: there{f', {about}' if about else ''}; `lumiloop probe {name}` says what answers on it"

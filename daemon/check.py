"""``lumiloop check``: whether configuration, survey and maps are good, and whether the photodiode's bus is here."""

from __future__ import annotations

import argparse
import math
import os
import sys
from enum import Enum, auto
from pathlib import Path
from typing import Final

from daemon import cli
from daemon.config import Config, Mount
from daemon.folders import can_be_made, maps_folder

FAR_M: Final = 5.0
"""A lidar is on its robot."""


def main(args: argparse.Namespace) -> int:
    """The command ``check``; ``args.settings`` is the configuration, which has been found good by now.

    A bus that is not here is a remark, not a refusal: files are also checked on other computers.
    """
    settings: Config = args.settings
    remarks = implausible(settings.lidar.mount)
    if settings.lights.survey:
        from daemon.photodiode import profile_of
        from daemon.surveyfile import SurveyError, read_survey

        try:
            survey = read_survey(Path(settings.lights.survey), profile_of(settings.photodiode))
        except SurveyError as error:
            return cli.fail(f"{error} (`lights.survey` in {args.config} names it)", cli.USAGE)
        remarks.append(f"{settings.lights.survey}: good, {len(survey.lamps)} lamps")
        if not settings.photodiode.fitted:
            remarks.append("the survey is not used: `photodiode.bus` is empty")
    if settings.photodiode.fitted:
        remarks.append(_look_at_bus(settings.photodiode.bus))
    if settings.map.kept:
        found, remark = look_at_maps(settings)
        if settings.map.localise and found is not Maps.READY:
            return cli.fail(f"{remark}; `map.localise` in {args.config} asks for a map: `run` would be refused")
        remarks.append(remark)
    sys.stdout.write("".join(f"{line}\n" for line in (f"{args.config}: good", *remarks)))
    return cli.OK


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
    BROKEN = auto()


def look_at_maps(settings: Config) -> tuple[Maps, str]:
    """What the folder of maps is good for, and one line about it; nothing in it is touched.

    READY: there is a map to begin with. EMPTY: there is none yet, and maps can be kept. FROZEN: there is one, and what
    is learned cannot be kept, as it should be. BROKEN: there is none that can be used, or none can be kept. What cannot
    be used is said, each file by itself, by the store's own log. A folder is often another user's.
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
    from daemon.lights import load_lights  # with them comes the arithmetic, which no other remark needs
    from daemon.store import Store, judge_for

    store = Store(folder, mend=False)
    start = store.load(judge_for(load_lights(settings)))
    unwritten = not settings.map.localise and not os.access(folder, os.W_OK)
    more = "; nothing can be kept in it by this user" if unwritten else ""
    if start is None:
        broken = store.refused or unwritten
        text = f"{folder}: {'no map in it can be used' if store.refused else 'no map in it yet'}{more}"
        return Maps.BROKEN if broken else Maps.EMPTY, text
    meta, count = start.stored.meta, len(start.stored.tables["submap.key"])
    named = f" ({meta.name})" if meta.name else ""
    text = f"{folder}: map {meta.map_id:08x}{named} of {count} submaps is good{more}"
    return Maps.FROZEN if unwritten else Maps.READY, text


def _look_at_bus(name: str) -> str:
    """One line about the photodiode's bus, which is opened and closed again."""
    import asyncio

    from hal.errors import HalError
    from hal.opening import open_bus

    async def look() -> str:
        bus = await open_bus(name)
        await bus.close()
        return bus.about

    try:
        about = asyncio.run(look())
    except HalError as error:
        return f"as seen from here, {error}"
    return f"{name}: there{f', {about}' if about else ''}; `lumiloop probe {name}` says what answers on it"

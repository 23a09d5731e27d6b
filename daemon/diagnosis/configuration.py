"""Plausibility check of a configuration and of what it names: survey, maps, and the photodiode's bus."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from daemon.config import loader
from daemon.config.schema import Config, Mount
from daemon.diagnosis.map_folder import Maps, look_at_maps
from daemon.system import console

FAR_M: Final = 5.0
"""Largest plausible distance of a lidar from the robot's centre, m."""


def examine(settings: Config, file: Path, gone: frozenset[str], wrong: list[tuple[int, str]]) -> list[str]:
    """Returns the remarks on a configuration and on what it names; defects are added to ``wrong`` with an exit code.

    ``gone``: keys without a valid value; nothing that depends on them is checked.
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
            words = f"{remark}; `map.localise` in {file} requires a map, so `run` cannot start"
            wrong.append((console.FAILED, words))
        remarks.append(remark)
    return remarks


def _look_at_survey(settings: Config, profile: str | None, file: Path, wrong: list[tuple[int, str]]) -> list[str]:
    """Checks the survey in the same way; ``profile``: air interface of its lamps, None: not known."""
    from daemon.config.survey_loader import SurveyError, read_survey
    from daemon.devices.light_setup import read_residuals
    from estimator import PROFILES

    path = Path(settings.lights.survey)
    try:
        survey = read_survey(path, None if profile is None else PROFILES[profile])
        read_residuals(path)
    except SurveyError as error:
        wrong.append((console.USAGE, f"{error} ({loader.naming(file, 'lights.survey', path)})"))
        return []
    unused = [] if settings.photodiode.fitted else ["the survey is not used, because `photodiode.bus` is empty"]
    return [f"{path}: valid, {len(survey.lamps)} lamps", *unused]


def implausible(mount: Mount) -> list[str]:
    """Returns remarks on mount values that may be in other units."""
    said = [
        f"`lidar.mount.{axis}` = {metres:g}: check the unit, metres from the robot's centre"
        for axis, metres in (("x", mount.x), ("y", mount.y))
        if abs(metres) > FAR_M
    ]
    eighths = mount.yaw / (math.pi / 4)
    if mount.yaw and abs(mount.yaw) < 6.3 and abs(eighths - round(eighths)) < 2e-3:
        said.append(
            f"`lidar.mount.yaw` = {mount.yaw:g}: check the unit, degrees; as radians it would be "
            f"{math.degrees(mount.yaw):.0f} degrees"
        )
    return said


def _look_at_bus(name: str) -> str:
    """Opens and closes the photodiode's bus; returns one line about it."""
    import asyncio

    from hal.bus.opening import open_bus
    from hal.errors import HalError

    async def look() -> str:
        bus = await open_bus(name)
        await bus.close()
        return bus.about

    try:
        about = asyncio.run(look())
    except HalError as error:
        return f"from this computer, {error}"
    return f"{name}: there{f', {about}' if about else ''}; `lumiloop probe {name}` identifies it"
